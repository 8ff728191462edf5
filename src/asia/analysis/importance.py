"""Importance of the settings of a model family: one-way analyses of variance of log V."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from asia.data.trajectory import Array
from asia.recipe import Recipe

LEAST_EXPERIMENTS: Final = 12
"""Experiments of one family below which its settings are not analysed."""
_PERMUTATIONS = 999
_MOST_LEVELS = 3


@dataclass(frozen=True)
class SettingImportance:
    """Share of the variance of log V that a setting of a family explains."""

    family: str
    setting: str
    values: int
    """Number of its values."""
    experiments: int
    """Number of experiments of the family."""
    share: float
    """0 to 1, corrected for the number of values."""
    probability: float
    """Probability of as large a share by chance."""


def settings_importance(tried: Sequence[tuple[Recipe, float]]) -> list[SettingImportance]:
    """Analyse the settings of all families with at least `LEAST_EXPERIMENTS` experiments.

    Args:
        tried: candidates with their positive, finite V

    Returns:
        the settings that were varied, lowest probability first; the probabilities are corrected
        for the number of settings by Holm's method and may exceed 1
    """
    families: dict[str, list[tuple[dict[str, object], float]]] = {}
    for recipe, value in tried:
        families.setdefault(recipe.family, []).append((dict(recipe.settings), np.log(value)))
    rows: list[SettingImportance] = []
    for family, members in sorted(families.items()):
        if len(members) < LEAST_EXPERIMENTS:
            continue
        values = np.array([value for _, value in members])
        for name in dict.fromkeys(key for settings, _ in members for key in settings):
            levels = [settings.get(name, "default") for settings, _ in members]
            known = {repr(level) for level in levels}
            groups = np.unique([repr(level) for level in levels], return_inverse=True)[1]
            if len(known) > _MOST_LEVELS:
                if not all(isinstance(level, int | float) for level in levels):
                    continue
                # Many numbers: equally large groups in their order.
                order = np.searchsorted(np.sort(levels), levels)  # pyright: ignore
                groups = order * _MOST_LEVELS // len(order)
            if len(known) > 1:
                found = share_of_variance(groups, values)
                rows.append(SettingImportance(family, name, len(known), len(members), *found))
    rows.sort(key=lambda row: row.probability)
    p = np.maximum.accumulate([row.probability * (len(rows) - k) for k, row in enumerate(rows)])
    return [replace(row, probability=float(one)) for row, one in zip(rows, p, strict=True)]


def share_of_variance(groups: NDArray[Any], values: Array, seed: int = 0) -> tuple[float, float]:
    """Share of the variance of values (n,) between their groups (n,), corrected for the number of
    groups, and the probability of as large a share by chance (permutation test)."""

    def between(numbers: Array) -> float:
        parts = [numbers[groups == group] for group in known]
        return sum(len(part) * (part.mean() - numbers.mean()) ** 2 for part in parts)

    known = np.unique(groups)
    total = ((values - values.mean()) ** 2).sum()
    n, k = len(values), len(known)
    if k < 2 or k >= n or not total > 0:
        return 0.0, 1.0
    rng, observed = np.random.default_rng(seed), between(values)
    chance = [between(rng.permutation(values)) for _ in range(_PERMUTATIONS)]
    p = (1 + sum(one >= observed * (1 - 1e-12) for one in chance)) / (1 + _PERMUTATIONS)
    return max(0.0, 1 - (1 - observed / total) * (n - 1) / (n - k)), p
