"""Autoregressive processes of the residuals of a fit, for its uncertainty.

Their order is found by Burg's method (Kay, Modern Spectral Estimation, 1988, section 7.5) and the
criterion of Hannan and Quinn (Journal of the Royal Statistical Society B 41(2), 1979). Residuals
are without the part of the noise that the fit absorbed, most of all where that is slow: the
coefficients are those of restricted maximum likelihood, which uses only the part that no change of
the fitted coordinates explains (Harville, Journal of the American Statistical Association 72,
1977).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.signal import lfilter

from asia.data import Array

_MOST_LAGS = 30
# Greatest number of lags as a share of the record length: more would be fitted to chance.
_SHARE_OF_LAGS = 0.1
# Share of the initial response below which a filter has forgotten.
_FORGOTTEN = 1e-3
# Samples after which the correlation of any residual has vanished.
_LONG = 4096
# Least length of a record that is filtered block by block, and length of a block.
_MANY, _BLOCK = 65_536, 8192
# Limit on values times lags of one restricted likelihood, and on its lags: on longer records the
# fit absorbs hardly any noise.
_MOST_WORK, _MOST_RESTRICTED_LAGS = 5_000_000, 8
_STABLE = 0.999


@dataclass(frozen=True)
class ResidualProcess:
    """Autoregressive processes, one an output, with correlated innovations."""

    filters: tuple[Array, ...]
    """Filter (1, a_1, ...) of each output."""
    covariance: Array
    """Covariance (ny, ny) of the innovations."""
    restricted: bool
    """The noise that the fit absorbed is taken into account."""

    @staticmethod
    def of(
        residuals: Sequence[Array],
        jacobians: Sequence[Array],
        nuisance: Sequence[Array] | None = None,
    ) -> ResidualProcess:
        """Fit the processes to residuals.

        Args:
            residuals: (T, ny) of each record.
            jacobians: derivatives (T, ny, P) of each record by all that was fitted to them.
            nuisance: derivatives (T, ny, Q) by the record's own unknowns.
        """
        outputs = range(residuals[0].shape[1])
        segments = [[e[:, i] for e in residuals] for i in outputs]
        filters = tuple(burg(some) for some in segments)
        own = 0 if nuisance is None else nuisance[0].shape[-1] * len(nuisance)
        work = sum(e.size for e in residuals) * (jacobians[0].shape[-1] + own)
        lags = max(len(a) for a in filters) - 1
        restricted = work * lags <= _MOST_WORK and lags <= _MOST_RESTRICTED_LAGS
        columns = [[np.zeros((len(e), 0)) for e in residuals] for _ in outputs]
        if restricted:
            columns = [_columns(jacobians, nuisance, i) for i in outputs]
            filters = tuple(map(_restricted, filters, segments, columns))
        white = [_innovations(*each, lags) for each in zip(filters, segments, columns, strict=True)]
        rank = columns[0][0].shape[1] / len(filters)
        samples = np.stack(white, axis=1)
        freedom = max(len(samples) - rank, 1.0)
        return ResidualProcess(filters, samples.T @ samples / freedom, restricted)

    def innovations_of(self, jacobian: Array) -> Array:
        """Filtered derivatives (L + T, ny, P): the sum over time of their products with innovations
        has the covariance of J'e.

        The first L rows belong to innovations before the record, which its residuals remember.
        """
        before = max(_memory(a, len(jacobian)) for a in self.filters)
        padded = np.concatenate([np.zeros((before, *jacobian.shape[1:])), jacobian])
        reverse = padded[::-1]
        columns = [lfilter([1.0], a, reverse[:, i], axis=0) for i, a in enumerate(self.filters)]
        return np.stack(columns, axis=1)[::-1]

    def middle(self, jacobian: Array) -> Array:
        """Covariance (P, P) of J'e of one record."""
        if len(jacobian) > _MANY:
            return self._middle_by_blocks(jacobian)
        found = self.innovations_of(jacobian)
        return np.einsum("tip,ij,tjq->pq", found, self.covariance, found)

    def _middle_by_blocks(self, jacobian: Array) -> Array:
        """Covariance of J'e block by block, from the end of the record back: the filters go on from
        block to block."""
        before = max(_memory(a, len(jacobian)) for a in self.filters)
        parameters = jacobian.shape[-1]
        memories = [np.zeros((len(a) - 1, parameters)) for a in self.filters]
        found = np.zeros((parameters, parameters))
        for first in range(0, len(jacobian) + before, _BLOCK):
            reverse = jacobian[::-1][first : first + _BLOCK]
            missing = min(first + _BLOCK, len(jacobian) + before) - first - len(reverse)
            reverse = np.concatenate([reverse, np.zeros((missing, *jacobian.shape[1:]))])
            columns = list[Array]()
            for i, a in enumerate(self.filters):
                column, memories[i] = lfilter([1.0], a, reverse[:, i], axis=0, zi=memories[i])
                columns.append(column)
            white = np.stack(columns, axis=1)
            found += np.einsum("tip,ij,tjq->pq", white, self.covariance, white, optimize=True)
        return found

    def independent(self, samples: int) -> float:
        """Number of independent samples that give a variance with the same relative error
        (Bartlett)."""
        return samples * float(np.mean([_variance_share(a) for a in self.filters]))


