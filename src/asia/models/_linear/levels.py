"""Levels of excitation: groups of records, and weights of a simulation between their levels."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from asia.data import Array
from asia.models._arrays import AnyArray, namespace

# Least ratio of the input sizes of two levels.
_APART = 1.2


def groups_by_level(inputs: Sequence[Array]) -> list[list[int]]:
    """Numbers of the records whose inputs (T, nu) are alike in size, the smallest level first."""
    sizes = np.array([level_of(u) for u in inputs])
    order = np.argsort(sizes, kind="stable")
    found = [[int(order[0])]]
    for before, number in pairwise(order):
        if sizes[number] > _APART * sizes[before]:
            found.append([])
        found[-1].append(int(number))
    return [sorted(group) for group in found]


def level_of(u: Array) -> float:
    """Root mean square of inputs (..., nu) over all of them."""
    return float(np.sqrt((u**2).mean()))


def running_levels(past_u: Array, u: Array, memory: int) -> Array:
    """The level (B, H) at each sample, of up to `memory` inputs (B, .., nu) up to it."""
    power = np.concatenate([past_u, u], axis=1)
    power = (power**2).mean(axis=2)
    sums = np.cumsum(np.pad(power, ((0, 0), (1, 0))), axis=1)
    last = np.arange(past_u.shape[1] + 1, sums.shape[1])
    first = np.maximum(last - memory, 0)
    return np.sqrt(np.maximum(sums[:, last] - sums[:, first], 0.0) / (last - first))


def shares(levels: Array, at: AnyArray) -> AnyArray:
    """Weights (..., L) of systems by linear interpolation between the two levels around each level
    `at`; the outermost level beyond. NumPy or JAX.

    Args:
        levels: levels (L,), rising.
        at: levels of the simulation (...).
    """
    xp, weights = namespace(at), list[AnyArray]()
    for place, level in enumerate(levels):
        weight = xp.ones_like(at)
        if place > 0:
            low = levels[place - 1]
            weight = xp.minimum(weight, (at - low) / (level - low))
        if place + 1 < len(levels):
            high = levels[place + 1]
            weight = xp.minimum(weight, (high - at) / (high - level))
        weights.append(xp.maximum(weight, 0.0))
    return xp.stack(weights, axis=-1)


def interpolated(levels: Array, each: Array, past: Array, future: Array, memory: int) -> Array:
    """Interpolate outputs between those of the levels.

    Args:
        levels: levels (L,), rising.
        each: outputs of each level (L, B, H, ny).
        past: scaled past inputs (B, n_past_u, nu).
        future: scaled inputs (B, H, nu).
        memory: number of inputs that the running level covers.

    Returns:
        (B, H, ny).
    """
    return np.einsum("bhl,lbho->bho", shares(levels, running_levels(past, future, memory)), each)
