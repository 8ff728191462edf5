"""Base classes of all sources of records."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, Field

from asia._text import suggestion
from asia.data.intake.sheet import Missing, Wanted
from asia.data.trajectory import Array, Signal, Trajectory, check_magnitudes, check_ranges
from asia.errors import UserError

Subset = Literal["train", "test", "guard"]
"""Records to train on, the sealed test, and records that no fold and no agent sees."""


@dataclass(frozen=True)
class Channels:
    """Channels to read."""

    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    sampling_time: float
    least: int = field(default=1, compare=False)
    """Shortest usable segment of a training record in samples, where files are cut at gaps."""

    @property
    def names(self) -> tuple[list[str], list[str]]:
        """Names of the inputs, and of the outputs."""
        return [s.name for s in self.inputs], [s.name for s in self.outputs]

    @property
    def time_step(self) -> int | None:
        """Place of the input that holds the time to the next sample; None for one sampling time."""
        return next((i for i, s in enumerate(self.inputs) if s.role == "time_step"), None)


@dataclass(frozen=True)
class SourceData:
    """The records of one subset."""

    trajectories: tuple[Trajectory, ...]
    """The records, in a fixed order, each with a name of its own."""
    truth: tuple[Array, ...] | None = None
    """Noise-free outputs (T, ny) of each record; for simulated systems only."""
    warnings: tuple[str, ...] = ()
    readings: tuple[str, ...] = ()
    """How the files were read: sampling time, and the evidence for it."""


@dataclass(frozen=True)
class TestSummary:
    """Public facts about test records before they are opened."""

    sha256: str
    """Digest of the records, as `data_digest` gives it."""
    names: tuple[str, ...]
    lengths: tuple[int, ...]
    shared_samples: int
    """Samples that also occur, in runs of ten or more, in the training records."""
    outside_inputs: tuple[int, ...] = ()
    """For each input, samples beyond the range of the training records."""


def _no_empty_name(value: str) -> str:
    if not value or "\0" in value:
        raise ValueError(f"{value!r} is not a file name")
    return value


FileName = Annotated[str, AfterValidator(_no_empty_name)]
"""A file, relative to the problem file."""


@dataclass(frozen=True)
class SealedEntry:
    """`data.sealed` of a problem file."""

    file: FileName
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


@dataclass(frozen=True)
class DataTable:
    """`[data]` of a problem file."""

    train: tuple[FileName, ...] = ()
    test: tuple[FileName, ...] = ()
    sealed: SealedEntry | None = None
    """The encrypted test, instead of `test`."""
    source: str | None = None
    """`name` or `name:argument` of a source, instead of files."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] | None = None
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    guard: tuple[FileName, ...] | Annotated[int, Field(ge=1, le=100)] = ()
    """Guard records: files, names of training records, or a number of simulated records."""
    guard_share: Annotated[float, Field(gt=0.0, le=0.5)] | None = None
    """Share of the training records, or of their samples, that is held back as guard records."""
    period: Annotated[int, Field(ge=2, le=100_000_000)] | None = None
    """Samples after which the inputs of every record repeat; found where it is not given."""
    frequency: tuple[FileName, ...] = ()
    """Measured frequency responses, fitted together with the records."""
    time: str | None = None
    """Column with the time stamps; found by its name where not given, and "none" for no stamps."""
    time_unit: str | None = None
    """Unit of time stamps that are numbers, such as ms."""
    columns: tuple[str, ...] = ()
    """Column names of files without a header."""
    missing: tuple[Missing, ...] = ()
    """Samples of the files that count as not measured."""
    readings: tuple[str, ...] = ()
    """Findings of `asia init` in the files that these were made from."""
    experiment_column: str | None = None
    """Column of the files that names the experiment of a row."""
    test_experiments: tuple[str, ...] = ()
    """Experiments in the training files that are the test."""

    @property
    def reading(self) -> Wanted:
        """Options of reading files."""
        return Wanted(
            (), (), self.time, self.time_unit, self.experiment_column, self.columns, self.missing
        )


