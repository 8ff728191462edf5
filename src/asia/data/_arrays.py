"""Records from arrays and data frames in memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from asia._nearest import suggestion
from asia.data._trajectory import Array, Signal, Trajectory
from asia.data.intake.sheet import find_column, split_unit
from asia.errors import UserError


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
    `u`, or `u1` and so on. first: the array or data frame of the first record."""
    if named is None:
        columns = [str(column) for column in getattr(first, "columns", ())]
        split = [Signal(*split_unit(column)) for column in columns]
        named = split if len({s.name for s in split}) == len(columns) else columns
    if not named:
        shape = np.shape(first)
        count = shape[1] if len(shape) > 1 else 1
        named = [letter] if count == 1 else [f"{letter}{k}" for k in range(1, count + 1)]
    return tuple(s if isinstance(s, Signal) else Signal(s) for s in named)


def make_trajectories(
    u: Sequence[Any],
    y: Sequence[Any],
    inputs: Sequence[Signal],
    outputs: Sequence[Signal],
    sampling_time: float,
    kind: str,
) -> tuple[Trajectory, ...]:
    """One record a pair of `u` and `y`, called `kind` and its number. Of a data frame the columns
    of the signals are taken. Raises UserError for what does not fit."""
    if len(u) != len(y):
        raise UserError(
            f"{len(u)} arrays of inputs, but {len(y)} of outputs to {kind}: give one of each a "
            "record"
        )
    return tuple(
        Trajectory(
            _columns(one, inputs, f"inputs of record '{kind}{k}'"),
            _columns(other, outputs, f"outputs of record '{kind}{k}'"),
            sampling_time,
            f"{kind}{k}",
        )
        for k, (one, other) in enumerate(zip(u, y, strict=True), 1)
    )


def _columns(values: Any, signals: Sequence[Signal], what: str) -> Array:
    names = [str(column) for column in getattr(values, "columns", ())]
    try:
        array = np.asarray(values.to_numpy() if names else values)
        # Of a data frame only the columns that are asked for need to be numbers.
        if names:
            array = array[:, [_index(names, s.name, what) for s in signals]]
        array = array.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise UserError(f"{what} do not read as numbers: {error}") from None
    array = array[:, None] if array.ndim == 1 else array
    if array.ndim != 2:
        raise UserError(
            f"{what}: expected an array (samples, channels), got shape {array.shape}; give a list "
            "of arrays for several records"
        )
    if array.shape[1] != len(signals):
        raise UserError(f"{what}: {array.shape[1]} channels, but {len(signals)} are named")
    return array


def _index(names: Sequence[str], name: str, what: str) -> int:
    found = find_column(names, name)
    if found is None:
        raise UserError(
            f"{what}: no column '{name}' (it has {', '.join(names)}){suggestion(name, names)}"
        )
    return names.index(found)
