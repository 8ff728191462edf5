"""Detection of several excitation levels and of periodic records."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from asia.agents._view import Facts
from asia.agents.library.records.same import SameRecords
from asia.data.frequency.periods import find_period
from asia.data.frequency.response import frequency_response

# Levels are this ratio apart, and each has at least so many records.
_APART, _FEWEST = 1.2, 2


def periodic(facts: Facts) -> bool:
    """Return whether all inputs of all records have one period, and whole records are simulated."""
    return facts.horizon is None and _period(SameRecords(facts.records)) is not None


def several_levels(facts: Facts) -> bool:
    """Return whether the inputs come in levels that are clearly apart, several records a level."""
    scale = np.concatenate([r.u for r in facts.records]).std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    sizes = np.sort([np.sqrt(((r.u / scale) ** 2).mean()) for r in facts.records])
    cuts = np.flatnonzero(sizes[1:] > _APART * sizes[:-1]) + 1
    return len(cuts) > 0 and min(map(len, np.split(sizes, cuts))) >= _FEWEST


def noise_of_periods(facts: Facts) -> float | None:
    """Return the noise floor of V from the variation between periods: standard deviation of the
    noise over that of the output, mean over the outputs. None without periods."""
    return _noise(SameRecords(facts.records)) if periodic(facts) else None


@lru_cache(maxsize=8)
def _noise(same: SameRecords) -> float | None:
    period = _period(same)
    outputs = range(same.records[0].y.shape[1])
    found = [frequency_response(same.records, k, period) for k in outputs]
    levels = [one.levels.noise for one in found if one is not None]
    known = [level for level in levels if level is not None]
    return sum(known) / len(known) if len(known) == len(outputs) else None


@lru_cache(maxsize=8)
def _period(same: SameRecords) -> int | None:
    return find_period(same.records)
