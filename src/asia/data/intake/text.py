"""CSV and other text tables, and the numbers in their cells."""

import csv
import io
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from math import isinf, isnan, nan
from pathlib import Path
from typing import ClassVar

import numpy as np

from asia._files import read_file
from asia.data.intake.sheet import (
    Cells,
    Column,
    FileFormat,
    FileTable,
    Wanted,
    as_objects,
    header_names,
    named_table,
    split_unit,
)
from asia.data.trajectory import Array
from asia.errors import UserError

# Cells as numbers, the way people and instruments write them.


_MISSING = frozenset(
    ("", "nan", "na", "n/a", "n.a.", "#n/a", "#nv", "null", "none", "nil", "-", "--", "---", "?")
) | frozenset(
    # Texts of plant historians in place of a missing value.
    (".", "bad", "bad input", "bad data", "no data", "nodata", "i/o timeout", "comm fail",
     "out of service", "scan off", "pt created", "shutdown", "configure", "error", "invalid")
)  # fmt: skip
_MINUS = str.maketrans({"−": "-", "\u00a0": None, "\u202f": None, "'": None})


def to_numbers(cells: Cells, where: str, first_line: int) -> Array:
    """float64 with NaN where a value is missing.

    Args:
        where: file and column, for messages

    Raises:
        UserError: for a text that is no number, and for an infinite value
    """
    if cells.dtype.kind in "Mmc":
        raise UserError(f"{where} holds dates or complex numbers, expected real numbers")
    try:
        numbers = cells.astype(np.float64)
    except (TypeError, ValueError):
        numbers = np.empty(len(cells))
        for k, cell in enumerate(cells):
            value = number(cell)
            if value is None:
                raise UserError(
                    f"{where}, line {first_line + k}: '{cell}' is not a number: correct the cell, "
                    "or leave it empty where nothing was measured"
                ) from None
            numbers[k] = value
    bad = np.flatnonzero(np.isinf(numbers))
    if bad.size:
        raise UserError(
            f"{where}, line {first_line + int(bad[0])}: the value is infinite: leave the cell "
            "empty where nothing was measured"
        )
    return numbers


def number(cell: object) -> float | None:
    """One cell: NaN where it is missing, None where it is no number. A decimal comma, separators of
    thousands and Fortran's D are understood."""
    if cell is None:
        return nan
    if isinstance(cell, bool | int | float | np.number | Decimal):
        return float(cell)
    if not isinstance(cell, str):
        return None
    text = cell.strip().translate(_MINUS)
    if text.casefold() in _MISSING:
        return nan
    comma, point = text.rfind(","), text.rfind(".")
    if comma >= 0 and point >= 0:
        text = text.replace("," if point > comma else ".", "")
    text = text.replace(",", ".")
    if text.count(".") > 1 or "_" in text:
        return None
    try:
        return float(text)
    except ValueError:
        pass
    try:
        value = float(text.replace("d", "e").replace("D", "e"))
    except ValueError:
        return None
    return None if isinf(value) else value


# CSV and other tables of text.


# Rows from which the layout is found.
_SAMPLE = 400
_BLOCK = 2**20
_COMMENTS = ("#", "%", "//", "!")
_WITH_UNIT = re.compile(r"^[-+−]?\d[\d.,]*(?:[eE][-+]?\d+)?\s*(?P<unit>[^\d\s.,:/+-]\S{0,15})$")
_STAMP = re.compile(r"^[\dT:.,+\-/ Zampm]*\d[:/\-.]\d[\dT:.,+\-/ Zampm]*$", re.IGNORECASE)


@dataclass(frozen=True)
class _Layout:
    """Layout of the rows of a text file.

    Attributes:
        heads: rows of names and units, at most four
        above: cells of the line over the data, where it is no such row
        units: whether values may carry their unit
        share: share of the cells that are values
    """

    delimiter: str | None
    cells: int
    first: int
    heads: tuple[tuple[str, ...], ...]
    above: int
    units: bool
    share: float


class Text(FileFormat):
    """Tables of text: CSV with any usual separator, number and encoding."""

    name = "CSV"
    suffixes: ClassVar[tuple[str, ...]] = (".csv", ".txt", ".tsv", ".dat", ".asc")

    def read(self, path: Path, wanted: Wanted) -> tuple[FileTable, ...]:
        return (self.parse(path, read_file(path, "name a CSV file"), wanted),)

    def parse(self, path: Path, raw: bytes, wanted: Wanted) -> FileTable:
        """The content `raw` of a file called `path`. Raises UserError."""
        text = decode(path, raw)
        # The layout shows in the first lines: a long file is not cut into lines for it.
        lines = text.split("\n", 2000)[:2000]
        if sum(bool(line.strip()) and not _is_comment(line) for line in lines) < _SAMPLE:
            lines = text.split("\n")
        layout = _layout(path, lines, wanted)
        names, units, groups = _names(path, layout, wanted)
        # Labels of experiments are kept as they are written, such as 01.
        numbers = None if wanted.experiment else _numbers(text, lines, layout)
        if numbers is None:
            cells = zip(*_rows(path, text.split("\n"), layout), strict=True)
            found = [_column(c, unit) for c, unit in zip(cells, units, strict=True)]
        else:
            found = [Column(c, unit) for c, unit in zip(numbers.T, units, strict=True)]
        table = FileTable(path.stem, {}, None, str(path), layout.first + 1)
        return named_table(table, names, found, groups)


