"""Measures of fit in addition to the metric. Arrays are (samples, channels) in physical units."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asia.data import Array, filled
from asia.protocol import by_measured


def fit_index(y: Array, y_hat: Array) -> Array:
    """100 (1 - |y - y_hat| / |y - mean y|) per channel, in percent (Ljung 1999); NaN
    where y is constant."""
    return 100.0 * (1.0 - np.sqrt(by_measured(_energy_ratio, y, y_hat)))


def r2(y: Array, y_hat: Array) -> Array:
    """Coefficient of determination of each channel; NaN where y is constant."""
    return 1.0 - by_measured(_energy_ratio, y, y_hat)


def _energy_ratio(y: Array, y_hat: Array) -> Array:
    """NaN where an output does not move: it has no fit index."""
    spread = np.sum((y - y.mean(axis=0)) ** 2, axis=0)
    with np.errstate(over="ignore"):
        return np.sum((y - y_hat) ** 2, axis=0) / np.where(spread > 0, spread, np.nan)


def without_gaps(y: Array, y_hat: Array) -> Array:
    """y (H, ny) of a block with NaN -> with the error `y - y_hat` on straight lines between the
    measured samples, for an analysis that needs every sample. No score is made from it."""
    return y_hat + filled(y - y_hat) if np.isnan(y).any() else y


def pooled(parts: Sequence[Array]) -> Array:
    """All samples of all cases, one below the other; a single one, which may be long, as it is."""
    return parts[0] if len(parts) == 1 else np.concatenate(list(parts), axis=0)
