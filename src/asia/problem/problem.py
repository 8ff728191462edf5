"""Problem and prior knowledge, without any test output."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from asia._plugins import library
from asia._text import one_line
from asia.data.arrays import name_signals, one_a_record, read_arrays
from asia.data.frequency import FrequencyRecord
from asia.data.preprocess import Preprocess
from asia.data.sources.source import Channels, Source
from asia.data.trajectory import Array, Signal, Trajectory
from asia.problem.budget import Budget
from asia.problem.feedback import Loop, loop_table
from asia.problem.folds import least_samples
from asia.problem.physics import Physics
from asia.problem.plant import Plant, Unknown, plant_file
from asia.problem.protocol import ProtocolRule
from asia.problem.protocol_table import ProtocolTable, groups_table, protocol_table
from asia.problem.symmetry import Symmetry
from asia.problem.toml import toml_text

if TYPE_CHECKING:
    from asia.problem.control import Control

# A problem as the rest of ASIA sees it, and handles to its data. Holds no test outputs.


@dataclass(frozen=True)
class TestSource:
    """Handle that opens the test records; it never holds their values."""

    source: Source | None
    """Source of the test records; None when the problem has no test data."""
    sha256: str | None = None
    """Expected digest of the data, known once they were sealed."""


@dataclass(frozen=True)
class Seal:
    """Public facts about the test records before they are opened."""

    sha256: str | None
    names: tuple[str, ...] = ()
    lengths: tuple[int, ...] = ()
    shared_samples: int = 0
    """Test samples inside runs of consecutive samples, inputs and outputs, that also occur in a
    training record."""
    outside_inputs: tuple[int, ...] = ()
    """Test samples of each input beyond the range of the training records; empty if not known."""
    guard: str | None = None


DESCRIPTION_TEMPLATE = """\
# {name}

