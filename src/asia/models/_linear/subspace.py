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


@dataclass(frozen=True)
class Observability:
    """Left factor of a Hankel-like matrix: its first n columns give a start of order n."""

    factor: Array
    """(blocks * ny, m), columns scaled by the roots of the singular values."""
    ny: int
    """Outputs."""

    def start(self, order: int) -> tuple[Array, Array] | None:
        """(A, C) of the order, A made stable; None where the factor has too few columns."""
        pair = self.shifted(order)
        return None if pair is None else (stabilised(pair[0]), pair[1])

    def shifted(self, order: int) -> tuple[Array, Array] | None:
        """(A, C) as they come, A perhaps unstable."""
        if order > self.factor.shape[1] or order > self.factor.shape[0] - self.ny:
            return None
        gamma = self.factor[:, :order]
        a = np.linalg.lstsq(gamma[: -self.ny], gamma[self.ny :], rcond=None)[0]
        return np.asarray(a, np.float64), gamma[: self.ny]


def starts(records: ScaledData, max_order: int) -> list[Observability]:
    """Observability factors that serve every order up to `max_order`, from least to most prone
    to noise; fewer where the records are too short for a method."""
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
    """(A, C) with real poles, time constants log-spaced from 1 to 100 samples: never fails."""
    time_constants = np.logspace(0.0, 2.0, order) if order > 1 else np.array([10.0])
    return np.diag(np.exp(-1.0 / time_constants)), np.ones((ny, order))


def stabilised(a: Array, limit: float = 0.995) -> Array:
    """Poles outside the unit circle are mirrored inside, and all are kept within `limit`."""
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
    past: list[Array] = []
    future_u: list[Array] = []
    future_y: list[Array] = []
    for r in records:
        columns = len(r) - 2 * horizon
        if columns < 1:
            continue
        past.append(
            np.concatenate([_hankel(r.u, 0, horizon, columns), _hankel(r.y, 0, horizon, columns)])
        )
        future_u.append(_hankel(r.u, horizon, horizon, columns))
        future_y.append(_hankel(r.y, horizon, horizon, columns))
    if not past:
        return None
    z, uf, yf = (np.concatenate(part, axis=1) for part in (past, future_u, future_y))
    if z.shape[1] < 2 * (len(z) + len(uf)):
        return None
    regressors = np.concatenate([z, uf])
    gram = regressors @ regressors.T
    gram += 1e-8 * np.trace(gram) / len(gram) * np.eye(len(gram))
    gain = np.linalg.solve(gram, regressors @ yf.T).T
    oblique = gain[:, : len(z)] @ z
    # MOESP weighting: the part of the projection that future inputs cannot explain.
    cross = np.linalg.lstsq(uf.T, oblique.T, rcond=None)[0]
    oblique = oblique - (uf.T @ cross).T
    return _factor(oblique, records[0].y.shape[1])


def _factor(matrix: Array, ny: int) -> Observability:
    left, singular, _ = np.linalg.svd(matrix @ matrix.T)
    keep = singular > 1e-14 * singular[0]
    return Observability(left[:, keep] * singular[keep] ** 0.25, ny)


def _realisation(records: ScaledData, max_order: int) -> Observability | None:
    ny, nu = records[0].y.shape[1], records[0].u.shape[1]
    total = sum(len(r) for r in records)
    lags = min(2 * max_order + 10, total // (4 * (nu + ny)), min(len(r) for r in records) // 2)
    if lags < 2:
        return None
    rows: list[Array] = []
    targets: list[Array] = []
    for r in records:
        k = np.arange(lags, len(r))
        back = k[:, None] - np.arange(1, lags + 1)
        rows.append(
            np.concatenate(
                [r.y[back].reshape(len(k), -1), r.u[back].reshape(len(k), -1), r.u[k]], 1
            )
        )
        targets.append(r.y[k])
    regressors, y = np.concatenate(rows), np.concatenate(targets)
    gram = regressors.T @ regressors
    gram += 1e-6 * len(y) * np.eye(len(gram))
    theta = np.linalg.solve(gram, regressors.T @ y)
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
    return _factor(hankel, ny)
