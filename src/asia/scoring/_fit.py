"""Measures of fit beside the metric. Arrays are (samples, channels) in physical units."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asia.data import Array


def fit_index(y: Array, y_hat: Array) -> Array:
    """100 (1 - |y - y_hat| / |y - mean y|) per channel, in percent (Ljung 1999); NaN
    where y is constant."""
    return 100.0 * (1.0 - np.sqrt(_energy_ratio(y, y_hat)))


def r2(y: Array, y_hat: Array) -> Array:
    """Coefficient of determination of each channel; NaN where y is constant."""
    return 1.0 - _energy_ratio(y, y_hat)


def _energy_ratio(y: Array, y_hat: Array) -> Array:
    """NaN where an output does not move: it has no fit index."""
    spread = np.sum((y - y.mean(axis=0)) ** 2, axis=0)
    with np.errstate(over="ignore"):
        return np.sum((y - y_hat) ** 2, axis=0) / np.where(spread > 0, spread, np.nan)


def pooled(parts: Sequence[Array]) -> Array:
    """All samples of all cases, one below the other."""
    return np.concatenate(list(parts), axis=0)
