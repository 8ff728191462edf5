"""What the residuals on the training side say. Agents may see these; nothing here touches
validation or test outputs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from asia.errors import CandidateError, Reason
from asia.problem import Array


@dataclass(frozen=True)
class Diagnostics:
    """Residual analysis of one fold's training simulation, worst channel of each.

    train_error: the normalised metric on the training records. bias: |mean residual| / scale.
    whiteness: largest |autocorrelation| at lags 1..20. input_correlation: largest
    |cross-correlation| of residual and past inputs, lags 0..20. top_error and bottom_error: RMS
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
    """Residual analysis of simulated training records, one (H, n) array a record. Raises
    CandidateError when the residual is too large to analyse."""
    with np.errstate(over="ignore", invalid="ignore"):
        found = _analyse(u, y, y_hat, scale, train_error)
    if not all(math.isfinite(value) for value in astuple(found)):
        raise CandidateError(Reason.NOT_FINITE, "the simulation of the training data ran away")
    return found


def _analyse(
    u: Sequence[Array],
    y: Sequence[Array],
    y_hat: Sequence[Array],
    scale: Array,
    train_error: float,
) -> Diagnostics:
    residual = [(a - b) / scale for a, b in zip(y, y_hat, strict=True)]
    e, out = np.concatenate(residual), np.concatenate(list(y))
    rms = np.sqrt(np.mean(e**2, axis=0)) + 1e-300
    high, low = np.quantile(out, 0.9, axis=0), np.quantile(out, 0.1, axis=0)
    starts = np.concatenate([r[: max(1, len(r) // 20)] for r in residual])
    return Diagnostics(
        train_error=train_error,
        bias=float(np.max(np.abs(e.mean(axis=0)))),
        whiteness=max(_largest(r, r, 1) for r in residual),
        input_correlation=max(_largest(r, v, 0) for r, v in zip(residual, u, strict=True)),
        top_error=float(np.max(_rms_where(e, (out >= high).astype(np.float64)) / rms)),
        bottom_error=float(np.max(_rms_where(e, (out <= low).astype(np.float64)) / rms)),
        start_error=float(np.max(np.sqrt(np.mean(starts**2, axis=0)) / rms)),
        curvature=float(np.max(np.abs(_correlation(e, (out - out.mean(axis=0)) ** 2)))),
    )


def _rms_where(e: Array, weight: Array) -> Array:
    return np.sqrt((e**2 * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1.0))


def _standardised(x: Array) -> Array:
    x = x - x.mean(axis=0)
    return x / np.maximum(np.sqrt((x**2).sum(axis=0)), 1e-300)


def _correlation(a: Array, b: Array) -> Array:
    return (_standardised(a) * _standardised(b)).sum(axis=0)


def _largest(e: Array, other: Array, first_lag: int) -> float:
    """Largest |correlation| of e(t) with other(t - lag) over lags first_lag..20."""
    a, b = _standardised(e), _standardised(other)
    lags = range(first_lag, min(21, len(a) - 1))
    values = [float(np.abs(a[lag:].T @ b[: len(b) - lag]).max()) for lag in lags]
    if e is other:
        values = [float(np.abs((a[lag:] * b[: len(b) - lag]).sum(axis=0)).max()) for lag in lags]
    return max(values, default=0.0)
