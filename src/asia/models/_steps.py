"""Common parts of the steps of several families, batch first, for NumPy and JAX arrays alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asia.models._arrays import AnyArray, namespace


def first_of_line(past: AnyArray, u: AnyArray, delay: int) -> AnyArray:
    """Last `delay` inputs (B, delay, nu) before the first sample, the oldest first.

    Before the first known input it is held backwards, as in
    `asia.models._numerics.records.delayed`.

    Args:
        past: past inputs (B, n_past_u, nu).
        u: first input (B, nu).
        delay: in samples.
    """
    known = namespace(past, u).concatenate([past, u[:, None]], axis=1)
    length = past.shape[1]
    return known[:, np.maximum(np.arange(length - delay, length), 0)]


def through_line(line: AnyArray, u: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Advance the delay line (B, delay, nu) by an input u (B, nu); return the input (B, nu) that
    acts now too."""
    known = namespace(line, u).concatenate([line, u[:, None]], axis=1)
    return known[:, 1:], known[:, 0]


def mean(values: Sequence[AnyArray]) -> AnyArray:
    """Mean of arrays of one shape."""
    return sum(values[1:], values[0]) / len(values)


def median(values: Sequence[AnyArray]) -> AnyArray:
    """Median of arrays of one shape, elementwise, without sorting, which no target has."""
    xp, ranked = namespace(*values), list(values)
    for last in range(len(ranked) - 1, 0, -1):
        for i in range(last):
            a, b = ranked[i], ranked[i + 1]
            ranked[i], ranked[i + 1] = xp.minimum(a, b), xp.maximum(a, b)
    middle = len(ranked) // 2
    return ranked[middle] if len(ranked) % 2 else 0.5 * (ranked[middle - 1] + ranked[middle])
