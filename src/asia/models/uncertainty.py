"""Standard errors of parameters fitted to simulation errors, for any candidate.

    covariance = uncertainty.sandwich(residuals, jacobians)

With H = J'J + R and residuals e, the covariance of the estimate is H^-1 (J' cov(e) J) H^-1. The
residuals of a simulation are correlated in time, so that cov(e) is not a multiple of the unit
matrix: it is that of an autoregressive process fitted to them, for each output, with correlated
innovations. Sources: White, Econometrica 50(1), 1982; Ljung, System Identification, 2nd ed., 1999,
chapter 9; Burg's method: Kay, Modern Spectral Estimation, 1988, section 7.5.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter
from scipy.stats import t as student

from asia.candidate import ParameterEstimate, ParameterEstimates
from asia.data import Array

__all__ = ["Covariance", "estimates", "jacobians_of", "sandwich"]

_CONFIDENCE = 0.95
_MOST_LAGS = 30
# Of the length of the records: more lags would be fitted to chance.
_SHARE_OF_LAGS = 0.1
# Each record counts by its own sum only where there are so many, and so many a parameter.
_CLUSTERS, _CLUSTERS_A_PARAMETER = 30, 5
# Of an information matrix with ones on its diagonal: what is below is rounding.
_NO_INFORMATION = 1e-14
_STEP = 1e-6
# What a filter remembers below this share of its beginning does not count.
_FORGOTTEN = 1e-3
# Samples in which the correlation of any residual has gone.
_LONG = 4096


@dataclass(frozen=True)
class Covariance:
    """Of the estimates of P coordinates."""

    matrix: Array
    """(P, P)."""
    from_prior: Array
    """(P, P): H^-1 R H^-1, the part of H^-1 that the ridge alone makes."""
    information: Array
    """(P, P): H^-1; as large in a direction as the records and the ridge say little of it."""
    unknown: Array
    """(P, k): directions of which neither records nor ridge say anything."""
    freedom: float
    """Degrees of freedom of the residuals, correlation taken into account."""


def sandwich(
    residuals: Sequence[Array],
    jacobians: Sequence[Array],
    ridge: Array | None = None,
    nuisance: Sequence[Array] | None = None,
) -> Covariance:
    """The covariance of coordinates that make the sum of squares small.

    residuals: (T, ny) of each record; jacobians: (T, ny, P), their derivatives; ridge: (P, P), R
    where the sum has theta' R theta beside the squares; nuisance: (T, ny, Q), derivatives by what
    is fitted for each record alone, such as its initial state.
    """
    free = list(jacobians)
    if nuisance is not None:
        free = [_projected(j, q) for j, q in zip(jacobians, nuisance, strict=True)]
    count = free[0].shape[-1]
    weights = np.zeros((count, count)) if ridge is None else ridge
    own = sum((np.einsum("typ,tyq->pq", j, j) for j in free), np.zeros((count, count)))
    inverse, unknown = _inverse(own + weights)
    noise = _ResidualProcess.of(residuals)
    middle = _middle(residuals, free, noise)
    squares = sum(float((e**2).sum()) for e in residuals)
    lost = float(np.trace(inverse @ middle))
    lost += sum(_lost(noise, q) for q in nuisance or ())
    kept = max(1.0 - lost / squares, 0.05) if squares > 0 else 1.0
    samples = sum(e.size for e in residuals)
    variance = squares / kept / samples
    matrix = inverse @ (middle / kept + variance * weights) @ inverse
    freedom = max(noise.independent(samples) * kept, 1.0)
    return Covariance(matrix, inverse @ weights @ inverse, inverse, unknown, freedom)


def estimates(
    covariance: Covariance,
    report: Callable[[Array], Sequence[ParameterEstimate]],
    theta: Array,
    equations: Sequence[str] = (),
) -> ParameterEstimates:
    """The parameters that `report` makes of coordinates theta (P,), with standard errors,
    intervals and correlations put in. A parameter with a range of positive numbers alone has an
    interval on the logarithmic scale."""
    plain = list(report(theta))
    slopes = _slopes(lambda x: np.array([p.value for p in report(x)]), theta)
    matrix = slopes @ covariance.matrix @ slopes.T
    errors = np.sqrt(np.maximum(np.diagonal(matrix), 0.0))
    size = np.linalg.norm(slopes, axis=1)
    lost = np.linalg.norm(slopes @ covariance.unknown, axis=1) > 1e-3 * np.maximum(size, 1e-300)
    errors = np.where(lost, np.inf, errors)
    priors, alls = (
        np.einsum("ip,pq,iq->i", slopes, part, slopes)
        for part in (covariance.from_prior, covariance.information)
    )
    share = np.clip(1.0 - priors / np.where(alls > 0, alls, 1.0), 0.0, 1.0)
    factor = float(student.ppf(0.5 + 0.5 * _CONFIDENCE, covariance.freedom))
    found = tuple(
        _with_interval(one, float(error), factor, 0.0 if gone else float(part))
        for one, error, part, gone in zip(plain, errors, share, lost, strict=True)
    )
    with np.errstate(all="ignore"):
        correlation = matrix / (errors[:, None] * errors)
    correlation[lost], correlation[:, lost] = np.nan, np.nan
    return ParameterEstimates(found, np.clip(correlation, -1.0, 1.0), tuple(equations))


def jacobians_of(
    residuals: Callable[[Array], Sequence[Array]], theta: Array
) -> tuple[list[Array], list[Array]]:
    """Residuals (T, ny) of each record at theta (P,), and their derivatives (T, ny, P) by central
    differences."""
    steps = _STEP * np.maximum(np.abs(theta), 1.0)
    columns = [
        (residuals(theta + h * unit), residuals(theta - h * unit))
        for h, unit in zip(steps, np.eye(len(theta)), strict=True)
    ]
    at = [np.asarray(e) for e in residuals(theta)]
    slopes = [
        np.stack(
            [(up[i] - down[i]) / (2 * h) for (up, down), h in zip(columns, steps, strict=True)],
            axis=-1,
        )
        for i in range(len(at))
    ]
    return at, slopes


def _with_interval(
    one: ParameterEstimate, error: float, factor: float, share: float
) -> ParameterEstimate:
    value, wide = one.value, factor * error
    low, high = value - wide, value + wide
    if one.lower > 0 and value > 0:
        with np.errstate(over="ignore"):
            ratio = float(np.exp(wide / value))
        low, high = value / ratio, value * ratio
    return ParameterEstimate(
        one.name, value, error, low, high, one.unit, one.lower, one.upper, share
    )


def _slopes(values: Callable[[Array], Array], theta: Array) -> Array:
    """(n, P): derivatives by central differences."""
    units = np.eye(len(theta))
    steps = 1e-5 * np.maximum(np.abs(theta), 1.0)
    parts = [
        (values(theta + h * unit) - values(theta - h * unit)) / (2 * h)
        for h, unit in zip(steps, units, strict=True)
    ]
    return np.stack(parts, axis=1) if parts else np.zeros((len(values(theta)), 0))


def _projected(jacobian: Array, nuisance: Array) -> Array:
    """Without what a change of the record's own unknowns would explain (Frisch and Waugh)."""
    flat, own = jacobian.reshape(-1, jacobian.shape[-1]), _basis(nuisance)
    return (flat - own @ (own.T @ flat)).reshape(jacobian.shape)


