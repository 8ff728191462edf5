"""Records from CSV files, by column name."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import numpy as np

from asia._files import read_file
from asia._nearest import suggestion
from asia.data._trajectory import Array, Trajectory
from asia.errors import UserError

_DELIMITERS = (",", ";", "\t")
_GAPS = ("", "nan")
_BLOCK = 2**20
_TIME_NAMES = ("t", "time", "t_s", "time_s", "t [s]", "time [s]", "timestamp")


@dataclass(frozen=True)
class _File:
    """A CSV file as text: where the data rows begin, and how columns are found in them."""

    path: Path
    delimiter: str
    columns: tuple[str, ...]
    header: str
    header_line: int
    body: str


@dataclass(frozen=True)
class CsvTrajectory:
    """A record and doubts about its time column, in plain words."""

    trajectory: Trajectory
    warnings: tuple[str, ...]


def read_csv(
    path: Path,
    inputs: Sequence[str],
    outputs: Sequence[str],
    sampling_time: float,
    content: bytes | None = None,
) -> CsvTrajectory:
    """The columns named, in that order, of the file or of `content`. One header row; `,` `;` or tab
    between cells; a decimal comma is understood where it is not the delimiter. A column named t or
    time is compared with `sampling_time` (s). An output may be missing: `nan`, or an empty
    cell but for the last. Raises UserError naming file, line and column."""
    wanted = [*inputs, *outputs]
    file = _open(path, wanted, content)
    time = next((c for c in file.columns if c.casefold() in _TIME_NAMES and c not in wanted), None)
    columns = [_index(file, name) for name in wanted]
    values = _numbers(file, columns, frozenset(columns[len(inputs) :]))
    trajectory = Trajectory(
        values[:, : len(inputs)], values[:, len(inputs) :], sampling_time, path.stem
    )
    warnings = () if time is None else _time_warnings(file, time, sampling_time)
    return CsvTrajectory(trajectory, (*warnings, *_missing_words(trajectory, path, outputs)))


def split_csv(path: Path, wanted: Sequence[str], share: float) -> tuple[str, str]:
    """The file as two texts with its header, all columns kept: the first rows, and the last
    `share` (0 to 1) of them. Raises UserError when there is no header with data below it."""
    file = _open(path, wanted)
    header = file.header
    rows = [line for line in file.body.split("\n") if line.strip()]
    keep = len(rows) - round(share * len(rows))
    return (
        "\n".join([header, *rows[:keep], ""]),
        "\n".join([header, *rows[keep:], ""]),
    )


def _open(path: Path, wanted: Sequence[str], content: bytes | None = None) -> _File:
    text = _text(path, read_whole(path) if content is None else content)
    # Line by line only as far as needed: a long file is held once, as text.
    first, line = 0, 0
    while first < len(text) and not text[first : _line_end(text, first)].strip():
        first, line = _line_end(text, first) + 1, line + 1
    if first >= len(text):
        raise UserError(f"{path} is empty: expected a header row with column names, then numbers")
    begin = _line_end(text, first) + 1
    written = text[first : begin - 1]
    header = written.removeprefix("#")
    layouts = {d: _cells(header, d) for d in _DELIMITERS}

    def quality(delimiter: str) -> tuple[int, int]:
        names = layouts[delimiter]
        return sum(name in names for name in wanted), len(names)

    delimiter = max(_DELIMITERS, key=quality)
    end = len(text)
    while end > begin:
        last = text.rfind("\n", begin, end)
        if text[max(last + 1, begin) : end].replace(delimiter, "").strip():
            break
        end = last if last >= begin else begin
    if end <= begin:
        raise UserError(f"{path} has a header row and no data below it")
    return _File(path, delimiter, layouts[delimiter], written, line + 1, text[begin:end])


def _line_end(text: str, first: int) -> int:
    end = text.find("\n", first)
    return len(text) if end < 0 else end


def read_whole(path: Path) -> bytes:
    """The bytes of a file. Raises UserError."""
    return read_file(path, "name a CSV file")


def _text(path: Path, raw: bytes) -> str:
    try:
        if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
            text = raw.decode("utf-16")
        else:
            text = raw.decode("utf-8-sig" if b"\0" not in raw else "ascii", errors="strict")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    if "\0" in text:
        raise UserError(f"{path} is not a text file: expected CSV with a header row")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _cells(line: str, delimiter: str) -> tuple[str, ...]:
    row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    return tuple(cell.strip() for cell in row)


def _index(file: _File, name: str) -> int:
    count = file.columns.count(name)
    if count == 1:
        return file.columns.index(name)
    if count > 1:
        raise UserError(f"{file.path}: {count} columns are named '{name}', rename all but one")
    if _has_numbers_for_header(file):
        raise UserError(
            f"{file.path}: the first row holds numbers: add a header row with the column names"
        )
    known = [column for column in file.columns if column]
    raise UserError(
        f"{file.path} has no column '{name}' (it has {', '.join(known)}){suggestion(name, known)}"
    )


def _has_numbers_for_header(file: _File) -> bool:
    # The delimiter was guessed from names: among numbers it may be taken for a decimal comma.
    layouts = ((d, [c for c in _cells(file.header, d) if c]) for d in _DELIMITERS)
    return any(cells and all(_doubt(c, d) is None for c in cells) for d, cells in layouts)


def _missing_words(record: Trajectory, path: Path, outputs: Sequence[str]) -> tuple[str, ...]:
    if record.missing is None:
        return ()
    counts = zip(outputs, record.missing.sum(axis=0).tolist(), strict=True)
    each = ", ".join(f"'{name}' at {count}" for name, count in counts if count)
    return (f"{path.name}: not measured: {each} of {len(record)} samples, which do not count",)


def _numbers(file: _File, columns: Sequence[int], gaps: frozenset[int] = frozenset()) -> Array:
    """gaps: columns in which a value may be missing; it is NaN then."""
    body = file.body
    if file.delimiter != "," and "," in body:
        body = body.replace(",", ".")
    values = _loaded(file, body, columns, None)
    if values is None and gaps:
        # Only a reader that is asked cell by cell takes an empty one, which is slow.
        values = _loaded(file, body, columns, dict.fromkeys(gaps, _number_or_gap))
    if (
        values is None
        or _is_ragged(file, len(values))
        or not _is_known(values, columns, gaps)
        or _ends_early(file, values, columns)
    ):
        raise UserError(_diagnosis(file, columns, gaps))
    return values


def _loaded(
    file: _File,
    body: str,
    columns: Sequence[int],
    converters: Mapping[int, Callable[[str], float]] | None,
) -> Array | None:
    parts: list[Array] = []
    try:
        for block in _blocks(body):
            parts.append(
                np.loadtxt(
                    io.StringIO(block),
                    delimiter=file.delimiter,
                    usecols=columns,
                    ndmin=2,
                    comments=None,
                    quotechar='"',
                    converters=None if converters is None else {**converters},
                )
            )
    except ValueError:
        return None
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _blocks(body: str) -> Iterator[str]:
    """Whole lines of about a megabyte; all at once of a file with quoted cells, which may hold line
    ends."""
    first, size = 0, len(body) if '"' in body else _BLOCK
    while first < len(body):
        end = _line_end(body, first + size)
        if body[first:end].strip():
            yield body[first:end]
        first = end + 1


def _number_or_gap(cell: str) -> float:
    return float(cell) if cell.strip() else float("nan")


def _is_known(values: Array, columns: Sequence[int], gaps: frozenset[int]) -> bool:
    """No infinite value, and no missing one where none may be."""
    needed = [place for place, column in enumerate(columns) if column not in gaps]
    return bool(np.isfinite(values[:, needed]).all() and not np.isinf(values).any())


def _ends_early(file: _File, values: Array, columns: Sequence[int]) -> bool:
    """Whether a column is empty at the end: it belongs to a shorter record. `nan` is no end."""
    if not np.isnan(values[-1]).any():
        return False
    last = _cells(file.body.rsplit("\n", 1)[-1], file.delimiter)
    return any(index >= len(last) or not last[index] for index in columns)


def _is_ragged(file: _File, rows: int) -> bool:
    """A decimal comma in a comma-separated file shifts columns without any other sign."""
    if '"' in file.body:
        return any(not _fits(file, cells) for _, cells in _rows(file))
    separators = file.body.count(file.delimiter)
    regular = rows * (len(file.columns) - 1)
    # One delimiter more at a line's end does no harm.
    ends = file.body.endswith(file.delimiter)
    trailing = file.body.count(f"{file.delimiter}\n") + int(ends)
    return separators not in (regular, regular + trailing)


def _fits(file: _File, cells: Sequence[str]) -> bool:
    extra = len(cells) - len(file.columns)
    return extra == 0 or (extra == 1 and not cells[-1])


def _rows(file: _File, first: int = 0) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Line numbers and cells of the rows that are not blank, from line `first` on."""
    quoted = '"' in file.body
    for number, line in enumerate(file.body.split("\n"), file.header_line + 1):
        if number < first or not line.strip():
            continue
        if quoted:
            yield number, _cells(line, file.delimiter)
        else:
            yield number, tuple(cell.strip() for cell in line.split(file.delimiter))


