"""Contents of a file before it becomes a record: named columns, or trees of named arrays."""

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from asia._text import suggestion
from asia.data.trajectory import Array
from asia.errors import UserError

Cells = NDArray[Any]
"""One column: float64, datetime64, or objects that are texts, numbers, dates or None."""

_UNIT = re.compile(r"^(?P<name>.*?\S)\s*(?:\[(?P<square>[^\]]*)\]|\((?P<round>[^)]*)\))\s*$")


@dataclass(frozen=True)
class Column:
    """The cells of one channel."""

    cells: Cells
    unit: str = ""
    seconds: Array | None = None
    """Sample times of this column, s, where the channels of a file have several."""
    matrix: str = ""
    """Name of the matrix that the channel is a column of."""


@dataclass(frozen=True)
class FileTable:
    """Columns of equal length, unless they have times of their own."""

    name: str
    columns: Mapping[str, Column]
    sampling_time: float | None = None
    where: str = ""
    """The file, and the part of it, for messages."""
    first_line: int = 1
    """Line or row number of the first sample, for messages."""


@dataclass(frozen=True)
class Wanted:
    """Options for reading a file."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    time: str | None = None
    """Column with the sample times; found by its name where None, and not used where "none"."""
    time_unit: str | None = None
    """Unit of numeric sample times; found where None."""
    experiment: str | None = None
    """Column whose value names the experiment of a row."""
    columns: tuple[str, ...] = ()
    """Names of the columns of a file without a header."""
    progress: Callable[[str], None] = field(default=lambda text: None, compare=False)
    """Callback for the progress of a long read, in words."""
    time_step: int | None = None
    """Place among the inputs of the time to the next sample, which is computed; records are then
    taken as they were sampled."""

    @property
    def names(self) -> tuple[str, ...]:
        """All columns that must be there, but for the time."""
        more = (self.experiment,) if self.experiment else ()
        return (*self.inputs, *self.outputs, *more)


class FileFormat(ABC):
    """A kind of file. One subclass a format."""

    name: ClassVar[str]
    suffixes: ClassVar[tuple[str, ...]]
    """File name suffixes, in lower case; "/" is a folder."""

    @abstractmethod
    def read(self, path: Path, wanted: Wanted) -> tuple[FileTable, ...]:
        """Read the tables that have the wanted columns.

        Where none has, return one with the existing columns, so that the message can name them.
        Raises UserError when the file cannot be read.
        """

    def columns(self, path: Path) -> Mapping[str, str]:
        """Names and units of all columns, in the order of the file. Raises UserError."""
        found: dict[str, str] = {}
        for sheet in self.read(path, Wanted((), ())):
            found |= {name: column.unit for name, column in sheet.columns.items()}
        return found


def split_unit(label: str) -> tuple[str, str]:
    """`pump [V]` and `pump (V)` as name and unit."""
    match = _UNIT.match(label.strip())
    if match is None:
        return label.strip(), ""
    return match["name"], (match["square"] or match["round"] or "").strip()


def find_column(columns: Sequence[str], name: str) -> str | None:
    """The column of that name, with its unit or without, in capitals or not; None without one."""
    if name in columns:
        return name
    bare = [c for c in columns if split_unit(c)[0] == name]
    if not bare:
        bare = [c for c in columns if split_unit(c)[0].casefold() == name.casefold()]
    return bare[0] if len(bare) == 1 else None


def find_channels(columns: Mapping[str, Column], name: str) -> tuple[str, ...]:
    """The column of that name, or all columns of the matrix of that name; () without either."""
    one = find_column(list(columns), name)
    if one is not None:
        return (one,)
    return tuple(n for n, c in columns.items() if c.matrix and c.matrix == name)


def require_column(sheet: FileTable, name: str) -> Column:
    """Return the column of this name. Raises UserError naming the existing columns, when it is
    missing."""
    found = find_column(list(sheet.columns), name)
    if found is None:
        known = [c for c in sheet.columns if c]
        shown = ", ".join(known[:20]) + (f" and {len(known) - 20} more" if len(known) > 20 else "")
        raise UserError(
            f"{sheet.where} has no column '{name}' (it has {shown or 'none'})"
            f"{suggestion(name, known)}"
        )
    return sheet.columns[found]


def as_objects(values: Sequence[object]) -> Cells:
    """Cells of several kinds as one column."""
    cells = np.empty(len(values), dtype=object)
    cells[:] = values
    return cells