def burg(segments: Sequence[Array]) -> Array:
    """Filter (1, a_1, ...) that whitens the segments (T,), its order by the criterion of Hannan and
    Quinn."""
    longest = max(len(segment) for segment in segments)
    samples = sum(len(segment) for segment in segments)
    most = min(_MOST_LAGS, int(_SHARE_OF_LAGS * longest))
    forward, backward = [np.array(p) for p in segments], [np.array(p) for p in segments]
    power = sum(float(p @ p) for p in segments) / samples
    best, chosen = samples * np.log(max(power, 1e-300)), np.ones(1)
    a, penalty = np.ones(1), 2.0 * np.log(np.log(max(samples, 16)))
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
        criterion = samples * np.log(max(power, 1e-300)) + penalty * order
        if criterion < best:
            best, chosen = criterion, a
    return chosen


def _memory(a: Array, most: int) -> int:
    """Number of samples after which an impulse through 1/a has decayed."""
    if len(a) == 1:
        return 0
    impulse = np.zeros(most)
    impulse[0] = 1.0
    response = np.abs(lfilter([1.0], a, impulse))
    large = np.flatnonzero(response > _FORGOTTEN * response.max())
    return int(large[-1]) + 1


def _variance_share(a: Array) -> float:
    """Reciprocal of the sum of the squared correlations of the process 1/a at all lags."""
    impulse = np.zeros(_LONG)
    impulse[0] = 1.0
    response = lfilter([1.0], a, impulse)
    spectrum = np.abs(np.fft.rfft(response, 2 * _LONG)) ** 2
    correlation = np.fft.irfft(spectrum)
    return float(correlation[0] ** 2 / (correlation**2).sum())


def _columns(
    jacobians: Sequence[Array], nuisance: Sequence[Array] | None, output: int
) -> list[Array]:
    """Derivatives (T, K) of one output in each record, those by a record's own unknowns in separate
    columns."""
    found = [j[:, output] for j in jacobians]
    if nuisance is None:
        return found
    own, count = nuisance[0].shape[-1], len(nuisance)
    wide = [np.zeros((len(part), own * count)) for part in found]
    for k, (part, block) in enumerate(zip(wide, nuisance, strict=True)):
        part[:, k * own : (k + 1) * own] = block[:, output]
    return [np.hstack(both) for both in zip(found, wide, strict=True)]


def _restricted(a: Array, segments: Sequence[Array], columns: Sequence[Array]) -> Array:
    """Filter of restricted maximum likelihood, of the same order."""
    order = len(a) - 1
    if not order:
        return a

    def criterion(points: Array) -> float:
        through = _filter(_STABLE * np.tanh(points))
        e, x = _filtered(through, segments, columns, order)
        left, sizes, _ = np.linalg.svd(x, full_matrices=False)
        kept = sizes > 1e-7 * sizes.max(initial=1e-300)
        e = e - left[:, kept] @ (left[:, kept].T @ e)
        rest = max(len(e) - int(kept.sum()), 1)
        return rest * float(np.log(max(e @ e, 1e-300))) + 2.0 * float(np.log(sizes[kept]).sum())

    start = np.arctanh(np.clip(_reflections(a) / _STABLE, -0.9999, 0.9999))
    found = minimize(criterion, start, method="BFGS", options={"maxiter": 30, "gtol": 1e-3})
    better = np.isfinite(found.fun) and found.fun < criterion(start)
    return _filter(_STABLE * np.tanh(found.x)) if better else a


def _filtered(
    a: Array, segments: Sequence[Array], columns: Sequence[Array], lags: int
) -> tuple[Array, Array]:
    """Residuals (N,) and columns (N, K) through a filter, without the samples before which the past
    is missing."""
    lags = min(lags, min(map(len, segments)) - 1)
    e = np.concatenate([lfilter(a, [1.0], segment)[lags:] for segment in segments])
    if not columns[0].shape[1]:
        return e, np.zeros((len(e), 0))
    return e, np.concatenate([lfilter(a, [1.0], part, axis=0)[lags:] for part in columns])


def _innovations(a: Array, segments: Sequence[Array], columns: Sequence[Array], lags: int) -> Array:
    """Filtered residuals (N,) without the part that a change of the columns explains."""
    e, x = _filtered(a, segments, columns, lags)
    return e - x @ np.linalg.lstsq(x, e, rcond=1e-7)[0] if x.shape[1] else e


def _filter(reflections: Array) -> Array:
    """Filter (1, a_1, ...) from reflection coefficients: stable where these are within 1."""
    a = np.ones(1)
    for k in reflections:
        a = np.concatenate([a, [0.0]])
        a = a + k * a[::-1]
    return a


def _reflections(a: Array) -> Array:
    """Inverse of `_filter` (Levinson's recursion backwards)."""
    found: list[float] = []
    while len(a) > 1:
        k = float(a[-1])
        found.append(k)
        a = ((a - k * a[::-1]) / max(1.0 - k * k, 1e-12))[:-1]
    return np.array(found[::-1])