def _diagnosis(file: _File, columns: Sequence[int], gaps: frozenset[int]) -> str:
    rows = list(_rows(file))
    ends = {index: _end(rows, index) for index in columns}
    for line, cells in rows:
        if not _fits(file, cells):
            return (
                f"{file.path}, line {line}: {len(cells)} cells where the header has "
                f"{len(file.columns)} columns; write decimal points, not commas, in a "
                "comma-separated file and give every row every cell"
            )
        for index in columns:
            doubt = _doubt(cells[index], file.delimiter)
            if doubt is None:
                continue
            name = file.columns[index]
            if not cells[index] and line >= ends[index]:
                return (
                    f"{file.path}: unequal lengths, column '{name}' ends before line {line} "
                    f"but the file goes on to line {rows[-1][0]}: cut the file there"
                )
            if index in gaps and line < ends[index] and cells[index].casefold() in _GAPS:
                continue
            return f"{file.path}, line {line}, column '{name}': {doubt}"
    return f"{file.path}: the rows below the header do not read as numbers"


def _end(rows: Sequence[tuple[int, tuple[str, ...]]], index: int) -> int:
    """The line from which on all cells of a column are empty."""
    end = rows[-1][0] + 1
    for line, cells in reversed(rows):
        if index < len(cells) and cells[index]:
            break
        end = line
    return end


