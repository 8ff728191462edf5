"""Greedy selection of weighted ensembles (Caruana et al., ICML 2004): members are added with
replacement, each time the one that lowers the error of the mean most; bagged over random halves of
the candidates, and drawn towards the best one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from asia.data import Array

MOST_MEMBERS = 8
MOST_CANDIDATES = 24
_BAGS = 12
_ADDITIONS = 12
_LEAST_BAG = 5
_LEAST_WEIGHT = 0.02
_FAR_WORSE = 2.0
# Few folds say little about weights: this share stays with the best candidate. Without it a member
# that is good where it was judged spoils the mean elsewhere.
_SHARE_OF_BEST = 0.5

Shortfall = Callable[[Array, Array, Array], float]
"""y (S, ny), y_hat (S, ny), scale (ny,) -> the metric as it enters V."""


@dataclass(frozen=True)
class HeldOutPart:
    """Held-out part of one fold with the simulation of each candidate's model."""

    y: Array
    """Measured outputs (S, ny)."""
    y_hat: Array
    """Simulated outputs (n, S, ny) of n candidates."""
    scale: Array
    """Standard deviations (ny,) of the outputs."""
    values: tuple[float, ...]
    """The part of this fold in the V of each candidate."""


def select_weights(parts: Sequence[HeldOutPart], shortfall: Shortfall, seed: int = 0) -> Array:
    """Weights (n,) of the candidates, not negative, sum 1, at most `MOST_MEMBERS` above 0: those
    of the weighted mean with a low error, mean over the given folds. Only they are looked at."""
    count = len(parts[0].values)
    pool = candidates([part.values for part in parts])
    size = max((len(pool) + 1) // 2, _LEAST_BAG)
    random = np.random.default_rng(seed)
    weights = np.zeros(count)
    for _ in range(_BAGS if size < len(pool) else 1):
        bag = sorted(random.permutation(pool)[:size].tolist())
        weights += _greedy(parts, shortfall, bag, count)
    weights *= (1.0 - _SHARE_OF_BEST) / weights.sum()
    weights[pool[0]] += _SHARE_OF_BEST
    return _capped(weights)


def candidates(values: Sequence[Sequence[float]]) -> list[int]:
    """Places of those that may be members, the best first. values: of each fold, one a candidate.
    A mean gains little from one that is far worse than the best."""
    mean = np.mean(values, axis=0)
    ranked = np.argsort(mean, kind="stable")[:MOST_CANDIDATES]
    return [int(one) for one in ranked if mean[one] <= _FAR_WORSE * mean[ranked[0]]]


def nested_weights(
    parts: Sequence[HeldOutPart], shortfall: Shortfall, seed: int = 0
) -> tuple[Array, ...]:
    """Return for each fold the weights that are selected on the other folds."""
    return tuple(
        select_weights([*parts[:k], *parts[k + 1 :]], shortfall, seed) for k in range(len(parts))
    )


def _greedy(
    parts: Sequence[HeldOutPart], shortfall: Shortfall, bag: Sequence[int], count: int
) -> Array:
    """The best mean met on the way of always adding the member that lowers the error most."""
    sums = [np.zeros_like(part.y) for part in parts]
    chosen: list[int] = []
    best, best_length = np.inf, 1
    for length in range(1, _ADDITIONS + 1):
        values = [_value(parts, sums, shortfall, one, length) for one in bag]
        place = int(np.argmin(values))
        chosen.append(bag[place])
        sums = [s + part.y_hat[bag[place]] for s, part in zip(sums, parts, strict=True)]
        if values[place] < best:
            best, best_length = values[place], length
    return np.bincount(chosen[:best_length], minlength=count) / best_length


def _value(
    parts: Sequence[HeldOutPart],
    sums: Sequence[Array],
    shortfall: Shortfall,
    added: int,
    length: int,
) -> float:
    pairs = zip(parts, sums, strict=True)
    each = [shortfall(p.y, (s + p.y_hat[added]) / length, p.scale) for p, s in pairs]
    return float(np.mean(each))


def _capped(weights: Array) -> Array:
    """Return the weights without negligible ones, at most `MOST_MEMBERS`."""
    kept = np.argsort(-weights, kind="stable")[:MOST_MEMBERS]
    capped = np.zeros_like(weights)
    capped[kept] = np.where(weights[kept] >= _LEAST_WEIGHT, weights[kept], 0.0)
    return capped / capped.sum()
