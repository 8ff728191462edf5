"""Records in files, of every format that ASIA reads."""

from collections import Counter
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Self

from asia.data.intake.conversion import Intake, Use, take_in
from asia.data.intake.sheet import Wanted
from asia.data.sources.source import (
    Channels,
    DataTable,
    Source,
    SourceData,
    Subset,
    not_counted,
    refuse_seed,
)
from asia.data.trajectory import unique_names
from asia.errors import UserError


@dataclass(frozen=True)
class RecordFiles(Source):
    """Files that a problem names one by one; absolute paths."""

    train: tuple[Path, ...]
    test: tuple[Path, ...] = ()
    """Files of the test; () without a test, or where it is encrypted."""
    guard: tuple[Path, ...] = ()
    reading: Wanted = field(default_factory=lambda: Wanted((), ()))
    test_experiments: tuple[str, ...] = ()
    """Experiments in the training files that are the test."""
    readings: tuple[str, ...] = field(default=(), compare=False)
    """Findings in the files that these were made from."""

    test_kept: ClassVar[str] = (
        "in plain files; only isolation keeps candidates off them, and asia init --seal "
        "would encrypt them"
    )

    @classmethod
    def from_table(cls, table: DataTable, root: Path) -> Self:
        refuse_seed(table)
        if not table.train and table.frequency:
            raise UserError(
                '[data] has frequency responses and no records: add train = ["file.csv"], or run '
                f"asia linear {table.frequency[0]}, which fits a response alone"
            )
        if not table.train:
            raise UserError(
                '[data] names no training data: expected train = ["file.csv"] or source'
            )
        if isinstance(table.guard, int):
            raise not_counted(table.guard, "files")
        named = {"train": table.train, "test": table.test, "guard": table.guard}
        lists = {k: tuple((root / name).resolve() for name in v) for k, v in named.items()}
        for path, count in Counter(p for paths in lists.values() for p in paths).items():
            if count > 1:
                owners = [name for name, paths in lists.items() if path in paths]
                what = f"both {' and '.join(owners)}" if len(owners) > 1 else "one list twice"
                raise UserError(f"[data] names {path} in {what}: name every record once")
        return cls(
            **lists, reading=table.reading, test_experiments=table.test_experiments,
            readings=table.readings,
        )  # fmt: skip

    def read(self, subset: Subset, channels: Channels) -> SourceData:
        if subset == "train":
            found = [self._take(self.train, channels, "train", without=self.test_experiments)]
        elif subset == "guard":
            found = [self._take(self.guard, channels, "test")] if self.guard else []
        else:
            held = self.test_experiments
            found = [self._take(self.test, channels, "test")] if self.test else []
            found += [self._take(self.train, channels, "test", only=held)] if held else []
        records = [record for one in found for record in one.records]
        if subset == "guard" and len(records) != len(self.guard):
            raise UserError(
                f"{len(self.guard)} files stand guard, and they hold {len(records)} records: name "
                "files of one record without gaps in data.guard"
            )
        names = unique_names([r.name for r in records])
        return SourceData(
            tuple(replace(r, name=n) for r, n in zip(records, names, strict=True)),
            warnings=tuple(note for one in found for note in one.notes),
            readings=(*self.readings, *(text for one in found for text in one.readings)),
        )

    def records_of(self, path: Path, channels: Channels, reading: Wanted | None = None) -> Intake:
        """The records of another file, which are to be judged as a test. reading: options in place
        of the problem's own. Raises UserError."""
        own = self
        if reading is not None:
            own = replace(self, reading=replace(reading, missing=self.reading.missing))
        return own._take((path,), channels, "test")

    def _take(self, paths: tuple[Path, ...], channels: Channels, use: Use, **chosen: Any) -> Intake:
        inputs, outputs = channels.names
        place = channels.time_step
        measured = tuple(name for i, name in enumerate(inputs) if i != place)
        wanted = replace(self.reading, inputs=measured, outputs=tuple(outputs), time_step=place)
        least = channels.least if use == "train" else 1
        found = take_in(paths, wanted, use, channels.sampling_time, least, **chosen)
        if (len(found.inputs), found.outputs) != (len(inputs), wanted.outputs):
            raise UserError(
                f"{paths[0]}: a signal is a matrix with several columns: name the columns "
                f"{', '.join((*found.inputs, *found.outputs))} in problem.toml"
            )
        return found

    def places(self, subset: Subset) -> tuple[Path, ...]:
        held = self.train if self.test_experiments else ()
        return {"train": self.train, "test": (*self.test, *held), "guard": self.guard}[subset]

    def to_toml(self) -> dict[str, Any]:
        reading = self.reading
        return {
            "train": [str(path) for path in self.train],
            "test": [str(path) for path in self.test],
            "guard": [str(path) for path in self.guard] or None,
            "time": reading.time,
            "time_unit": reading.time_unit,
            "columns": list(reading.columns) or None,
            "missing": [asdict(entry) for entry in reading.missing] or None,
            "readings": list(self.readings) or None,
            "experiment_column": reading.experiment,
            "test_experiments": list(self.test_experiments) or None,
        }

    @property
    def has_test(self) -> bool:
        return bool(self.test or self.test_experiments)

    @property
    def guard_names(self) -> tuple[str, ...]:
        # The names of the files, with the folder where two files have one name.
        stems = Counter(path.stem for path in self.guard)
        return tuple(
            p.stem if stems[p.stem] == 1 else f"{p.parent.name}/{p.stem}" for p in self.guard
        )

    def check_openable(self) -> None:
        for path in self.test:
            if not path.exists():
                raise UserError(f"no such file: {path}; put the test data back")