def _basis(columns: Array) -> Array:
    """Orthonormal columns (T ny, k) that span those of (T, ny, Q)."""
    flat = columns.reshape(-1, columns.shape[-1])
    left, sizes, _ = np.linalg.svd(flat, full_matrices=False)
    return left[:, sizes > 1e-9 * max(float(sizes.max(initial=0.0)), 1e-300)]


def _inverse(gram: Array) -> tuple[Array, Array]:
    """The inverse where there is one, 0 in the directions (P, k) where there is none."""
    scale = np.sqrt(np.diagonal(gram))
    scale = np.where(scale > 0, scale, 1.0)
    sizes, ways = np.linalg.eigh(gram / (scale[:, None] * scale))
    known = sizes > _NO_INFORMATION * max(len(gram), 1)
    inside = ways[:, known] / scale[:, None]
    unknown = ways[:, ~known] / scale[:, None]
    norms = np.linalg.norm(unknown, axis=0)
    return (inside / sizes[known]) @ inside.T, unknown / np.where(norms > 0, norms, 1.0)


@dataclass(frozen=True)
class _ResidualProcess:
    """Residuals as autoregressive processes, one an output, with correlated innovations."""

    filters: tuple[Array, ...]
    """(1, a_1, ...) of each output."""
    covariance: Array
    """(ny, ny) of the innovations."""

    @staticmethod
    def of(residuals: Sequence[Array]) -> _ResidualProcess:
        """Fitted to residuals (T, ny) of each record."""
        outputs = residuals[0].shape[1]
        filters = tuple(_burg([e[:, i] for e in residuals]) for i in range(outputs))
        white = [
            np.stack([lfilter(a, [1.0], e[:, i]) for i, a in enumerate(filters)], axis=1)
            for e in residuals
        ]
        # The first innovations lack their past.
        late = [w[len(max(filters, key=len)) - 1 :] for w in white]
        late = [w for w in late if len(w)] or white
        samples = np.concatenate(late)
        return _ResidualProcess(filters, samples.T @ samples / len(samples))

    def innovations_of(self, jacobian: Array) -> Array:
        """(L + T, ny, P): the sum over time of its products with innovations has the covariance of
        J'e. The first L rows are innovations before the record, which its residuals remember."""
        before = max(_memory(a, len(jacobian)) for a in self.filters)
        padded = np.concatenate([np.zeros((before, *jacobian.shape[1:])), jacobian])
        turned = padded[::-1]
        columns = [lfilter([1.0], a, turned[:, i], axis=0) for i, a in enumerate(self.filters)]
        return np.stack(columns, axis=1)[::-1]

    def middle(self, jacobian: Array) -> Array:
        """(P, P): the covariance of J'e of one record."""
        found = self.innovations_of(jacobian)
        return np.einsum("tip,ij,tjq->pq", found, self.covariance, found)

    def independent(self, samples: int) -> float:
        """As many independent samples give a variance with the same relative error (Bartlett)."""
        return samples * float(np.mean([_variance_share(a) for a in self.filters]))


