"""Correlation of residuals with their own past and with the inputs, over several blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.data import Array

_LAGS = 40
QUANTILE = 2.5758293035489004


def cross_correlation(a: Sequence[Array], b: Sequence[Array], most: int) -> Array:
    """Correlation of a(t) with b(t - lag) for lags -most..most, (2 most + 1,).

    Args:
        a, b: one (H,) array a block; each block is centred, products never join two blocks
    """
    total = np.zeros(2 * most + 1)
    energy_a = energy_b = 0.0
    for x, y in _stacked(a, b):
        x, y = x - x.mean(axis=1, keepdims=True), y - y.mean(axis=1, keepdims=True)
        energy_a += float(np.sum(x * x))
        energy_b += float(np.sum(y * y))
        length = x.shape[1]
        reach = min(most, length - 1)
        for lag in range(-reach, reach + 1):
            early = y[:, max(0, -lag) : length - max(0, lag)]
            late = x[:, max(0, lag) : length - max(0, -lag)]
            total[most + lag] += float(np.sum(late * early))
    floor = np.finfo(np.float64).tiny
    return total / np.sqrt(max(energy_a * energy_b, floor))


def _stacked(a: Sequence[Array], b: Sequence[Array]) -> list[tuple[Array, Array]]:
    """Blocks of one length as one (blocks, H) array each: windows come in hundreds."""
    lengths = dict.fromkeys(len(x) for x in a)
    return [
        (
            np.stack([x for x in a if len(x) == length]),
            np.stack([y for x, y in zip(a, b, strict=True) if len(x) == length]),
        )
        for length in lengths
    ]


def white_band(samples: int) -> float:
    """99 % band of the autocorrelation of white residuals (Ljung, System Identification, 16.6)."""
    return QUANTILE / np.sqrt(samples)


def independent_band(residual: Sequence[Array], u: Sequence[Array], most: int) -> float:
    """99 % band of the cross-correlation when residual and input are independent, both coloured:
    the variance is sum_k R_e(k) R_u(k) / N (Ljung, System Identification, 16.6), here with
    Bartlett weights, which keep it positive, over lags up to `most`."""
    samples = sum(len(r) for r in residual)
    weights = 1.0 - np.abs(np.arange(-most, most + 1)) / (most + 1)
    products = cross_correlation(residual, residual, most) * cross_correlation(u, u, most)
    return float(QUANTILE * np.sqrt(max(float(weights @ products), 0.0) / samples))


@dataclass(frozen=True)
class Correlation:
    """Correlation of a residual with a signal, over all blocks together."""

    lags: tuple[int, ...]
    """Lags in samples; positive where the signal is earlier."""
    values: Array
    """One a lag."""
    band: float
    """Band that holds 99 % of the correlations of white noise."""


def with_own_past(e: Sequence[Array]) -> Correlation:
    """Return the autocorrelation of residuals, one (H,) array a block, at lags 0 .. 40, fewer in
    short blocks."""
    lags = _longest(e)
    values = cross_correlation(e, e, lags)[lags:]
    return Correlation(tuple(range(lags + 1)), values, white_band(sum(len(r) for r in e)))


def with_input(e: Sequence[Array], u: Sequence[Array]) -> Correlation:
    """Return the cross-correlation of residuals with an input, one (H,) array a block each, at lags
    -40 .. 40, fewer in short blocks."""
    lags = _longest(e)
    far = max(lags, min(4 * lags, min(len(r) for r in e) - 1))
    values = cross_correlation(e, u, lags)
    return Correlation(tuple(range(-lags, lags + 1)), values, independent_band(e, u, far))


def _longest(e: Sequence[Array]) -> int:
    return max(1, min(_LAGS, min(len(r) for r in e) // 4))
