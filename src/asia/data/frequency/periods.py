"""Periods of the inputs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asia.data._trajectory import Array, Trajectory

# A period is where the input is alike again, after it was not alike in between.
_ALIKE, _UNLIKE, _SHORTEST = 0.98, 0.5, 16


def find_period(records: Sequence[Trajectory]) -> int | None:
    """Samples of the period that all inputs of all records have, each at least twice in every
    record; None where there is none."""
    return common_period([r.u for r in records])


def common_period(inputs: Sequence[Array]) -> int | None:
    """The same of inputs (T, nu), one array a record."""
    found = {_period(u) for u in inputs}
    return found.pop() if len(found) == 1 else None


def _period(u: Array) -> int | None:
    likeness = _likeness(u)
    unlike = np.flatnonzero(likeness < _UNLIKE)
    if not len(unlike):
        return None
    first = max(int(unlike[0]), _SHORTEST)
    alike = np.flatnonzero(likeness[first:] >= _ALIKE)
    if not len(alike):
        return None
    start = first + int(alike[0])
    # The best of the lags around it, up to where the input is unlike itself again.
    after = unlike[unlike > start]
    stop = int(after[0]) if len(after) else len(likeness)
    return start + int(np.argmax(likeness[start:stop]))


def _likeness(u: Array) -> Array:
    """1 minus half the mean squared change over each lag from 0 to half the record, in variances:
    1 where the input is the same again, the least over the inputs that move."""
    length, lags = len(u), len(u) // 2 + 1
    size = 2 ** int(np.ceil(np.log2(2 * max(length, 1))))
    rows = [np.ones(lags)]
    for v in (u - u.mean(axis=0)).T:
        variance = float(v @ v) / length
        if variance <= 1e-24 * max(1.0, float(abs(u).max()) ** 2):
            continue
        product = np.fft.irfft(abs(np.fft.rfft(v, size)) ** 2, size)[:lags]
        squares = np.concatenate([[0.0], np.cumsum(v**2)])
        count = length - np.arange(lags)
        both = squares[count] + squares[length] - squares[length - count]
        rows.append(1.0 - (both - 2.0 * product) / (2.0 * count * variance))
    return np.min(rows, axis=0) if len(rows) > 1 else np.zeros(lags)
