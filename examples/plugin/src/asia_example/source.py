"""Records in text files whose columns are separated by spaces, as many test benches write them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

import numpy as np

from asia.data import Trajectory
from asia.data.sources import Channels, DataSet, DataTable, SourceData, Subset
from asia.errors import UserError


@dataclass(frozen=True)
class Tables(DataSet):
    """`data.source = "tables:FOLDER"`: one record a file, `FOLDER/train/*.dat` and
    `FOLDER/test/*.dat`. The first line has the names of the columns."""

    @classmethod
    def from_table(cls, table: DataTable, root: Path) -> Self:
        """As `Source.from_table`."""
        found = super().from_table(table, root)
        return cls(f"tables:{(root / found.argument).resolve()}", found.guard)

    def load(self, subset: Literal["train", "test"], channels: Channels) -> SourceData:
        """As `DataSet.load`."""
        files = self._files(subset)
        if not files and subset == "train":
            raise UserError(f"no .dat files in {self._folder('train')}: bring records to train on")
        return SourceData(tuple(_read(file, channels) for file in files))

    def places(self, subset: Subset) -> tuple[Path, ...]:
        """As `Source.places`."""
        return self._files("test" if subset == "test" else "train")

    @property
    def has_test(self) -> bool:
        """As `Source.has_test`."""
        return bool(self._files("test"))

    def _folder(self, subset: str) -> Path:
        return Path(self.argument) / subset

    def _files(self, subset: str) -> tuple[Path, ...]:
        return tuple(sorted(self._folder(subset).glob("*.dat")))


def _read(file: Path, channels: Channels) -> Trajectory:
    try:
        with file.open(encoding="utf-8") as lines:
            names = lines.readline().split()
            values = np.loadtxt(lines, ndmin=2)
    except (OSError, ValueError) as error:
        raise UserError(f"cannot read {file}: {error}") from error
    inputs, outputs = channels.names
    for name in (*inputs, *outputs):
        if name not in names:
            raise UserError(f"{file} has no column '{name}'; it has {', '.join(names)}")
    u = values[:, [names.index(name) for name in inputs]]
    y = values[:, [names.index(name) for name in outputs]]
    return Trajectory(u, y, channels.sampling_time, file.stem)