def _numbers(text: str, lines: Sequence[str], layout: _Layout) -> Array | None:
    """All cells of a table of plain numbers (rows, cells), read in blocks; None for any other."""
    body = text[sum(len(line) + 1 for line in lines[: layout.first]) :]
    if '"' in body or layout.units:
        return None
    if layout.delimiter != "," and "," in body:
        body = body.replace(",", ".")
    try:
        blocks = [
            np.loadtxt(io.StringIO(block), delimiter=layout.delimiter, ndmin=2, comments=None)
            for block in _blocks(body)
        ]
    except ValueError:
        return None
    if not blocks or any(block.shape[1] != layout.cells for block in blocks):
        return None
    # Whole numbers beyond double precision, such as stamps in ns, are kept as texts.
    if any(np.nanmax(np.abs(block), initial=0.0) >= 2.0**53 for block in blocks):
        return None
    return blocks[0] if len(blocks) == 1 else np.concatenate(blocks)


def _blocks(body: str) -> Iterator[str]:
    """Whole lines, about a megabyte at a time."""
    first = 0
    while first < len(body):
        end = body.find("\n", first + _BLOCK)
        end = len(body) if end < 0 else end
        if body[first:end].strip():
            yield body[first:end]
        first = end + 1


def _column(cells: Sequence[str], unit: str) -> Column:
    """Parse a column, without the unit where all values carry the same one."""
    filled = [c for c in cells if c and not isnan(number(c) or 0.0)]
    with_unit = None if not filled or _STAMP.match(filled[0]) else _WITH_UNIT.match(filled[0])
    behind = "" if with_unit is None else with_unit["unit"]
    if not behind or number(filled[0]) is not None or any(not c.endswith(behind) for c in filled):
        return Column(as_objects(cells), unit)
    bare = [c[: -len(behind)].rstrip() if c.endswith(behind) else c for c in cells]
    return Column(as_objects(bare), unit or behind)


def decode(path: Path, raw: bytes) -> str:
    """The content of a file as text. Raises UserError."""
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = raw.decode("utf-16", errors="replace")
    elif b"\0" in raw[:4000] and raw[1:4000:2].count(0) > len(raw[1:4000:2]) * 0.9:
        text = raw.decode("utf-16-le", errors="replace")
    else:
        try:
            text = raw.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = raw.decode("cp1252", errors="replace")
    if "\0" in text:
        raise UserError(f"{path} is not a text file: expected CSV, or name it after its format")
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if text.startswith("version https://git-lfs.github.com"):
        raise UserError(f"{path} is a pointer of git-lfs, not the data: run git lfs pull there")
    return text