def _doubt(cell: str, delimiter: str) -> str | None:
    if not cell:
        return "the cell is empty; fill the gap or cut the record there"
    text = cell if delimiter == "," else cell.replace(",", ".")
    try:
        number = float(text)
    except ValueError:
        return f"'{cell}' is not a number"
    if not isfinite(number):
        return f"the value is missing or infinite ('{cell}'); fill the gap or cut the record there"
    return None


def _time_warnings(file: _File, name: str, sampling_time: float) -> tuple[str, ...]:
    where = f"{file.path.name}: time column '{name}'"
    try:
        time = _numbers(file, [_index(file, name)])[:, 0]
    except UserError:
        return (f"{where} does not read as numbers and was not compared with sampling_time",)
    if len(time) < 2:
        return ()
    steps = np.diff(time)
    typical = float(np.median(steps))
    if (steps <= 0).any():
        line = int(np.argmax(steps <= 0)) + file.header_line + 2
        return (f"{where} does not increase at line {line}",)
    if abs(typical - sampling_time) > 0.01 * sampling_time:
        return (f"{where} steps by {typical:g}, but sampling_time is {sampling_time:g} s",)
    if steps.max() > 1.5 * typical:
        line = int(np.argmax(steps)) + file.header_line + 2
        return (f"{where} has a gap of {steps.max():g} s at line {line}",)
    return ()