Say in plain English what the system is: what the inputs do, what the outputs measure, which physics
you expect, what saturates, delays or sticks, how noisy the sensors are. Language-model agents read
this text, and the report prints it.
"""
"""Text of a new description.md."""


def is_described(description: str) -> bool:
    """Return whether a description is neither empty nor the untouched template."""
    return bool(description.strip()) and DESCRIPTION_TEMPLATE.split("\n", 1)[1] not in description


@dataclass(frozen=True, eq=False)
class Problem:
    """Identification problem: records, signals, protocol, budget and physics; times in s."""

    name: str
    """Part of the run's name."""
    description: str
    """The system in plain English; "" for none."""
    sampling_time: float
    inputs: tuple[Signal, ...]
    """The inputs, in the order of `Trajectory.u`."""
    outputs: tuple[Signal, ...]
    """The outputs, in the order of `Trajectory.y`."""
    train: tuple[Trajectory, ...]
    data: Source
    """Source of the training and guard records."""
    test: TestSource
    protocol: ProtocolRule
    budget: Budget
    physics: Physics | None = None
    baseline: str | None = None
    """Source of the problem's own first candidate."""
    truth: tuple[Array, ...] | None = None
    """Noise-free outputs (T, ny) of the training records; for simulated systems only."""
    warnings: tuple[str, ...] = ()
    """Doubts about the data, in plain words."""
    readings: tuple[str, ...] = ()
    """Sampling time of each file, and the evidence for it."""
    preprocess: Preprocess = field(default_factory=Preprocess)
    recorded: Channels | None = None
    """Signals and sampling time before that; None where nothing is done."""
    notes: str = ""
    """Notes on such systems from the literature, for agents that read."""
    strategies: str = ""
    """Suggested strategies in plain words, for agents that read."""
    guard_sha256: str | None = None
    """Expected digest of the guard records, known once a run has begun."""
    guard_share: float | None = None
    """Share of the training records that is held back as guard records; None for none."""
    symmetry: Symmetry = field(default_factory=dict[str, Mapping[str, str]])
    """Changes of the signals that leave the system's laws as they are."""
    period: int | None = None
    """Samples after which the inputs repeat, as declared."""
    loop: Loop | None = None
    """Feedback loop in which the training records were taken."""
    plant: Plant | None = None
    """Simulator of the user's own."""
    control: Control | None = None
    """Plant and cost of a control problem; its records are then scenarios."""
    responses: tuple[FrequencyRecord, ...] = ()
    """Measured frequency responses of the system."""
    response_files: tuple[Path, ...] = ()
    """Their files."""

    @property
    def identification(self) -> Problem:
        """The problem itself; of a control problem the identification of its plant."""
        return self if self.control is None else self.control.base

    @classmethod
    def from_arrays(
        cls,
        u: Any,
        y: Any,
        *,
        sampling_time: float | None = None,
        directory: Path | str,
        inputs: Sequence[str | Signal] | None = None,
        outputs: Sequence[str | Signal] | None = None,
        test_u: Any = None,
        test_y: Any = None,
        name: str | None = None,
        description: str = "",
        baseline: str | None = None,
        groups: Mapping[str, Sequence[str]] | None = None,
        protocol: ProtocolRule | Mapping[str, Any] | None = None,
        budget: Budget | Mapping[str, Any] | None = None,
        physics: Physics | Mapping[str, Any] | None = None,
        symmetry: Symmetry | None = None,
        plant: Mapping[str, Any] | None = None,
    ) -> Problem:
        """Make a problem from records in memory, and write it to `directory` so that runs can
        resume, verify and unseal.

        The records are called train1, train2 and so on, and test1, unless `groups` names them. Time
        stamps, gaps and missing values are treated as `asia init` treats those of files; `warnings`
        lists the changes. A second call with the same arguments loads the existing directory.

        Args:
            u, y: inputs (T, nu) and outputs (T, ny) in physical units; arrays or data frames,
                or lists of them with one item a record
            sampling_time: s; None for that of the time index of the data frames
            test_u, test_y: the same for the test
            inputs, outputs: names, or `Signal`s with units; columns of these names are taken
                out of data frames
            name: name of the problem; that of the directory by default
            protocol, budget, physics, symmetry: tables as in problem.toml, or objects
            baseline: source of the first candidate
            plant: table as in problem.toml for a simulator of your own; `source` is
                "plant.py:simulate", "model.fmu" or a function of a Python file, which is copied

        Raises:
            UserError: for arguments that make no problem, and when the directory holds other
                data or settings; nothing is overwritten
        """
        us, ys = one_a_record(u), one_a_record(y)
        test_us, test_ys = ([] if v is None else one_a_record(v) for v in (test_u, test_y))
        signals = name_signals(inputs, us[0], "u"), name_signals(outputs, ys[0], "y")
        try:
            rule = protocol or ProtocolRule()
            if not isinstance(rule, ProtocolRule):
                rule = TypeAdapter(ProtocolTable).validate_python(_plain(rule)).rule()
            least = least_samples(rule)
        except ValueError:
            # Loading the problem reports the mistake.
            least = 1
        train = read_arrays(us, ys, *signals, sampling_time, "train", "train", least)
        step = train.records[0].sampling_time
        test = read_arrays(test_us, test_ys, *signals, step, "test", "test")
        directory = Path(directory).resolve()
        if isinstance(protocol, ProtocolRule):
            groups = groups_table(protocol) if groups is None else groups
            protocol = protocol_table(protocol)
        files: dict[str, str | bytes] = {}
        if plant is not None:
            plant, file, content = plant_file(plant)
            files[file] = content
        tables = {
            "name": name or directory.name,
            "description": "description.md" if description else None,
            "sampling_time": float(step),
            "inputs": [asdict(signal) for signal in signals[0]],
            "outputs": [asdict(signal) for signal in signals[1]],
            "data": {
                "train": [f"{t.name}.csv" for t in train.records],
                "test": [f"{t.name}.csv" for t in test.records],
                "groups": groups,
            },
            "protocol": _plain(protocol),
            "budget": _plain(budget),
            "physics": _plain(physics),
            "plant": _plain(plant),
            "symmetry": {k: dict(v) for k, v in symmetry.items()} if symmetry else None,
        }
        # The module loads problems: imported above, it would close a circle.
        create = library("asia.problem.create")
        names = [signal.name for side in signals for signal in side]
        files |= {
            f"{t.name}.csv": create.record_csv(t, names) for t in (*train.records, *test.records)
        }
        if description:
            files["description.md"] = description
        if baseline is not None:
            files["baseline.py"] = baseline
        files["problem.toml"] = toml_text(tables)
        problem: Problem = create.save_problem(directory, files)
        return replace(
            problem,
            warnings=(*train.notes, *test.notes, *problem.warnings),
            readings=(*train.readings, *test.readings),
        )

    @property
    def guard_names(self) -> tuple[str, ...]:
        """Names of the guard records, known without reading them."""
        if self.guard_share is not None:
            return (f"{100 * self.guard_share:g} % of the training data",)
        return self.data.guard_names

    @property
    def channels(self) -> Channels:
        """Channels of the data to read, as they were recorded."""
        return self.recorded or Channels(self.inputs, self.outputs, self.sampling_time)


