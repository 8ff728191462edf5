"""Delays between inputs and outputs, and feedback, by correlation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.data._trajectory import Array, Trajectory

# Lags of the whitening filter, and the 99 % point of a normal distribution.
_WHITENING, _BAND = 15, 2.576
LONGEST_DELAY = 100
"""Samples."""
# Lags of feedback that are looked at; the 99 % point of the largest of so many correlations.
_BACK, _LARGEST = 20, 3.48


@dataclass(frozen=True)
class FoundDelay:
    """Delay from an input to an output.

    Attributes:
        lag: samples until the output responds, 0 for a direct feed-through; None where it never
            leaves the band. correlation: (lags,) from 0 on; band: its 99 % band without any
            effect.
    """

    lag: int | None
    correlation: Array
    band: float


def find_delay(records: Sequence[Trajectory], channel: int, output: int) -> FoundDelay:
    """The first of two neighbouring lags at which the prewhitened input and the output correlate
    beyond the 99 % band (Box and Jenkins, Time Series Analysis, section 11.2); the band is widened
    for the number of lags."""
    longest = min(LONGEST_DELAY, min(len(r) for r in records) // 4)
    weights = _whitening([r.u[:, channel] for r in records])
    sums, energy_u, energy_y, count = np.zeros(longest + 1), 0.0, 0.0, 0
    for r in records:
        u = _filtered(r.u[:, channel] - r.u[:, channel].mean(), weights)
        y = _filtered(r.y[:, output] - r.y[:, output].mean(), weights)
        sums += [u[: len(u) - k] @ y[k:] for k in range(longest + 1)]
        energy_u, energy_y, count = energy_u + u @ u, energy_y + y @ y, count + len(u)
    correlation = sums / max(np.sqrt(energy_u * energy_y), 1e-300)
    band = _BAND / np.sqrt(max(count, 1))
    beyond = np.abs(correlation) > band * 1.35
    strong = np.abs(correlation) > 2 * band
    hits = np.flatnonzero(strong | (beyond & np.append(beyond[1:], False)))
    return FoundDelay(int(hits[0]) if hits.size else None, correlation, band)


def find_feedback(records: Sequence[Trajectory], channel: int, output: int) -> bool | None:
    """Return whether the innovation of the input correlates with earlier outputs beyond the 99 %
    band.

    Without feedback the innovation is independent of past outputs (Ljung, System Identification,
    2nd ed., section 13.4). None where the filter leaves an innovation that is not white, as for a
    few sines: the band does not hold for it.
    """
    longest = min(_BACK, min(len(r) for r in records) // 4)
    weights = _whitening([r.u[:, channel] for r in records])
    back, own = np.zeros(longest), np.zeros(longest)
    energy_u, energy_y, count = 0.0, 0.0, 0
    for r in records:
        u = _filtered(r.u[:, channel] - r.u[:, channel].mean(), weights)
        y = _filtered(r.y[:, output] - r.y[:, output].mean(), weights)
        lags = range(1, longest + 1)
        back += [u[k:] @ y[: len(y) - k] for k in lags]
        own += [u[k:] @ u[: len(u) - k] for k in lags]
        energy_u, energy_y, count = energy_u + u @ u, energy_y + y @ y, count + len(u)
    band = _LARGEST / np.sqrt(max(count, 1))
    if energy_u <= 0 or energy_y <= 0 or np.abs(own).max() > band * energy_u:
        return None
    return bool(np.abs(back).max() > band * np.sqrt(energy_u * energy_y))


def _whitening(signals: Sequence[Array]) -> Array:
    """Coefficients of an autoregressive filter that makes the signals white, the leading 1
    included."""
    order = min(_WHITENING, min(len(s) for s in signals) // 8)
    rows: list[Array] = []
    targets: list[Array] = []
    for signal in signals:
        centred = signal - signal.mean()
        lags = np.lib.stride_tricks.sliding_window_view(centred, order + 1)
        rows.append(lags[:, :-1][:, ::-1])
        targets.append(lags[:, -1])
    weights = np.linalg.lstsq(np.concatenate(rows), np.concatenate(targets), rcond=1e-8)[0]
    return np.concatenate([[1.0], -weights])


def _filtered(values: Array, weights: Array) -> Array:
    return np.convolve(values, weights)[len(weights) - 1 : len(values)]
