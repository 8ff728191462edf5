"""Contents of a file before it becomes a record: named columns, or trees of named arrays."""

import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
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
    repeated: Mapping[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    """Names that several columns share, which are left out, with the names by which each can be
    had: those of groups of columns above them."""

    def repeated_text(self, name: str) -> str:
        """The sentence that refuses a shared name."""
        names = self.repeated[name]
        others = ", ".join(f"'{n}'" for n in names if n)
        return f"{len(names)} columns are named '{name}', " + (
            f"name one of {others}" if others else "rename all but one"
        )


@dataclass(frozen=True)
class Missing:
    """Samples that count as not measured: an entry of `[[data.missing]]`."""

    signal: str | None = None
    """Input or output; None for every one."""
    code: float | None = None
    """Value that marks a missing one."""
    min: float | None = None
    """Least value that the signal can have; likewise `max`."""
    max: float | None = None
    record: str | None = None
    """Record of `rows`, as `asia check` names it; None for every one."""
    rows: tuple[int, int] | None = None
    """First and last row of the record, 1-based."""

    def marks(self, values: Array) -> NDArray[np.bool_]:
        """Return where values are missing by the code and the range."""
        found = np.zeros(values.shape, np.bool_)
        if self.code is not None:
            found |= np.isclose(values, self.code, rtol=1e-9, atol=0.0)
        if self.min is not None:
            found |= values < self.min
        if self.max is not None:
            found |= values > self.max
        return found


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
    missing: tuple[Missing, ...] = ()
    """Samples that count as not measured."""
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
    if found is None and name in sheet.repeated:
        raise UserError(f"{sheet.where}: {sheet.repeated_text(name)}")
    if found is None:
        known = [c for c in sheet.columns if c]
        shown = ", ".join(known[:20]) + (f" and {len(known) - 20} more" if len(known) > 20 else "")
        raise UserError(
            f"{sheet.where} has no column '{name}' (it has {shown or 'none'})"
            f"{suggestion(name, known)}"
        )
    return sheet.columns[found]


def named_table(
    table: FileTable, labels: Sequence[str], columns: Sequence[Column], groups: Sequence[str] = ()
) -> FileTable:
    """The table with its columns by their names. Columns that share a name are known by the group
    above them and the name, where that is unique, and are left out otherwise.

    Args:
        groups: cells of the row above the names; an empty one continues the group to its left
    """
    count = Counter(labels)
    above: list[str] = []
    for group in groups or [""] * len(labels):
        above.append(group or (above[-1] if above else ""))
    joined = [
        f"{group} {label}" if count[label] > 1 and group else label
        for label, group in zip(labels, above, strict=True)
    ]
    unique = Counter(joined)
    found = {n: c for n, c in zip(joined, columns, strict=True) if n and unique[n] == 1}
    repeated = {
        label: tuple(
            n if n in found else "" for n, own in zip(joined, labels, strict=True) if own == label
        )
        for label in labels
        if label and count[label] > 1 and label not in found
    }
    return replace(table, columns=found, repeated=repeated)


def header_names(
    heads: Sequence[Sequence[str]], wanted: Sequence[str]
) -> tuple[list[str], list[str], list[str]]:
    """Names, units and groups of the columns.

    Args:
        heads: the rows above the data, the lowest last, at least one
        wanted: names that one of the rows has
    """
    hits = [sum(split_unit(c)[0] in wanted or c in wanted for c in row) for row in heads]
    # Without a name to go by, the names are in the row over the units.
    top = hits.index(max(hits)) if any(hits) else _likely_names(heads)
    labels = list(heads[top])
    under = heads[-1] if top < len(heads) - 1 else [""] * len(labels)
    units = [u.strip("[]() ") or split_unit(n)[1] for n, u in zip(labels, under, strict=True)]
    return labels, units, list(heads[top - 1]) if top else []


def _likely_names(heads: Sequence[Sequence[str]]) -> int:
    """The row of names: the last one where its cells are different and those above are groups, else
    the one over the units."""
    if len(heads) < 2:
        return 0
    above = [cell for cell in heads[-2] if cell]
    return (
        len(heads) - 1 if len(above) < len([cell for cell in heads[-1] if cell]) else len(heads) - 2
    )


def as_objects(values: Sequence[object]) -> Cells:
    """Cells of several kinds as one column."""
    cells = np.empty(len(values), dtype=object)
    cells[:] = values
    return cells
