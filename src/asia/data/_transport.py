"""Transport delays through a pipe or along a belt whose pace is an input.

A signal that leaves at a time entered when the integral of the pace was smaller by the volume of
the pipe: integral of the pace from entry to now = volume (plug flow). A slow pace means a long
delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np

from asia.data._arrays import Array
from asia.data._trajectory import Trajectory

# Least pace as a share of the volume per sample, so that the transport never stops.
_LEAST_PACE = 1e-4
# Lower limit of the pace in a simulation, as a share of the least one in the records.
_SLOWEST = 0.5
# Delays in samples at the mean pace between which volumes are compared, and how many.
_LONGEST, _COMPARED = 30.0, 31
# Lags of the one-step model, the most samples and the most columns for each sample.
_LAGS, _MOST_SAMPLES, _MOST_COLUMNS = 2, 4000, 0.2


@dataclass(frozen=True)
class Transport:
    """A pipe whose pace is an input."""

    pace: int
    """Number of that input, whose values are positive."""
    volume: float
    """Volume of the pipe: unit of the input times samples."""
    slowest: float = 0.0
    """Lower limit of the pace in a simulation, so that nothing stays in the pipe for longer than
    `longest` samples."""

    @property
    def least_pace(self) -> float:
        """Lower limit of the pace."""
        return max(self.slowest, _LEAST_PACE * self.volume)

    @property
    def longest(self) -> int:
        """Samples after which all has left the pipe, at every pace."""
        return int(np.ceil(self.volume / self.least_pace))

    def carried(self, u: Array) -> Array:
        """Inputs u (T, nu), physical units, held between samples and backwards before the first ->
        (T, nu + 1): the inputs as they leave the pipe, means over each sample, and the pace."""
        pace = np.maximum(u[:, self.pace], self.least_pace)
        before = int(np.ceil(self.volume / pace[0])) + 1
        held = np.concatenate([np.repeat(u[:1], before, axis=0), u])
        passed = _sums(np.concatenate([np.repeat(pace[:1], before), pace])[:, None])[:, 0]
        time = np.arange(len(passed), dtype=float)
        entry = np.interp(passed[before:] - self.volume, passed, time)
        sums = _sums(held)
        amounts = np.stack([np.interp(entry, time, s) for s in sums.T], axis=1)
        leaving = np.diff(amounts, axis=0) / np.diff(entry)[:, None]
        return np.hstack([leaving, u[:, self.pace, None]])


class FoundTransport(NamedTuple):
    """The volume that explains most."""

    transport: Transport
    """The pipe."""
    delay: float
    """Delay in samples at the mean pace."""
    ratio: float
    """Squared one-step error with it, over the least of all constant delays; infinite where the
    records are too short to tell."""


def find_transport(records: Sequence[Trajectory], pace: int) -> FoundTransport:
    """Volume of the pipe by the error of a one-step model with products of its signals.

    Raises:
        ValueError: where the input takes values that are not positive
    """
    least = min(float(r.u[:, pace].min()) for r in records)
    if least <= 0.0:
        raise ValueError(f"input {pace} cannot be a pace: it has values that are not positive")
    mean = float(np.concatenate([r.u[:, pace] for r in records]).mean())
    delays = np.geomspace(1.0, _LONGEST, _COMPARED)
    parts = _parts(records)
    each = [
        _one_step_error([Transport(pace, mean * d).carried(r.u) for r in parts], parts)
        for d in delays
    ]
    constant = [
        _one_step_error([_late(r.u, d, pace) for r in parts], parts)
        for d in range(round(_LONGEST) + 1)
    ]
    best = int(np.argmin(each))
    known = np.isfinite(each[best]) and min(constant) > 0.0
    ratio = each[best] / min(constant) if known else float("inf")
    delay = float(delays[best])
    found = Transport(pace, mean * delay, _SLOWEST * least)
    return FoundTransport(found, delay, float(ratio))


def _sums(values: Array) -> Array:
    """Return the cumulative sums (T + 1, c) of (T, c): the amount before each sample."""
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])


def _parts(records: Sequence[Trajectory]) -> list[Trajectory]:
    """The first samples of each record that is longer than the longest delay."""
    most = max(_MOST_SAMPLES // len(records), 4 * round(_LONGEST))
    long = [r for r in records if len(r) > 2 * _LONGEST]
    return [Trajectory(r.u[:most], r.y[:most], r.sampling_time, r.name) for r in long]


def _late(u: Array, delay: int, pace: int) -> Array:
    held = np.concatenate([np.repeat(u[:1], delay, axis=0), u])[: len(u)]
    return np.hstack([held, u[:, pace, None]])


def _one_step_error(inputs: Sequence[Array], records: Sequence[Trajectory]) -> float:
    """Mean squared error, in variances of the outputs, of a model quadratic in lagged signals;
    infinite with too few samples for it."""
    if not records:
        return float("inf")
    rows = np.concatenate([_lagged(v, r.y) for v, r in zip(inputs, records, strict=True)])
    ny = records[0].y.shape[1]
    spread = rows.std(axis=0)
    rows = (rows - rows.mean(axis=0)) / np.where(spread > 0.0, spread, 1.0)
    y, x = rows[:, :ny], rows[:, ny:]
    columns = x.shape[1] * (x.shape[1] + 3) // 2 + 1
    if columns > _MOST_COLUMNS * len(x):
        return float("inf")
    products = [x[:, i] * x[:, j] for i, j in combinations_with_replacement(range(x.shape[1]), 2)]
    terms = np.column_stack([np.ones(len(x)), x, *products])
    gram = terms.T @ terms + 1e-9 * len(x) * np.eye(columns)
    left = y - terms @ np.linalg.solve(gram, terms.T @ y)
    return float((left**2).mean())


def _lagged(v: Array, y: Array) -> Array:
    """Outputs, the outputs before, and the inputs now and before, from where every delay is
    known."""
    first, n = round(_LONGEST), len(y)
    before = [y[first - k : n - k] for k in range(_LAGS + 1)]
    return np.hstack([*before, v[first:], v[first - 1 : n - 1]])
