"""Drawn disturbances."""

from __future__ import annotations

import numpy as np

from asia.data import Array


def slow_disturbance(samples: int, keep: float, rng: np.random.Generator) -> Array:
    """A stationary Ornstein-Uhlenbeck process (T,) of unit variance, `keep` the correlation of
    neighbouring samples."""
    found = rng.standard_normal(samples)
    for k in range(1, samples):
        found[k] = keep * found[k - 1] + np.sqrt(1 - keep**2) * found[k]
    return found
