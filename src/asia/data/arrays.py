"""Records from arrays and data frames in memory."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import date
from typing import Any

import numpy as np

from asia._text import suggestion
from asia.data.intake.conversion import Intake, TablePart, Use, make_records
from asia.data.intake.sheet import Column, FileTable, Wanted, find_column, split_unit
from asia.data.intake.time import JITTER
from asia.data.intake.timestamps import Timeline, read_times, time_column
from asia.data.trajectory import Array, Signal, real_numbers
from asia.errors import UserError

_IGNORE_INDEX = "drop the index (reset_index(drop=True)) and give sampling_time"


def one_a_record(values: Any) -> list[Any]:
    """The arrays of a list of arrays; a single array, data frame or list of numbers is one
    record."""
    several = isinstance(values, (list, tuple)) and any(
        len(getattr(v, "shape", ())) for v in values
    )
    return list(values) if several else [values]


def name_signals(
    named: Sequence[str | Signal] | None, first: Any, letter: str
) -> tuple[Signal, ...]:
    """Signals by name, as given, or after the columns of a data frame, `u [V]` with its unit, or
    `u`, or `u1` and so on.

    Args:
        first: the array or data frame of the first record
    """
    if named is None:
        columns = [str(column) for column in getattr(first, "columns", ())]
        split = [Signal(*split_unit(column)) for column in columns]
        named = split if len({s.name for s in split}) == len(columns) else columns
    if not named:
        shape = np.shape(first)
        count = shape[1] if len(shape) > 1 else 1
        named = [letter] if count == 1 else [f"{letter}{k}" for k in range(1, count + 1)]
    return tuple(s if isinstance(s, Signal) else Signal(s) for s in named)


def read_arrays(
    u: Sequence[Any],
    y: Sequence[Any],
    inputs: Sequence[Signal],
    outputs: Sequence[Signal],
    sampling_time: float | None,
    kind: str,
    use: Use = "train",
    least: int = 1,
) -> Intake:
    """Read one record from each pair of `u` and `y` by the rules for files.

    The columns of the signals are taken out of data frames. Their index gives the time stamps:
    dates, or numbers in seconds.

    Args:
        kind: prefix of the record names, followed by a number
        sampling_time: s; None for that of the time stamps

    Raises:
        UserError: for arrays that do not fit the signals or each other
    """
    if len(u) != len(y):
        raise UserError(
            f"{len(u)} arrays of inputs, but {len(y)} of outputs to {kind}: give one of each a "
            "record"
        )
    if sampling_time is not None and not sampling_time > 0:
        raise UserError(f"sampling_time is {sampling_time:g} s, expected more than 0")
    parts = [
        _part(one, other, inputs, outputs, f"{kind}{k}")
        for k, (one, other) in enumerate(zip(u, y, strict=True), 1)
    ]
    if not parts:
        return Intake(())
    if sampling_time is None and all(p.timestamps is None or len(p.timestamps) < 3 for p in parts):
        raise UserError("the sampling time is not known: give sampling_time=..., in seconds")
    return make_records(parts, use, sampling_time, least, _IGNORE_INDEX)


def _part(
    u: Any, y: Any, inputs: Sequence[Signal], outputs: Sequence[Signal], name: str
) -> TablePart:
    us = _columns(u, inputs, f"inputs of record '{name}'")
    ys = _columns(y, outputs, f"outputs of record '{name}'")
    if len(us) != len(ys):
        raise UserError(
            f"record '{name}': {len(us)} input samples but {len(ys)} output samples; both need the "
            "same length"
        )
    where = f"record '{name}'"
    for what, values in (("inputs", us), ("outputs", ys)):
        if np.isinf(values).any():
            row, column = (int(k) for k in np.argwhere(np.isinf(values))[0])
            raise UserError(
                f"{what} of record '{name}': the value at sample {row + 1}, channel {column + 1} "
                "is infinite: write NaN where nothing was measured"
            )
    own = [found for v in (u, y) if (found := _time_index(v, where)) is not None]
    if len(own) == 2:
        _check_same_times(own[0], own[1])
    line = _times(own[0]) if own else None
    timestamps = None if line is None else line.seconds
    if timestamps is not None and not np.isfinite(timestamps).all():
        rows = np.isfinite(timestamps)
        us, ys, timestamps = us[rows], ys[rows], timestamps[rows]
    text = "" if line is None else line.text
    return TablePart(name, us, ys, timestamps, None, where, 1, is_file=True, time=text)


def _time_index(values: Any, where: str) -> FileTable | None:
    """The index of a data frame as a sheet of one column, where it is a time."""
    index = getattr(values, "index", None)
    if index is None or callable(index) or not len(index):
        return None
    name = str(getattr(index, "name", None) or "")
    # Dates with a time zone come as objects.
    cells = np.asarray(index)
    if cells.dtype.kind == "m":
        cells = cells.astype("timedelta64[ns]").astype(np.float64) * 1e-9
        return FileTable(where, {"seconds": Column(cells, "s")}, where=where)
    sheet = FileTable(where, {name or "index": Column(cells)}, where=where)
    is_named = bool(name) and time_column(sheet, Wanted((), ())) is not None
    if cells.dtype.kind in "Mf" or is_named or isinstance(cells[0], date):
        return sheet
    return None


def _times(sheet: FileTable) -> Timeline:
    return read_times(sheet, next(iter(sheet.columns)), Wanted((), ()))


def _check_same_times(u: FileTable, y: FileTable) -> None:
    """Raise UserError where inputs and outputs were not sampled at the same times."""
    where = u.where
    (name, first_column), (_, second_column) = (next(iter(s.columns.items())) for s in (u, y))
    cells = first_column.cells, second_column.cells
    kinds = [c.dtype.kind in "fiu" for c in cells]
    if kinds[0] != kinds[1]:
        raise UserError(f"{where}: one of u and y has dates as its index, the other has numbers")
    both = replace(first_column, cells=np.concatenate(cells))
    timestamps = _times(replace(u, columns={name: both})).seconds
    first, second = timestamps[: len(cells[0])], timestamps[len(cells[0]) :]
    step = float(np.median(np.diff(first))) if len(first) > 1 else 1.0
    apart = np.abs(second - first)
    if np.nanmax(apart) > JITTER * abs(step):
        row = int(np.nanargmax(apart > JITTER * abs(step)))
        raise UserError(
            f"{where}: the time index of y is {apart[row]:g} s away from that of u at row "
            f"{row + 1}: cut both to the same times"
        )


def _columns(values: Any, signals: Sequence[Signal], what: str) -> Array:
    names = [str(column) for column in getattr(values, "columns", ())]
    try:
        # Missing values of data frames are NaN, whatever marks them.
        options = {"na_value": np.nan} if hasattr(values, "iloc") else {}
        array = values.to_numpy(**options) if names else values
        # Of a data frame only the columns that are asked for need to be numbers.
        if names:
            found = [find_column(names, s.name) for s in signals]
            if None in found:
                missing = signals[found.index(None)].name
                raise UserError(
                    f"{what}: no column '{missing}' (it has {', '.join(names)})"
                    f"{suggestion(missing, names)}"
                )
            for name in found:
                if names.count(str(name)) > 1:
                    raise UserError(f"{what}: {names.count(str(name))} columns are named '{name}'")
            array = array[:, [names.index(name) for name in found if name is not None]]
    except (TypeError, ValueError) as error:
        raise UserError(f"{what} do not read as numbers: {error}") from None
    array = real_numbers(array, what)
    array = array[:, None] if array.ndim == 1 else array
    if array.ndim != 2:
        raise UserError(
            f"{what}: expected an array (samples, channels), got shape {array.shape}; give a list "
            "of arrays for several records"
        )
    if array.shape[1] != len(signals):
        raise UserError(f"{what}: {array.shape[1]} channels, but {len(signals)} are named")
    return array