def _plain(value: Any) -> Any:
    """Tables and lists of Python's own numbers, at any depth."""
    if isinstance(value, (Budget, Physics, Unknown)):
        return asdict(value)
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return value.item() if hasattr(value, "item") else value


def prepared(problem: Problem, records: Sequence[Trajectory]) -> tuple[Trajectory, ...]:
    """Records as they were read, as the search sees them."""
    return problem.preprocess.records(records, problem.inputs)


def kept_places(problem: Problem) -> tuple[Path, ...]:
    """Files and folders that neither candidates nor agents may read: plain test records, or the key
    of encrypted ones, and guard records.

    Raises:
        UserError: for data that are not on this machine
    """
    source = problem.test.source
    test = () if source is None else source.places("test")
    guard = problem.data.places("guard" if problem.guard_share is None else "train")
    return (*test, *guard)


def record_places(problem: Problem) -> tuple[Path, ...]:
    """Return the files and folders with the training records, which workers must not read.

    Raises:
        UserError: as `kept_places`
    """
    return problem.data.places("train")


# Training view of a problem: its training records, never its test.


_HEADER = (
    "# Written by ASIA: the problem that candidates are judged on, with its training records.\n"
    "# A change in here changes nothing but what your own tools compute.\n"
)


def training_text(problem: Problem, names: Sequence[str]) -> str:
    """problem.toml over CSV files `data/NAME.csv`, a name for each training record in their order;
    `load_problem` gives the same records, folds and metric. It names neither test nor source."""
    called = {t.name: name for t, name in zip(problem.train, names, strict=True)}
    groups = groups_table(problem.protocol) or {}
    budget = problem.budget
    tables = {
        "name": problem.name,
        "sampling_time": problem.sampling_time,
        "inputs": [asdict(s) for s in problem.inputs],
        "outputs": [asdict(s) for s in problem.outputs],
        "data": {
            "train": [f"data/{name}.csv" for name in names],
            "groups": {k: [called[name] for name in v] for k, v in groups.items()} or None,
            "frequency": [f"data/response{k + 1}.npz" for k in range(len(problem.responses))]
            or None,
        },
        "protocol": protocol_table(problem.protocol),
        "budget": {"fit_seconds": budget.fit_seconds, "memory_mb": budget.memory_mb},
        "physics": None if problem.physics is None else asdict(problem.physics),
        "plant": problem.plant and {**problem.plant.table, "source": problem.plant.label},
        # The records were delayed and thinned out before they were written.
        "preprocess": {
            name: True for name in ("detrend", "scale") if getattr(problem.preprocess, name)
        },
        "symmetry": {k: dict(v) for k, v in problem.symmetry.items()} or None,
        "loop": loop_table(problem.loop),
    }
    return _HEADER + toml_text(tables)


# Prior knowledge of a problem file next to the equations, as lines for users and agents.


_TEXT = 400


def prior_lines(physics: Physics) -> Iterator[str]:
    """One a prior: the combination of parameters, its value and the reason."""
    for text, prior in physics.priors.items():
        reason = f": {one_line(prior.reason, _TEXT)}" if prior.reason else ""
        yield f"{one_line(text, _TEXT)} = {prior.mean:g} +- {prior.deviation:g}{reason}"


def correction_lines(physics: Physics) -> Iterator[str]:
    """One a place in the equations where an unknown effect enters, with its typical size."""
    for name, correction in physics.corrections.items():
        yield f"{name}: unknown, about {correction.scale:g} large"


def symmetry_lines(symmetry: Symmetry) -> Iterator[str]:
    """Describe each generator: every signal and the signal that replaces it."""
    for name, generator in symmetry.items():
        changes = ", ".join(f"{signal} -> {value}" for signal, value in generator.items())
        yield f"{name.replace('_', ' ')}: {one_line(changes, 2 * _TEXT)}"