def _middle(
    residuals: Sequence[Array], jacobians: Sequence[Array], noise: _ResidualProcess
) -> Array:
    count = jacobians[0].shape[-1]
    if len(residuals) >= max(_CLUSTERS, _CLUSTERS_A_PARAMETER * count):
        sums = np.stack(
            [np.einsum("typ,ty->p", j, e) for j, e in zip(jacobians, residuals, strict=True)]
        )
        return sums.T @ sums
    return sum((noise.middle(j) for j in jacobians), np.zeros((count, count)))


def _lost(noise: _ResidualProcess, nuisance: Array) -> float:
    """How much of the sum of squares a record's own unknowns take away."""
    basis = _basis(nuisance)
    if not basis.size:
        return 0.0
    return float(np.trace(noise.middle(basis.reshape(*nuisance.shape[:2], -1))))


def _burg(pieces: Sequence[Array]) -> Array:
    """The filter (1, a_1, ...) that whitens the pieces (T,), its order by Akaike's criterion."""
    longest = max(len(piece) for piece in pieces)
    samples = sum(len(piece) for piece in pieces)
    most = min(_MOST_LAGS, int(_SHARE_OF_LAGS * longest))
    forward, backward = [np.array(p) for p in pieces], [np.array(p) for p in pieces]
    power = sum(float(p @ p) for p in pieces) / samples
    best, chosen = samples * np.log(max(power, 1e-300)), np.ones(1)
    a = np.ones(1)
    for order in range(1, most + 1):
        pairs = [(f[1:], b[:-1]) for f, b in zip(forward, backward, strict=True) if len(f) > 1]
        energy = sum(float(f @ f + b @ b) for f, b in pairs)
        if energy <= 0 or power <= 0:
            break
        k = -2.0 * sum(float(f @ b) for f, b in pairs) / energy
        a = np.concatenate([a, [0.0]])
        a = a + k * a[::-1]
        forward, backward = [f + k * b for f, b in pairs], [b + k * f for f, b in pairs]
        power *= 1.0 - k * k
        criterion = samples * np.log(max(power, 1e-300)) + 2.0 * order
        if criterion < best:
            best, chosen = criterion, a
    return chosen


def _memory(a: Array, most: int) -> int:
    """Samples after which an impulse through 1/a has all but gone."""
    if len(a) == 1:
        return 0
    impulse = np.zeros(most)
    impulse[0] = 1.0
    response = np.abs(lfilter([1.0], a, impulse))
    large = np.flatnonzero(response > _FORGOTTEN * response.max())
    return int(large[-1]) + 1


def _variance_share(a: Array) -> float:
    """One over the sum of the squared correlations of the process 1/a at all lags."""
    impulse = np.zeros(_LONG)
    impulse[0] = 1.0
    response = lfilter([1.0], a, impulse)
    spectrum = np.abs(np.fft.rfft(response, 2 * _LONG)) ** 2
    correlation = np.fft.irfft(spectrum)
    return float(correlation[0] ** 2 / (correlation**2).sum())
