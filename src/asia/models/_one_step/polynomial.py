"""Polynomial one-step models, linear in their parameters: products of lagged signals.

A product is a row of indices into [1, z], z the regressors, so that a row of zeros is the constant
and products of lower degree are padded with zeros.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from asia.data import Array
from asia.models._arrays import AnyArray, namespace
from asia.models._data.lags import FreeRun, Lags, lagged_inputs, regressors
from asia.models._data.records import ScaledData
from asia.models._data.stretches import Stretches, simulation_error
from asia.models._least_squares import SEQUENTIAL, LevenbergMarquardt, NormalEquations, minimise

Terms = NDArray[np.intp]

# Numbers in a block of Jacobian rows.
_BLOCK = 4_000_000
# Limit on the products in a Gauss-Newton matrix, and on its samples, at least and at most.
_WORK = 1e10
_SAMPLES = (1000, 10_000)


@dataclass(frozen=True)
class Polynomial:
    """Sums of products of regressors."""

    terms: Terms
    """Rows of indices (M, degree)."""
    theta: Array
    """Coefficients (M, ny)."""
    used: NDArray[np.bool_]
    """Mask of the free coefficients (M, ny)."""

    def __call__(self, z: AnyArray) -> AnyArray:
        """Predict (B, d) -> (B, ny)."""
        return products(z, self.terms) @ self.theta


@dataclass(frozen=True)
class PolynomialRun(FreeRun):
    """Polynomial in free run."""

    one_step: Polynomial


def all_terms(size: int, degree: int) -> Terms:
    """All products of up to `degree` of `size` regressors, the constant first."""
    rows = combinations_with_replacement(range(size + 1), degree)
    return np.array(list(rows), dtype=np.intp).reshape(-1, degree)


def products(z: AnyArray, terms: Terms) -> AnyArray:
    """Evaluate products: z (..., d) -> (..., M)."""
    full = namespace(z).concatenate([np.ones((*z.shape[:-1], 1)), z], axis=-1)
    result = full[..., terms[:, 0]]
    for column in terms.T[1:]:
        result = result * full[..., column]
    return result


def equations(
    records: ScaledData, lags: Lags, terms: Terms, most: int = 60_000_000
) -> tuple[Array, Array]:
    """Regression matrix (N, M) and targets (N, ny) of all records; evenly spread rows of it if it
    has more than `most` numbers."""
    stride = max(1, -(-sum(len(r) for r in records) * len(terms) // most))
    pairs = [regressors(r, lags) for r in records if len(r) > lags.memory]
    z = np.concatenate([x[::stride] for x, _ in pairs])
    return products(z, terms), np.concatenate([y[::stride] for _, y in pairs])


def solve(gram: Array, cross: Array, ridge: float) -> Array:
    """Ridge regression with columns scaled to unit size: gram (M, M), cross (M, ny) -> (M, ny)."""
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    normal = gram / np.outer(scale, scale) + ridge * np.eye(len(gram))
    return np.linalg.lstsq(normal, cross / scale[:, None], rcond=1e-13)[0] / scale[:, None]


def refine(
    start: PolynomialRun, data: Stretches, method: LevenbergMarquardt, ridge: float
) -> tuple[PolynomialRun, list[float]]:
    """Refine by Levenberg-Marquardt on the simulation error.

    The gradient of a simulated output obeys a linear recursion in the model's own derivatives
    (Narendra and Parthasarathy, IEEE Trans. Neural Networks 1(1), 1990).

    Args:
        start: model at the start.
        data: segments.
        method: settings.
        ridge: weight of the squared distance of the coefficients from their start against the
            error.

    Returns:
        The refined model, and the root of the cost by iteration.
    """
    model = start.one_step
    origin = model.theta[model.used]

    def polynomial(coefficients: Array) -> Polynomial:
        theta = model.theta.copy()
        theta[model.used] = coefficients
        return replace(model, theta=theta)

    def cost(points: Array) -> Array:
        coefficients = points[0, 0]
        run = replace(start, one_step=polynomial(coefficients))
        moved = coefficients - origin
        return np.array([[simulation_error(run, data) + ridge * float(moved @ moved)]])

    def linearise(theta: Array) -> NormalEquations:
        normal, gradient = _normal(start, polynomial(theta[0]), data)
        normal += ridge * np.eye(len(normal))
        gradient += ridge * (theta[0] - origin)
        return NormalEquations(cost(theta[:, None])[:, 0], normal[None], gradient[None])

    method = replace(method, tolerance=max(method.tolerance, 1e-9))
    found = minimise(cost, linearise, origin[None], method, SEQUENTIAL)
    history = found.history[0]
    return replace(start, one_step=polynomial(found.theta[0])), [
        float(np.sqrt(c)) for c in history[np.r_[True, np.diff(history) < 0]]
    ]


def refinement_samples(run: PolynomialRun) -> int:
    """Number of samples whose Gauss-Newton matrix is still cheap to make."""
    used = run.one_step.used
    return int(np.clip(_WORK / (used.shape[1] * used.sum() ** 2), *_SAMPLES))


def _normal(start: PolynomialRun, model: Polynomial, data: Stretches) -> tuple[Array, Array]:
    """Gauss-Newton matrix (P, P) and half the gradient (P,) of the mean squared error."""
    old_u, old_y = start.history(data.past_u, data.past_y, data.u)
    lags, limits = start.history.lags, start.limits
    drive = lagged_inputs(np.concatenate([old_u, data.u], axis=1), lags)
    batch, ny = len(data), data.y.shape[2]
    rows, columns = np.nonzero(model.used)
    free = np.arange(len(rows))
    slope = _Slope(model, lags.outputs * ny)
    past = old_y[:, ::-1].reshape(batch, -1)
    sensitivity = np.zeros((batch, past.shape[1], len(rows)))
    normal, gradient = np.zeros((len(rows), len(rows))), np.zeros(len(rows))
    jacobian: list[Array] = []
    misfit: list[Array] = []
    block = max(1, _BLOCK // (batch * ny * len(rows)))
    for k in range(data.u.shape[1]):
        z = np.concatenate([past, drive[:, k]], axis=1)
        phi, by_past = slope(z)
        free_y = phi @ model.theta
        y = np.clip(free_y, limits.low, limits.high)
        change = by_past @ sensitivity
        change[:, columns, free] += phi[:, rows]
        change *= (y == free_y)[..., None]
        past = np.concatenate([y, past], axis=1)[:, : past.shape[1]]
        sensitivity = np.concatenate([change, sensitivity], axis=1)[:, : past.shape[1]]
        jacobian.append(change * data.weight[:, k, None, None])
        misfit.append((y - data.y[:, k]) * data.weight[:, k, None])
        if len(jacobian) == block or k + 1 == data.u.shape[1]:
            stacked = np.concatenate(jacobian).reshape(-1, len(rows))
            normal += stacked.T @ stacked
            gradient += stacked.T @ np.concatenate(misfit).ravel()
            jacobian, misfit = [], []
    total = max(float(data.weight.sum()) * ny, 1.0)
    return normal / total, gradient / total


class _Slope:
    """Products and the derivative of the outputs with respect to the lagged outputs."""

    def __init__(self, model: Polynomial, past: int) -> None:
        self._terms, self._past, self._ny = model.terms, past, model.theta.shape[1]
        degree = model.terms.shape[1]
        self._maps: list[Array] = []
        for p in range(degree):
            hit = model.terms[:, p : p + 1] == np.arange(1, past + 1)
            full = hit[:, None, :] * model.theta[:, :, None]
            self._maps.append(full.reshape(len(full), -1))

    def __call__(self, z: Array) -> tuple[Array, Array]:
        full = np.concatenate([np.ones((len(z), 1)), z], axis=1)
        factors = [full[:, column] for column in self._terms.T]
        total = np.zeros((len(z), self._ny * self._past))
        phi = np.ones_like(factors[0])
        for factor in factors:
            phi = phi * factor
        for p, map_ in enumerate(self._maps):
            others = np.ones_like(factors[0])
            for q, factor in enumerate(factors):
                if q != p:
                    others = others * factor
            total += others @ map_
        return phi, total.reshape(len(z), self._ny, self._past)