class Source(ABC):
    """Location and reader of the records of a problem.

    A subclass is a frozen dataclass; two equal sources read the same records.
    """

    usage: ClassVar[str] = ""
    """Form in `data.source`, such as `nanodrone`; "" where it is the bare name."""
    public: ClassVar[bool] = False
    """Whether it is a public benchmark, whose published results compare with a run's."""
    test_kept: ClassVar[str] = (
        "where its source keeps it; isolation alone keeps candidates off the records"
    )
    sha256: str | None = None
    """The digest that the test records must have; None where the problem file names none."""

    @classmethod
    @abstractmethod
    def from_table(cls, table: DataTable, root: Path) -> Self:
        """Make the source that `[data]` names; no test or guard record is opened.

        Args:
            root: the folder of the problem file, absolute

        Raises:
            UserError: for a table that it does not understand
        """

    @abstractmethod
    def read(self, subset: Subset, channels: Channels) -> SourceData:
        """Read the records of a subset, the same at every call; none where it has none.

        Guard records are never among the training records. Callers use `records`, which checks the
        answer.

        Raises:
            UserError: when the data cannot be read
        """

    @abstractmethod
    def places(self, subset: Subset) -> tuple[Path, ...]:
        """Return every file or folder with records of a subset, absolute: workers must not read
        them.

        () where nothing is stored.

        Raises:
            UserError: when the data are missing
        """

    @abstractmethod
    def to_toml(self) -> dict[str, Any]:
        """`[data]` with absolute paths, from which `from_table` makes an equal source; None is
        left out."""

    @property
    def has_test(self) -> bool:
        """Whether there are test records."""
        return True

    @property
    def guard_names(self) -> tuple[str, ...]:
        """Names of the guard records, known without reading them."""
        return ()

    def records(self, subset: Subset, channels: Channels) -> SourceData:
        """The records of a subset.

        Raises:
            UserError: as `read`, when they do not fit the channels, when two of them have one
                name, and for values whose squares a double cannot hold
        """
        found = self.read(subset, channels)
        for t in found.trajectories:
            for what, have, named in (
                ("inputs", t.u.shape[1], len(channels.inputs)),
                ("outputs", t.y.shape[1], len(channels.outputs)),
            ):
                if have != named:
                    raise UserError(f"record '{t.name}' has {have} {what}, but {named} are named")
            if abs(t.sampling_time - channels.sampling_time) > 1e-3 * t.sampling_time:
                raise UserError(
                    f"sampling_time is {channels.sampling_time:g} s, but record '{t.name}' was "
                    f"sampled every {t.sampling_time:g} s"
                )
        kind = "training" if subset == "train" else subset
        check_magnitudes(found.trajectories, *channels.names, kind)
        if subset == "train":
            check_ranges(found.trajectories, *channels.names)
        for name, count in Counter(t.name for t in found.trajectories).items():
            if count > 1:
                raise UserError(
                    f"{count} {subset} records are called '{name}': give each a name of its own"
                )
        return found

    def outline(self, channels: Channels) -> TestSummary | None:
        """Return the public facts about the test; None where its records must be read to know them.

        Raises:
            UserError: when the container does not fit the channels or is damaged
        """
        del channels
        return None

    def check_openable(self) -> None:
        """Raise UserError when the test is certain not to open."""
        return

    def with_keys(self, folder: Path | None) -> Source:
        """Return the same source with its keys in `folder`; None is the folder of the user."""
        del folder
        return self


@dataclass(frozen=True)
class DataSet(Source):
    """Data set with a fixed division into training and test records.

    A problem may set training records apart, by name, as guard records. A subclass implements
    `load` and `places`.
    """

    source: str
    """`data.source` as the problem file has it."""
    guard: tuple[str, ...] = ()

    @property
    def argument(self) -> str:
        """Text after the colon of `data.source`."""
        return self.source.partition(":")[2]

    @abstractmethod
    def load(self, subset: Literal["train", "test"], channels: Channels) -> SourceData:
        """All records of the data set that are to train on, or of its test. Raises UserError."""

    @classmethod
    def from_table(cls, table: DataTable, root: Path) -> Self:
        del root
        refuse_seed(table)
        if isinstance(table.guard, int):
            raise not_counted(table.guard, "training records")
        return cls(table.source or "", table.guard)

    def read(self, subset: Subset, channels: Channels) -> SourceData:
        if subset == "test":
            return self.load("test", channels)
        if subset == "guard" and not self.guard:
            return SourceData(())
        found = self.load("train", channels)
        known = [t.name for t in found.trajectories]
        for name in self.guard:
            if name not in known:
                raise UserError(
                    f"data.guard: no training record is called '{name}'{suggestion(name, known)}"
                )
        if known and set(known) <= set(self.guard):
            raise UserError("data.guard takes every training record: leave some to train on")
        kept = [i for i, name in enumerate(known) if (name in self.guard) == (subset == "guard")]
        return SourceData(
            tuple(found.trajectories[i] for i in kept),
            None if found.truth is None else tuple(found.truth[i] for i in kept),
            found.warnings,
        )

    def to_toml(self) -> dict[str, Any]:
        return {"source": self.source, "guard": list(self.guard) or None}

    @property
    def guard_names(self) -> tuple[str, ...]:
        return self.guard


def refuse_seed(table: DataTable) -> None:
    """Raise UserError where a seed is named for records that are not simulated."""
    if table.seed is not None:
        raise UserError("data.seed belongs to a simulated source: leave it out")


def not_counted(guard: int, what: str) -> UserError:
    """The error for a number of guard records where they have to be named."""
    return UserError(
        f"data.guard is {guard}, which only a simulated source understands: name the {what}"
    )
