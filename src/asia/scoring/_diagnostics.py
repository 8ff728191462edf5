"""Diagnostics of training residuals; agents may see these, and no validation or test output is
used."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from asia.data import Array
from asia.errors import CandidateError, Reason
from asia.scoring._fit import pooled

Samples = NDArray[np.int64]


@dataclass(frozen=True)
class Diagnostics:
    """Residual analysis of one fold's training simulation, worst channel of each.

    train_error: the normalised metric on the training records. bias: |mean residual| / scale.
    whiteness: largest |autocorrelation| at lags 1..20, over all pairs of samples inside one record
    or window. input_correlation: largest |cross-correlation| of residual and past inputs, lags
    0..20, likewise. top_error and bottom_error: RMS
    residual where the output lies in its highest / lowest tenth, over the RMS residual.
    start_error: RMS residual in the first 5 % of the records, over the RMS residual. curvature:
    |correlation| of the residual with the squared centred output.
    """

    train_error: float
    bias: float
    whiteness: float
    input_correlation: float
    top_error: float
    bottom_error: float
    start_error: float
    curvature: float


def diagnose(
    u: Sequence[Array],
    y: Sequence[Array],
    y_hat: Sequence[Array],
    scale: Array,
    train_error: float,
) -> Diagnostics:
    """Residual analysis of simulated training records, one (H, n) array a record or window.

    Raises:
        CandidateError: when the residual is too large to analyse
    """
    with np.errstate(over="ignore", invalid="ignore"):
        found = _analyse(u, y, y_hat, scale, train_error)
    if not all(math.isfinite(value) for value in astuple(found)):
        raise CandidateError(Reason.NOT_FINITE, "the simulation of the training data diverged")
    return found


def _analyse(
    u: Sequence[Array],
    y: Sequence[Array],
    y_hat: Sequence[Array],
    scale: Array,
    train_error: float,
) -> Diagnostics:
    residual = [_error(a, b, scale) for a, b in zip(y, y_hat, strict=True)]
    e, out = pooled(residual), pooled(y)
    rms = np.sqrt(np.mean(e**2, axis=0)) + 1e-300
    high, low = np.quantile(out, 0.9, axis=0), np.quantile(out, 0.1, axis=0)
    starts = np.concatenate([r[: max(1, len(r) // 20)] for r in residual])
    place = np.concatenate([np.arange(len(r)) for r in residual]) if len(residual) > 1 else None
    del residual
    return Diagnostics(
        train_error=train_error,
        bias=float(np.max(np.abs(e.mean(axis=0)))),
        whiteness=_whiteness(e, place),
        input_correlation=_input_correlation(e, pooled(u), place),
        top_error=float(np.max(_rms_where(e, (out >= high).astype(np.float64)) / rms)),
        bottom_error=float(np.max(_rms_where(e, (out <= low).astype(np.float64)) / rms)),
        start_error=float(np.max(np.sqrt(np.mean(starts**2, axis=0)) / rms)),
        curvature=float(np.max(np.abs(_correlation(e, (out - out.mean(axis=0)) ** 2)))),
    )


def _rms_where(e: Array, weight: Array) -> Array:
    return np.sqrt((e**2 * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1.0))


def _unit(x: Array) -> Array:
    """Columns of norm 1."""
    return x / np.maximum(np.sqrt((x**2).sum(axis=0)), 1e-300)


def _correlation(a: Array, b: Array) -> Array:
    return _products(a - a.mean(axis=0), b - b.mean(axis=0))


def _error(y: Array, y_hat: Array, scale: Array) -> Array:
    found = y - y_hat
    found /= scale
    return found


def _pairs(
    a: Array, b: Array, place: Samples | None, first_lag: int
) -> Iterator[tuple[Array, Array]]:
    """Iterate over the lags, with the samples a(t) and b(t - lag) of one record.

    A lag with too few pairs is skipped.

    Args:
        place: each sample's number within its record, None where there is but one
    """
    for lag in range(first_lag, 21):
        if place is None:
            if len(a) - lag < 3:
                return
            yield a[lag:], b[: len(b) - lag]
            continue
        late = np.flatnonzero(place >= lag)
        if len(late) < 3:
            return
        yield a[late], b[late - lag]


def _whiteness(e: Array, place: Samples | None) -> float:
    a = e - e.mean(axis=0)
    values = [float(np.abs(_products(late, early)).max()) for late, early in _pairs(a, a, place, 1)]
    return max(values, default=0.0)


def _products(a: Array, b: Array) -> Array:
    found = _unit(a)
    found *= _unit(b)
    return found.sum(axis=0)


def _input_correlation(e: Array, u: Array, place: Samples | None) -> float:
    """Largest |correlation| of e(t) with u(t - lag)."""
    a, b = e - e.mean(axis=0), u - u.mean(axis=0)
    values = [
        float(np.abs(_unit(late).T @ _unit(early)).max()) for late, early in _pairs(a, b, place, 0)
    ]
    return max(values, default=0.0)
