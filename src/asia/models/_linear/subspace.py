"""Starts for a linear state-space fit: (A, C) from subspace and realisation methods.

Only A and C are taken: given these the simulated output is linear in B, D, the offset and the
initial states, which are then found by least squares on the simulation error itself.
Sources: Van Overschee and De Moor, Subspace Identification for Linear Systems, 1996 (oblique
projection); Juang and Pappa, J. Guidance 8(5), 1985 (realisation from Markov parameters).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asia.data import Array
from asia.models._data.records import ScaledData

# Columns of the Hankel matrices in memory at a time.
_CHUNK = 8192


@dataclass(frozen=True)
class Observability:
    """Left factor of a Hankel-like matrix: its first n columns give a start of order n."""

    factor: Array
    """(blocks * ny, m), columns scaled by the roots of the singular values."""
    ny: int
    """Number of outputs."""

    def start(self, order: int) -> tuple[Array, Array] | None:
        """Start (A, C) of the order, A made stable; None where the factor has too few columns."""
        pair = self.shifted(order)
        return None if pair is None else (stabilised(pair[0]), pair[1])

    def shifted(self, order: int) -> tuple[Array, Array] | None:
        """Start (A, C) of the order by the shift, A perhaps unstable."""
        if order > self.factor.shape[1] or order > self.factor.shape[0] - self.ny:
            return None
        gamma = self.factor[:, :order]
        a = np.linalg.lstsq(gamma[: -self.ny], gamma[self.ny :], rcond=None)[0]
        return np.asarray(a, np.float64), gamma[: self.ny]


def starts(records: ScaledData, max_order: int) -> list[Observability]:
    """Observability factors that serve every order up to `max_order`, from least to most prone to
    noise.

    There are fewer where the records are too short for a method.
    """
    found: list[Observability] = []
    for horizon in (max_order + 2, 2 * max_order + 5):
        factor = _oblique_projection(records, horizon)
        if factor is not None:
            found.append(factor)
    factor = _realisation(records, max_order)
    if factor is not None:
        found.append(factor)
    return found


def spread_poles(order: int, ny: int) -> tuple[Array, Array]:
    """Start (A, C) with real poles, time constants log-spaced from 1 to 100 samples; it never
    fails."""
    time_constants = np.logspace(0.0, 2.0, order) if order > 1 else np.array([10.0])
    return np.diag(np.exp(-1.0 / time_constants)), np.ones((ny, order))


def stabilised(a: Array, limit: float = 0.995) -> Array:
    """Mirror poles outside the unit circle inside, and keep all within `limit`."""
    poles, vectors = np.linalg.eig(a)
    modulus = np.abs(poles)
    if modulus.max(initial=0.0) <= limit:
        return a
    inside = np.where(modulus > 1, 1 / np.maximum(modulus, 1e-12), modulus)
    moved = poles / np.maximum(modulus, 1e-12) * np.minimum(inside, limit)
    result = (vectors * moved) @ np.linalg.pinv(vectors)
    result = np.ascontiguousarray(result.real)
    radius = np.abs(np.linalg.eigvals(result)).max()
    return result if radius <= 1.0 else result * (limit / radius)


def _hankel(values: Array, first: int, blocks: int, columns: int) -> Array:
    rows = [values[first + i : first + i + columns].T for i in range(blocks)]
    return np.concatenate(rows)


def _oblique_projection(records: ScaledData, horizon: int) -> Observability | None:
    """Observability by oblique projection, computed from the products of the Hankel matrices, which
    are small for any number of samples."""
    nu, ny = records[0].u.shape[1], records[0].y.shape[1]
    past, future_u = horizon * (nu + ny), horizon * nu
    columns = [len(r) - 2 * horizon for r in records]
    if sum(max(count, 0) for count in columns) < 2 * (past + future_u):
        return None
    gram = np.zeros((2 * past, 2 * past))
    for r, count in zip(records, columns, strict=True):
        for first in range(0, count, _CHUNK):
            size = min(_CHUNK, count - first)
            rows = [
                _hankel(values, first + ahead, horizon, size)
                for ahead in (0, horizon)
                for values in (r.u, r.y)
            ]
            part = np.concatenate(rows)
            gram += part @ part.T
    known = past + future_u
    regressors = gram[:known, :known]
    ridge = 1e-8 * np.trace(regressors) / known * np.eye(known)
    gain = np.linalg.solve(regressors + ridge, gram[:known, known:]).T[:, :past]
    # MOESP weighting: the part of the projection that future inputs cannot explain.
    inputs, cross = gram[past:known, past:known], gram[past:known, :past]
    unexplained = gram[:past, :past] - cross.T @ np.linalg.pinv(inputs, hermitian=True) @ cross
    return _factor(gain @ unexplained @ gain.T, ny)


def _factor(product: Array, ny: int) -> Observability:
    """Factor the product of a Hankel-like matrix and its transpose."""
    left, singular, _ = np.linalg.svd(product)
    keep = singular > 1e-14 * singular[0]
    return Observability(left[:, keep] * singular[keep] ** 0.25, ny)


def _realisation(records: ScaledData, max_order: int) -> Observability | None:
    ny, nu = records[0].y.shape[1], records[0].u.shape[1]
    total = sum(len(r) for r in records)
    lags = min(2 * max_order + 10, total // (4 * (nu + ny)), min(len(r) for r in records) // 2)
    if lags < 2:
        return None
    many = lags * (nu + ny) + nu
    gram, moment = np.zeros((many, many)), np.zeros((many, ny))
    for r in records:
        for first in range(lags, len(r), _CHUNK):
            k = np.arange(first, min(first + _CHUNK, len(r)))
            back = k[:, None] - np.arange(1, lags + 1)
            lagged = [r.y[back].reshape(len(k), -1), r.u[back].reshape(len(k), -1), r.u[k]]
            regressors = np.concatenate(lagged, 1)
            gram += regressors.T @ regressors
            moment += regressors.T @ r.y[k]
    gram += 1e-6 * sum(max(len(r) - lags, 0) for r in records) * np.eye(many)
    theta = np.linalg.solve(gram, moment)
    return _from_arx(np.asarray(theta, np.float64), lags, nu, ny, max_order)


def _from_arx(theta: Array, lags: int, nu: int, ny: int, max_order: int) -> Observability | None:
    blocks = 2 * max_order + 5
    past_y = theta[: lags * ny].reshape(lags, ny, ny)
    past_u = theta[lags * ny : lags * (ny + nu)].reshape(lags, nu, ny)
    markov = np.zeros((2 * blocks, ny, nu))
    markov[0] = theta[lags * (ny + nu) :].T
    for k in range(1, 2 * blocks):
        if k <= lags:
            markov[k] = past_u[k - 1].T
        for i in range(1, min(k, lags) + 1):
            markov[k] += past_y[i - 1].T @ markov[k - i]
    if not np.isfinite(markov).all() or np.abs(markov).max() > 1e6:
        return None
    hankel = np.block([[markov[1 + i + j] for j in range(blocks - 1)] for i in range(blocks)])
    return _factor(hankel @ hankel.T, ny)
