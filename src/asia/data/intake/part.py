"""The wanted channels of a sheet as numbers, one part an experiment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from asia.data._trajectory import Array
from asia.data.intake.grid import JITTER, Rows, held
from asia.data.intake.numbers import to_numbers
from asia.data.intake.sheet import Column, Sheet, Wanted, find_channels, find_column, require_column
from asia.data.intake.stamps import seconds, time_column
from asia.errors import UserError


@dataclass(frozen=True)
class SheetPart:
    """u (T, nu) and y (T, ny), NaN where a value is missing; stamps (T,) in s, None without."""

    name: str
    u: Array
    y: Array
    timestamps: Array | None
    sampling_time: float | None
    where: str
    first_line: int
    is_file: bool = False
    """Whether it is the one record of its file."""


def expanded(sheet: Sheet, wanted: Wanted) -> Wanted:
    """Replace the name of a matrix by its columns."""

    def columns(names: Sequence[str]) -> tuple[str, ...]:
        found = [(n, find_channels(sheet.columns, n)) for n in names]
        return tuple(c for n, many in found for c in (many if len(many) > 1 else (n,)))

    inputs, outputs = columns(wanted.inputs), columns(wanted.outputs)
    return replace(wanted, inputs=inputs, outputs=outputs)


def parts(sheet: Sheet, wanted: Wanted) -> list[SheetPart]:
    """Raise UserError where a column is missing or holds no numbers."""
    for name in wanted.names:
        require_column(sheet, name)
    own = [require_column(sheet, n).seconds for n in (*wanted.inputs, *wanted.outputs)]
    whole = _one_clock(sheet, wanted) if any(s is None for s in own) else _merged(sheet, wanted)
    if wanted.experiment is None:
        return [whole]
    every = [_label(c) for c in require_column(sheet, wanted.experiment).cells]
    return [
        replace(
            whole,
            name=label,
            u=whole.u[rows],
            y=whole.y[rows],
            timestamps=None if whole.timestamps is None else whole.timestamps[rows],
            where=f"{whole.where}, experiment {label}",
        )
        for label, rows in _experiments(every)
    ]


def units(sheet: Sheet, names: Sequence[str]) -> dict[str, str]:
    """Units that the file gives."""
    found = {n: find_column(list(sheet.columns), n) for n in names}
    return {n: sheet.columns[c].unit for n, c in found.items() if c and sheet.columns[c].unit}


def _numbers(sheet: Sheet, names: Sequence[str]) -> list[Array]:
    return [
        to_numbers(require_column(sheet, n).cells, f"{sheet.where}, column '{n}'", sheet.first_line)
        for n in names
    ]


def _one_clock(sheet: Sheet, wanted: Wanted) -> SheetPart:
    lengths = {n: len(require_column(sheet, n).cells) for n in (*wanted.inputs, *wanted.outputs)}
    if len(set(lengths.values())) > 1:
        many = ", ".join(f"{n} {count}" for n, count in lengths.items())
        raise UserError(f"{sheet.where}: channels of unequal lengths and without times ({many})")
    u = np.stack(_numbers(sheet, wanted.inputs), axis=1)
    y = np.stack(_numbers(sheet, wanted.outputs), axis=1)
    time = time_column(sheet, wanted)
    timestamps = None if time is None else seconds(sheet, time, wanted)
    part = SheetPart(
        sheet.name, u, y, timestamps, sheet.sampling_time, sheet.where, sheet.first_line
    )
    if timestamps is None or np.isfinite(timestamps).all():
        return part
    rows = np.isfinite(timestamps)
    return replace(part, u=u[rows], y=y[rows], timestamps=timestamps[rows])


def _merged(sheet: Sheet, wanted: Wanted) -> SheetPart:
    """Channels with times of their own on those of the fastest: inputs held, outputs where they
    were measured."""
    names = (*wanted.inputs, *wanted.outputs)
    values = dict(zip(names, _numbers(sheet, names), strict=True))
    times = {n: require_column(sheet, n).seconds for n in names}
    axes = {n: t for n, t in times.items() if t is not None and len(t)}
    for name in names:
        if name not in axes:
            raise UserError(f"{sheet.where}: channel '{name}' has no samples")
    steps = {n: float(np.median(np.diff(t))) if len(t) > 1 else np.inf for n, t in axes.items()}
    quick = min(steps.values())
    # Inputs are held between stamps, outputs are not: an output's stamps serve best.
    leader = next(n for n in (*wanted.outputs, *wanted.inputs) if steps[n] <= quick * 1.01)
    first = max(float(axes[n][0]) for n in wanted.inputs)
    ends = [float(axes[n][-1]) + (steps[n] if n in wanted.inputs else 0.0) for n in axes]
    base = axes[leader]
    base = base[(base >= first - 1e-9) & (base <= min(ends) + 1e-9)]
    step = float(np.median(np.diff(base))) if len(base) > 1 else 1.0
    u = [held(axes[n], values[n][:, None], base)[:, 0] for n in wanted.inputs]
    y = [_placed(axes[n], values[n], base, step) for n in wanted.outputs]
    timestamps = np.round(base - base[0], 9) if len(base) else base
    return SheetPart(
        sheet.name,
        np.stack(u, axis=1),
        np.stack(y, axis=1),
        timestamps,
        sheet.sampling_time,
        sheet.where,
        1,
    )


def _placed(timestamps: Array, values: Array, at: Array, step: float) -> Array:
    """Place values at their measured times, NaN at all others."""
    if not len(at):
        return np.zeros(0)
    near = np.clip(np.searchsorted(timestamps, at), 1, max(len(timestamps) - 1, 1))
    near -= (at - timestamps[near - 1]) < (timestamps[np.minimum(near, len(timestamps) - 1)] - at)
    near = np.clip(near, 0, len(timestamps) - 1)
    return np.where(np.abs(timestamps[near] - at) <= JITTER * step, values[near], np.nan)


def labels(column: Column) -> list[str]:
    """Names of the experiments in a column, in the order in which they come up."""
    return [name for name in dict.fromkeys(map(_label, column.cells)) if name]


def _label(cell: object) -> str:
    if isinstance(cell, float | np.floating) and float(cell).is_integer():
        return str(int(cell))
    text = "" if cell is None else str(cell).strip()
    return "".join(c if c.isprintable() else "_" for c in text)


def _experiments(every: Sequence[str]) -> list[tuple[str, Rows]]:
    """Labels in the order in which they come up, and their rows. Rows without one are left out."""
    values = np.array(every, dtype=object)
    return [
        (name, np.flatnonzero(values == name).astype(np.int64))
        for name in dict.fromkeys(every)
        if name
    ]
