"""Records in CSV files, one a file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Self

from asia.data.sources.csv import read_csv
from asia.data.sources.source import (
    Channels,
    DataTable,
    Source,
    SourceData,
    Subset,
    not_counted,
    refuse_seed,
)
from asia.errors import UserError


@dataclass(frozen=True)
class CsvFiles(Source):
    """Files that a problem names one by one; absolute paths."""

    train: tuple[Path, ...]
    """Files to train on."""
    test: tuple[Path, ...] = ()
    """Files of the test; () without a test, or where it is encrypted."""
    guard: tuple[Path, ...] = ()
    """Files that stand guard."""

    test_kept: ClassVar[str] = (
        "in plain files; isolation alone keeps candidates off them, and asia init --seal "
        "would encrypt them"
    )

    @classmethod
    def from_table(cls, table: DataTable, root: Path) -> Self:
        """As `Source.from_table`."""
        refuse_seed(table)
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
        return cls(**lists)

    def read(self, subset: Subset, channels: Channels) -> SourceData:
        """As `Source.read`."""
        return read_files(self.places(subset), channels)

    def places(self, subset: Subset) -> tuple[Path, ...]:
        """As `Source.places`."""
        return {"train": self.train, "test": self.test, "guard": self.guard}[subset]

    def to_toml(self) -> dict[str, Any]:
        """As `Source.to_toml`."""
        return {
            "train": [str(path) for path in self.train],
            "test": [str(path) for path in self.test],
            "guard": [str(path) for path in self.guard] or None,
        }

    @property
    def has_test(self) -> bool:
        """As `Source.has_test`."""
        return bool(self.test)

    @property
    def guard_names(self) -> tuple[str, ...]:
        """As `Source.guard_names`."""
        return _names(self.guard)

    def check_openable(self) -> None:
        """As `Source.check_openable`."""
        for path in self.test:
            if not path.is_file():
                raise UserError(f"no such file: {path}; put the test data back")


def read_files(paths: Sequence[Path], channels: Channels) -> SourceData:
    """One record a file. Raises UserError."""
    found = [read_csv(path, *channels.names, channels.sampling_time) for path in paths]
    return SourceData(
        tuple(
            replace(record.trajectory, name=name)
            for record, name in zip(found, _names(paths), strict=True)
        ),
        warnings=tuple(w for record in found for w in record.warnings),
    )


def _names(paths: Sequence[Path]) -> tuple[str, ...]:
    """What the records are called: the file, with its folder where two files have one name."""
    stems = Counter(path.stem for path in paths)
    return tuple(p.stem if stems[p.stem] == 1 else f"{p.parent.name}/{p.stem}" for p in paths)