def _cut(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split()
    if '"' not in line:
        return [cell.strip() for cell in line.split(delimiter)]
    row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    return [cell.strip() for cell in row]


def _is_value(cell: str, delimiter: str | None, units: bool = False) -> bool:
    if delimiter == "," and "," in cell and " " in cell:
        return False
    plain = number(cell) is not None or bool(_STAMP.match(cell))
    return plain or (units and bool(_WITH_UNIT.match(cell)))


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(_COMMENTS)


def _layout(path: Path, lines: Sequence[str], wanted: Wanted) -> _Layout:
    filled = [k for k, line in enumerate(lines) if line.strip() and not _is_comment(line)]
    if not filled:
        raise UserError(f"{path} is empty: expected a header row with column names, then numbers")
    for units in (False, True):
        tried = [
            _with_delimiter(lines, filled, d, units, wanted) for d in (",", ";", "\t", "|", None)
        ]
        found = [layout for layout in tried if layout is not None]
        if found:
            # The first of equals: max keeps it.
            return max(found, key=lambda layout: _rank(layout, wanted))
    raise UserError(f"{path} has a header row and no data below it: expected rows of numbers there")


def _rank(layout: _Layout, wanted: Wanted) -> tuple[int, float, int]:
    names = {split_unit(cell)[0] for row in layout.heads for cell in row}
    known = sum(name in names for name in wanted.names)
    return known + (layout.cells == len(wanted.columns)), layout.share, layout.cells


def _with_delimiter(
    lines: Sequence[str], filled: Sequence[int], delimiter: str | None, units: bool, wanted: Wanted
) -> _Layout | None:
    """The layout with this delimiter; None where no row is data."""
    sample = [(k, _cut(lines[k], delimiter)) for k in filled[:_SAMPLE]]
    data = [(k, row) for k, row in sample if _is_data(row, delimiter, units)]
    if not data:
        return None
    widths = Counter(len(row) for _, row in data)
    cells = max(widths, key=lambda w: (widths[w], w))
    first = _first(sample, {k for k, row in data if len(row) == cells})
    total = sum(len(row) for k, row in sample if k >= first)
    values = sum(_is_value(c, delimiter, units) for k, row in sample if k >= first for c in row)
    ends = all(not row[-1] for k, row in data if k >= first and len(row) == cells)
    heads = _heads(lines, first, cells, delimiter, units, ends=ends)
    names = next(row for k, row in sample if k == first)
    if not heads and wanted.names and set(wanted.names) <= set(names) and len(data) > 1:
        # Numbers may be names.
        heads = (tuple(names),)
        first = next(k for k, _ in data if k > first)
    above = [line for line in lines[:first] if line.strip()][-1:]
    width = len(_cut(above[0], delimiter)) if above and not heads else 0
    return _Layout(delimiter, cells, first, heads, width, units, values / max(total, 1))


def _first(sample: Sequence[tuple[int, Sequence[str]]], data: set[int]) -> int:
    """The line where data begins: behind it comes more, unlike behind a date over the header."""
    order = [k for k, _ in sample]
    for i, k in enumerate(order):
        behind = order[i + 1 : i + 4]
        if k in data and sum(n in data for n in behind) * 2 >= len(behind):
            return k
    return min(data)


def _is_data(row: Sequence[str], delimiter: str | None, units: bool) -> bool:
    values = [bool(cell) and _is_value(cell, delimiter, units) for cell in row]
    return sum(values) > 0 and sum(values) * 2 >= sum(bool(cell) for cell in row)


def _heads(
    lines: Sequence[str], first: int, cells: int, delimiter: str | None, units: bool, *, ends: bool
) -> tuple[tuple[str, ...], ...]:
    """Rows of names and units above the data, the lowest last.

    Args:
        ends: whether every row of data ends with a separator, which the rows above it may lack
    """
    found: list[tuple[str, ...]] = []
    for line in reversed(lines[:first]):
        if not line.strip():
            continue
        bare = line.lstrip().lstrip("#%/!").strip() if _is_comment(line) else line
        row = _cut(bare, delimiter)
        while len(row) > cells and not row[-1]:
            row.pop()
        if len(row) not in (cells, cells - ends) or _is_data(row, delimiter, units):
            if found:
                break
            continue
        found.insert(0, (*row, *[""] * (cells - len(row))))
        if len(found) == 4:
            break
    return tuple(found)


def _names(path: Path, layout: _Layout, wanted: Wanted) -> tuple[list[str], list[str], list[str]]:
    """Names, units and groups of the columns."""
    heads = layout.heads
    if wanted.columns:
        if len(wanted.columns) != layout.cells:
            raise UserError(
                f"{path} has {layout.cells} columns, but --columns names {len(wanted.columns)}: "
                "name every column, in the order of the file"
            )
        return list(wanted.columns), [""] * layout.cells, []
    if not heads and layout.above:
        raise UserError(
            f"{path}: the header has {layout.above} cells, the rows below it {layout.cells} cells "
            "each: write decimal points, not commas, in a comma-separated file"
        )
    if not heads:
        raise UserError(
            f"{path}: the first row holds numbers: add a header row with the column names, or "
            "give --columns"
        )
    return header_names(heads, wanted.names)


def _rows(path: Path, lines: Sequence[str], layout: _Layout) -> list[list[str]]:
    def value(cell: str) -> bool:
        return bool(cell) and _is_value(cell, layout.delimiter, layout.units)

    rows: list[list[str]] = []
    last = 0
    for k in range(layout.first, len(lines)):
        line = lines[k]
        if not line.strip() or _is_comment(line):
            continue
        row = _cut(line, layout.delimiter)
        while len(row) > layout.cells and not row[-1]:
            row.pop()
        if len(row) == layout.cells:
            if any(row):
                rows.append(row)
                last = len(rows) if any(map(value, row)) else last
        elif any(map(value, row)):
            raise UserError(
                f"{path}, line {k + 1}: {len(row)} cells where the rows above have "
                f"{layout.cells}; write decimal points, not commas, in a comma-separated file and "
                "give every row every cell"
            )
    # Lines of text after the data may have as many separators.
    return rows[:last]
