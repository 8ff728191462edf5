"""Fit of a linear system and its initial states to records with periodic inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from asia.candidate import Context
from asia.data import Array
from asia.models._config import Progress
from asia.models._data.cuts import Indices, spread
from asia.models._data.encoder import Encoder, fit_encoder
from asia.models._data.records import ScaledData, past_length, windows_before
from asia.models._least_squares import LevenbergMarquardt
from asia.models._linear.periodic.least_squares import error, refined, with_inputs
from asia.models._linear.periodic.lines import (
    FEWEST_LINES,
    ExcitedLines,
    SteadyRecord,
    lines_of,
    steady_records,
)
from asia.models._linear.periodic.modes import in_blocks, resolvent
from asia.models._linear.periodic.subspace import observability
from asia.models._linear.system import LinearSystem

# Step of the lines left out while the order is chosen.
_EVERY = 3
# Limits on the past windows of the encoder: in numbers, and in windows.
_WINDOW_NUMBERS, _MOST_WINDOWS = 6_000_000, 20_000
# Relative step between orders that are tried.
_STEP = 0.12


@dataclass(frozen=True)
class PeriodicChoice:
    """Order, or limits of its choice."""

    order: int | None
    """Number of states; None takes the smallest whose error at lines left out is near the least."""
    most: int
    """Greatest order tried."""
    tolerance: float
    """Relative tolerance of that choice, of the root."""


def fit_periodic(
    records: ScaledData,
    context: Context,
    choice: PeriodicChoice,
    iterations: int,
    log: Progress | None = None,
) -> tuple[LinearSystem, Encoder] | None:
    """Fit a system and the map from past windows to states.

    Returns:
        None where the records are not periodic, not in steady state or too short for the order.
    """
    steady = steady_records(records)
    if steady is None:
        return None
    lines = lines_of(steady)
    if len(lines.z) < FEWEST_LINES:
        return None
    order = choice.order or _chosen_order(lines, choice.most, choice.tolerance)
    found = None if order is None else _started(lines, [order]).get(order)
    if found is None:
        return None
    method = LevenbergMarquardt(iterations, damping=1e-3, tolerance=3e-4)
    found = refined(lines, found, method, log)
    found = _with_offset(found, steady)
    states = [_steady_states(found, r) for r in steady]
    size = np.sqrt((np.concatenate(states) ** 2).mean(axis=0))
    scale = 1.0 / np.where(size > 1e-12, size, 1.0)
    encoder = _encoder(records, steady, [x * scale for x in states], context)
    return found.transformed(np.diag(scale)), encoder


def _chosen_order(lines: ExcitedLines, max_order: int, tolerance: float) -> int | None:
    left_out = np.arange(len(lines.z)) % _EVERY == _EVERY // 2
    kept, left = lines.part(~left_out), lines.part(left_out)
    found = _started(kept, _orders(max_order))
    errors = {order: error(left, system) for order, system in found.items()}
    if not errors:
        return None
    limit = min(errors.values()) * (1.0 + tolerance) ** 2
    return next(order for order, value in errors.items() if value <= limit)


def _orders(most: int) -> list[int]:
    found = [1]
    while found[-1] < most:
        found.append(min(most, found[-1] + max(1, round(_STEP * found[-1]))))
    return found


def _started(lines: ExcitedLines, orders: Sequence[int]) -> dict[int, LinearSystem]:
    """Systems of these orders by the subspace method, as many as it gives."""
    factor = observability(lines, max(orders))
    found: dict[int, LinearSystem] = {}
    for order in orders:
        pair = factor.shifted(order) if factor is not None else None
        blocks = in_blocks(*pair) if pair is not None else None
        if blocks is not None:
            found[order] = with_inputs(lines, *blocks)
    return found


def _with_offset(system: LinearSystem, records: Sequence[SteadyRecord]) -> LinearSystem:
    """Set the offset: means of the outputs without those that the inputs explain."""
    gain = system.gain
    left = [r.y.mean(axis=0) - gain @ r.u.mean(axis=0) for r in records]
    return replace(system, offset=np.mean(left, axis=0))


def _steady_states(system: LinearSystem, record: SteadyRecord) -> Array:
    """States (N, n) over the mean period."""
    period = len(record.u)
    spectrum = np.fft.rfft(record.u, axis=0)
    z = np.exp(2j * np.pi * np.arange(len(spectrum)) / period)
    states = resolvent(system.a, z, system.b) @ spectrum[:, :, None]
    return np.fft.irfft(states[:, :, 0], period, axis=0)


def _encoder(
    records: ScaledData, steady: Sequence[SteadyRecord], states: Sequence[Array], context: Context
) -> Encoder:
    """Map from a past window to the steady state, from windows spread over the records."""
    past = past_length(context)
    width = max(1, context.n_past_u * context.nu + context.n_past_y * context.ny)
    most = min(_MOST_WINDOWS, _WINDOW_NUMBERS // width) // len(records) + 1
    rows: list[Indices] = [past + spread(len(r) - past, most) for r in records]
    features = [windows_before(r, at, context) for r, at in zip(records, rows, strict=True)]
    targets = [x[(at - s.first) % len(x)] for x, at, s in zip(states, rows, steady, strict=True)]
    return fit_encoder(features, targets)
