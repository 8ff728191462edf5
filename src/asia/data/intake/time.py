"""Time columns as seconds, and samples on one time grid."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta
from math import floor, log10

import numpy as np
from numpy.typing import NDArray

from asia.data.intake.sheet import FileTable, Wanted, find_column, require_column, split_unit
from asia.data.intake.text import to_numbers
from asia.data.trajectory import Array
from asia.errors import UserError

# Samples on one grid of time: sampling time, jitter and gaps.


Rows = NDArray[np.int64]
"""Numbers of rows, or of places on a grid."""

JITTER = 0.01
"""Share of the sampling time by which stamps may lie off the grid and still count as on it."""


@dataclass(frozen=True)
class Clock:
    """Time grid of a record.

    Attributes:
        step: sampling time, s
        jitter: distance from the grid that 99 % of the time stamps keep, as a share of it
        coarse: whether the time stamps are rounded to a resolution that explains the jitter
    """

    step: float
    jitter: float
    coarse: bool = False

    @property
    def regular(self) -> bool:
        """Whether the samples count as taken on the grid."""
        return self.jitter < JITTER or self.coarse


def runs(timestamps: Array, where: str, first_line: int, ignore: str) -> list[slice]:
    """Split the samples where time goes back.

    Args:
        ignore: advice on reading without the time stamps

    Raises:
        UserError: for repeated time stamps, and for rows in no order
    """
    back = np.flatnonzero(np.diff(timestamps) < 0) + 1
    # Records that begin anew are longer than ten samples: else the rows are in no order.
    if back.size > 0.1 * len(timestamps):
        raise UserError(
            f"{where}, line {first_line + int(back[0])}: time goes back, as in {back.size} of "
            f"{len(timestamps)} rows: sort the rows by time, or {ignore}"
        )
    edges = [0, *back.tolist(), len(timestamps)]
    found = [slice(a, b) for a, b in itertools.pairwise(edges)]
    same = np.flatnonzero(np.diff(timestamps) == 0)
    if same.size:
        raise UserError(
            f"{where}, line {first_line + int(same[0]) + 1}: the time stamp repeats the one before "
            f"({same.size} such rows): remove rows that were written twice, write stamps with more "
            f"digits, or {ignore}"
        )
    return found


def clock(timestamps: Array) -> Clock | None:
    """Estimate the clock of increasing time stamps, gaps among them; None for fewer than three."""
    if len(timestamps) < 3:
        return None
    typical = float(np.median(np.diff(timestamps)))
    count = _count(timestamps, typical)
    step, offset = typical, 0.0
    for _ in range(3):
        step, offset = (float(v) for v in np.polyfit(count, timestamps, 1))
        count = _count(timestamps, step)
    off = np.abs(timestamps - (offset + step * count))
    resolutions = (1.0, 0.1, 0.01, 1e-3, 1e-4, 1e-5, 1e-6)
    resolution = next(
        (r for r in resolutions if np.abs(timestamps / r - np.round(timestamps / r)).max() < 1e-3),
        0.0,
    )
    # So much the slope of a line may be off, through stamps that are off by so much at worst.
    doubt = 2.0 * float(np.quantile(off, 0.99)) / float(timestamps[-1] - timestamps[0])
    step = _round(step, max(min(doubt * step, JITTER * step), 1e-9 * step))
    jitter = float(np.quantile(off, 0.99)) / step
    coarse = resolution > 0 and resolution < 0.5 * step and float(off.max()) <= 0.75 * resolution
    return Clock(step, jitter, coarse)


def _count(timestamps: Array, step: float) -> Array:
    """Number of grid steps from the first stamp to each."""
    return np.concatenate([[0.0], np.cumsum(np.maximum(np.round(np.diff(timestamps) / step), 1.0))])


def _round(step: float, tolerance: float) -> float:
    """The roundest number, or rate, within the tolerance."""

    def digits(value: float, count: int) -> float:
        return round(value, count - 1 - floor(log10(abs(value))))

    for count in range(1, 8):
        for value in (digits(step, count), 1.0 / digits(1.0 / step, count)):
            if abs(value - step) <= tolerance:
                return value
    return step


def places(timestamps: Array, step: float) -> Rows:
    """The grid index of each stamp, from 0, for stamps near the grid."""
    return _count(timestamps, step).astype(np.int64)


def segments(index: Rows) -> list[slice]:
    """Split samples into segments without gaps on the grid."""
    breaks = np.flatnonzero(np.diff(index) != 1) + 1
    edges = [0, *breaks.tolist(), len(index)]
    return [slice(a, b) for a, b in itertools.pairwise(edges)]


def held(timestamps: Array, values: Array, at: Array) -> Array:
    """The last value at or before each time, as a zero-order hold gives it: (T, n) to (K, n)."""
    last = np.searchsorted(timestamps, at + 1e-9, side="right") - 1
    return values[np.maximum(last, 0)]


def between(timestamps: Array, values: Array, at: Array) -> Array:
    """Straight lines between neighbours; NaN where a neighbour is missing: (T, n) to (K, n)."""
    return np.stack([np.interp(at, timestamps, column) for column in values.T], axis=1)


# Columns of time as seconds.


TIME_UNITS = {
    "s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9,
    "min": 60.0, "h": 3600.0, "d": 86400.0, "days": 86400.0,
}  # fmt: skip
_NAMES = (
    "t", "time", "timestamp", "time stamp", "datetime", "date time", "date/time", "date", "zeit",
    "zeitstempel", "datum", "temps", "elapsed", "elapsed time", "clock", "__index_level_0__",
    "index",
)  # fmt: skip
_ENDINGS = {"_s": "s", "_sec": "s", "_ms": "ms", "_us": "us", "_ns": "ns"}
_PATTERNS = (
    "%d.%m.%Y %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S", "%d.%m.%Y %H:%M", "%Y/%m/%d %H:%M:%S.%f",
    "%Y/%m/%d %H:%M:%S", "%d-%b-%Y %H:%M:%S.%f", "%d-%b-%Y %H:%M:%S", "%d %b %Y %H:%M:%S.%f",
    "%d %b %Y %H:%M:%S",
)  # fmt: skip
_SLASHED = tuple(
    f"{day} %H:%M:%S{part}{half}"
    for day in ("%m/%d/%Y", "%d/%m/%Y")
    for part in (".%f", "")
    for half in ("", " %p")
)
_DAY = 86400.0
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def time_column(sheet: FileTable, wanted: Wanted) -> str | None:
    """Return the name of the column with the sample times; None without one. Raises UserError when
    the named column is missing or ambiguous."""
    if wanted.time == "none":
        return None
    if wanted.time is not None:
        require_column(sheet, wanted.time)
        return find_column(list(sheet.columns), wanted.time)
    named = {split_unit(name)[0].casefold(): name for name in reversed(list(sheet.columns))}
    taken = {find_column(list(sheet.columns), n) for n in wanted.names}
    for candidate in [*_NAMES, *(f"{n}{e}" for n in ("t", "time", "timestamp") for e in _ENDINGS)]:
        name = named.get(candidate)
        if name is not None and name not in taken and not _is_count(name, sheet):
            return name
    others = (n for n in sheet.columns if n not in taken and _holds_stamps(sheet, n))
    return next(others, None)


def _holds_stamps(sheet: FileTable, name: str) -> bool:
    """Return whether the first cells of a column are different dates or times of the day."""
    cells = sheet.columns[name].cells
    if cells.dtype.kind in "Mfiu":
        return cells.dtype.kind == "M"
    filled = [c for c in cells[:50] if c is not None and str(c).strip()]
    if not filled or not _is_dated(filled[0]):
        return False
    pattern: list[str] = []
    try:
        found = [_timestamp(cell, pattern, name) for cell in filled]
    except UserError:
        return False
    return len(set(found)) > 1


def _is_count(name: str, sheet: FileTable) -> bool:
    """Return whether an index only numbers the rows."""
    cells = sheet.columns[name].cells
    if name.casefold() not in ("index", "__index_level_0__") or len(cells) < 2:
        return False
    try:
        return bool((np.diff(cells.astype(np.float64)) == 1.0).all())
    except (TypeError, ValueError):
        return False


def seconds(sheet: FileTable, name: str, wanted: Wanted) -> Array:
    """The sample times in s after the first, to the nanosecond; NaN where a stamp is missing.
    Raises UserError."""
    column = sheet.columns[name]
    where = f"{sheet.where}, column '{name}'"
    cells = column.cells
    if cells.dtype.kind == "M":
        timestamps = cells.astype("datetime64[ns]")
        first = timestamps[~np.isnat(timestamps)][:1]
        if not first.size:
            raise UserError(f"{where}: no time stamp at all")
        found = (timestamps - first[0]).astype(np.float64) * 1e-9
        found[np.isnat(timestamps)] = np.nan
        return np.round(found, 9)
    filled = [c for c in cells[:50] if c is not None and str(c).strip()]
    if cells.dtype.kind not in "fiu" and filled and _is_dated(filled[0]):
        found = _dated(sheet, name, where)
    else:
        numbers = to_numbers(cells, where, sheet.first_line)
        found = numbers * _factor(numbers, name, column.unit, wanted)
    known = np.flatnonzero(np.isfinite(found))
    if not known.size:
        raise UserError(f"{where}: no time stamp at all")
    return np.round(found - found[known[0]], 9)


def _factor(numbers: Array, name: str, unit: str, wanted: Wanted) -> float:
    """s in one unit of the column."""
    bare, bracketed = split_unit(name)
    given = wanted.time_unit or unit or bracketed
    if not given:
        given = next((u for e, u in _ENDINGS.items() if bare.casefold().endswith(e)), "")
    if wanted.time_unit and given not in TIME_UNITS:
        raise UserError(f"--time-unit is {given}: expected one of {', '.join(TIME_UNITS)}")
    if given.casefold() in TIME_UNITS:
        return TIME_UNITS[given.casefold()]
    known = numbers[np.isfinite(numbers)]
    if not known.size:
        return 1.0
    low, high = float(known.min()), float(known.max())
    for least, factor in ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3)):
        if low > least:
            return factor
    dated = any(word in bare.casefold() for word in ("date", "stamp", "datum", "excel"))
    # Days as Excel and MATLAB count them.
    if dated and any(a < low and high < b for a, b in ((20_000, 80_000), (700_000, 800_000))):
        return _DAY
    # Without such a name: days of the years 2000 to 2050 that lie a round number of seconds apart,
    # while as seconds neither their distance nor its rate would be round.
    steps = np.diff(known)
    step = float(np.median(steps)) if steps.size else 0.0
    if low <= 36_526 or high >= 54_789 or step <= 0.0:
        return 1.0
    as_seconds = _is_round(step, 2) or _is_round(1.0 / step, 2)
    return _DAY if _is_round(step * _DAY, 3) and not as_seconds else 1.0


def _is_round(value: float, digits: int) -> bool:
    return abs(float(f"{value:.{digits}g}") - value) < 5e-4 * value


def _is_dated(cell: object) -> bool:
    if isinstance(cell, datetime | date | time | timedelta):
        return True
    text = str(cell).strip()
    return ":" in text or (text.count("-") == 2 and text[0] != "-") or text.count("/") == 2


def _dated(sheet: FileTable, name: str, where: str) -> Array:
    """Stamps in s after the first. In between they are µs, which a double holds exactly."""
    cells = sheet.columns[name].cells
    days = _days(sheet, name)
    pattern: list[str] = []
    found = np.array(
        [
            np.nan
            if cell is None or not str(cell).strip()
            else _timestamp(cell, pattern, f"{where}, line {sheet.first_line + k}")
            for k, cell in enumerate(cells)
        ]
    )
    if days is not None:
        found = found + days
    elif np.nanmax(found) < _DAY * 1e6:
        # A clock without a date begins anew at midnight.
        steps = np.diff(found, prepend=found[:1])
        found = found + _DAY * 1e6 * np.cumsum(steps < -_DAY / 2 * 1e6)
    return (found - found[np.isfinite(found)][0]) * 1e-6


def _days(sheet: FileTable, name: str) -> Array | None:
    """Days, in µs, of a date column next to a column with the time of the day; None without
    both."""
    first = next((c for c in sheet.columns[name].cells if c is not None and str(c).strip()), "")
    if isinstance(first, datetime) or any(mark in str(first) for mark in "-/T"):
        return None
    other = find_column(list(sheet.columns), "date") or find_column(list(sheet.columns), "Datum")
    if other is None or other == name:
        return None
    pattern: list[str] = []
    where = f"{sheet.where}, column '{other}'"
    found: list[float] = []
    for cell in sheet.columns[other].cells:
        day: object = cell
        if isinstance(cell, date) and not isinstance(cell, datetime):
            day = datetime(cell.year, cell.month, cell.day)
        elif not isinstance(cell, datetime):
            day = str(cell).strip()
            day = day if ":" in day else f"{day} 00:00:00"
        found.append(_timestamp(day, pattern, where))
    return np.array(found)


def _timestamp(cell: object, pattern: list[str], where: str) -> float:
    """One stamp in µs.

    Args:
        pattern: the one that the column was found to have, once it is known
    """
    if isinstance(cell, datetime):
        return _since_epoch(cell)
    if isinstance(cell, timedelta):
        return cell / timedelta(microseconds=1)
    if isinstance(cell, time):
        return (cell.hour * 3600 + cell.minute * 60 + cell.second) * 1e6 + cell.microsecond
    text = str(cell).strip().replace(",", ".")
    clock = _clock(text)
    if clock is not None:
        return clock
    if not pattern or pattern == ["iso"]:
        # `fromisoformat` reads at most six digits of a second; the others are added.
        head, point, tail = text.partition(".")
        digits = tail[: len(tail) - len(tail.lstrip("0123456789"))]
        try:
            timestamp = datetime.fromisoformat(f"{head}{point}{digits[:6]}{tail[len(digits) :]}")
        except ValueError:
            pass
        else:
            pattern[:] = ["iso"]
            beyond = float(f"0.{digits[6:]}") if len(digits) > 6 else 0.0
            return _since_epoch(timestamp) + beyond
    for shape in pattern or [*_PATTERNS, *_SLASHED]:
        try:
            timestamp = _since_epoch(datetime.strptime(text, shape))
        except ValueError:
            continue
        pattern[:] = [shape]
        return timestamp
    raise UserError(
        f"{where}: '{cell}' is not a time stamp like the others: write 2026-01-31T12:00:00.250"
    )


def _clock(text: str) -> float | None:
    """`12:30:01.5`, `30:01.5` and `01:30:01 PM` as µs."""
    half = text[-2:].casefold()
    if half in ("am", "pm"):
        clock = _clock(text[:-2].strip())
        noon = _DAY / 2 * 1e6
        return None if clock is None else clock % noon + (noon if half == "pm" else 0.0)
    parts: Sequence[str] = text.split(":")
    if not 2 <= len(parts) <= 3:
        return None
    try:
        values = [float(part) for part in parts]
    except ValueError:
        return None
    return round(1e6 * sum(v * 60.0**k for k, v in enumerate(reversed(values))), 3)


def _since_epoch(timestamp: datetime) -> float:
    if timestamp.tzinfo is None:
        timestamp = timestamp.replace(tzinfo=UTC)
    return float((timestamp - _EPOCH) // timedelta(microseconds=1))
