"""Models that predict one step ahead and are simulated on their own output."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import combinations_with_replacement, product
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from asia.candidate import Context
from asia.data.trajectory import MOST_DELAY, Array
from asia.errors import UserError
from asia.models._arrays import AnyArray, bounded, namespace, scan
from asia.models._least_squares import SEQUENTIAL, LevenbergMarquardt, NormalEquations, minimise
from asia.models._numerics.lags import (
    History,
    Lags,
    OutputRange,
    fit_history,
    lagged_inputs,
    regressors,
)
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.segments import left_out_error, simulation_error
from asia.models._numerics.training_records import (
    ScaledData,
    ScaledTrajectory,
    SegmentBatch,
    past_length,
    regress_outputs,
    shortened,
)
from asia.models._steps import WrappedModel

# Polynomial one-step models, linear in their parameters: products of lagged signals.
#
# A product is a row of indices into [1, z], z the regressors, so that a row of zeros is the
# constant and products of lower degree are padded with zeros.


Terms = NDArray[np.intp]

# Numbers in a block of Jacobian rows.
_BLOCK = 4_000_000


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
class PolynomialRun:
    """Polynomial simulated on its own outputs, clipped to the limits; a `ScaledSimulator`."""

    one_step: Polynomial
    history: History
    limits: OutputRange

    def __call__(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate past_u (B, n_past_u, nu), past_y (B, n_past_y, ny), u (B, H, nu) -> (B, H,
        ny)."""
        old_u, past = self.initial(past_u, past_y, u[:, 0])
        drive = lagged_inputs(np.concatenate([old_u, u], axis=1), self.history.lags)
        return scan(self._advanced, past, drive.swapaxes(0, 1))[1].swapaxes(0, 1)

    def initial(self, past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Lagged inputs (B, past_inputs, nu), the oldest first, and lagged outputs (B, outputs *
        ny), the newest first, before the first input u (B, nu)."""
        old_u, old_y = self.history(past_u, past_y, u[:, None])
        return old_u, old_y[:, ::-1].reshape(len(u), -1)

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance the lags by a sample with the input u (B, nu); its output is (B, ny)."""
        old_u, past = state
        known = namespace(old_u, u).concatenate([old_u, u[:, None]], axis=1)
        past, y = self._advanced(past, lagged_inputs(known, self.history.lags)[:, 0])
        return (known[:, 1:], past), y

    def _advanced(self, past: AnyArray, drive: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Lagged outputs after a sample with lagged inputs (B, inputs * nu), and its output."""
        xp = namespace(past, drive)
        y = self.one_step(xp.concatenate([past, drive], axis=1))
        y = bounded(y, self.limits.low, self.limits.high)
        return xp.concatenate([y, past], axis=1)[:, : past.shape[1]], y


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
) -> tuple[Array, Array, Array]:
    """Regression matrix (N, M), responses (N, ny) and their weight of all records; evenly spread
    rows if the matrix has more than `most` numbers."""
    stride = max(1, -(-sum(len(r) for r in records) * len(terms) // most))
    parts = [regressors(r, lags) for r in records if len(r) > lags.memory]
    z, y, weight = (
        np.concatenate([v[::stride] for v in each]) for each in zip(*parts, strict=True)
    )
    return products(z, terms), y, weight


def solve(gram: Array, cross: Array, ridge: float) -> Array:
    """Ridge regression with columns scaled to unit size: gram (M, M), cross (M, ny) -> (M, ny)."""
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    normal = gram / np.outer(scale, scale) + ridge * np.eye(len(gram))
    return np.linalg.lstsq(normal, cross / scale[:, None], rcond=1e-13)[0] / scale[:, None]


def refine(
    start: PolynomialRun, data: SegmentBatch, method: LevenbergMarquardt, ridge: float
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
    return int(np.clip(1e10 / (used.shape[1] * used.sum() ** 2), 1000, 10_000))


def _normal(start: PolynomialRun, model: Polynomial, data: SegmentBatch) -> tuple[Array, Array]:
    """Gauss-Newton matrix (P, P) and half the gradient (P,) of the mean squared error."""
    old_u, old_y = start.history(data.past_u, data.past_y, data.u)
    lags, limits = start.history.lags, start.limits
    drive = lagged_inputs(np.concatenate([old_u, data.u], axis=1), lags)
    batch, ny = len(data.u), data.y.shape[2]
    rows, columns = np.nonzero(model.used)
    free = np.arange(len(rows))
    ones = np.ones((batch, 1))
    newest = np.arange(1, lags.outputs * ny + 1)
    # Derivatives of the outputs by the lagged outputs, apart from the other factors of a product.
    maps = [
        ((column[:, None] == newest)[:, None, :] * model.theta[:, :, None]).reshape(len(column), -1)
        for column in model.terms.T
    ]
    past = old_y[:, ::-1].reshape(batch, -1)
    sensitivity = np.zeros((batch, past.shape[1], len(rows)))
    normal, gradient = np.zeros((len(rows), len(rows))), np.zeros(len(rows))
    jacobian: list[Array] = []
    misfit: list[Array] = []
    block = max(1, _BLOCK // (batch * ny * len(rows)))
    for k in range(data.u.shape[1]):
        z = np.concatenate([past, drive[:, k]], axis=1)
        full = np.concatenate([ones, z], axis=1)
        factors = [full[:, column] for column in model.terms.T]
        phi = reduce(np.multiply, factors)
        by_past = np.zeros((batch, ny * len(newest)))
        for p, by_factor in enumerate(maps):
            others = [factor for q, factor in enumerate(factors) if q != p]
            by_past += reduce(np.multiply, others, np.ones_like(phi)) @ by_factor
        free_y = phi @ model.theta
        y = np.clip(free_y, limits.low, limits.high)
        change = by_past.reshape(batch, ny, -1) @ sensitivity
        change[:, columns, free] += phi[:, rows]
        change *= (y == free_y)[..., None]
        past = np.concatenate([y, past], axis=1)[:, : past.shape[1]]
        sensitivity = np.concatenate([change, sensitivity], axis=1)[:, : past.shape[1]]
        jacobian.append(change * data.weight[:, k, :, None])
        misfit.append((y - data.y[:, k]) * data.weight[:, k])
        if len(jacobian) == block or k + 1 == data.u.shape[1]:
            stacked = np.concatenate(jacobian).reshape(-1, len(rows))
            normal += stacked.T @ stacked
            gradient += stacked.T @ np.concatenate(misfit).ravel()
            jacobian, misfit = [], []
    total = max(float(data.weight.sum()), 1.0)
    return normal / total, gradient / total


# Common parts of the families that predict one step ahead and are used in free run.


C = TypeVar("C")

RIDGES = (1e-9, 1e-7, 1e-5, 1e-4, 1e-3, 1e-2)


class ScaledRun(NamedTuple):
    """Model in free run that simulates in physical units."""

    run: PolynomialRun
    scaling: Scaling

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate in physical units."""
        s = self.scaling
        return s.physical(self.run(s.inputs(past_u), s.outputs(past_y), s.inputs(u)))

    def initial(self, past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        """Lagged signals at the first sample."""
        s = self.scaling
        return self.run.initial(s.inputs(past_u), s.outputs(past_y), s.inputs(u))

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one sample."""
        state, y = self.run.step(state, self.scaling.inputs(u))
        return state, self.scaling.physical(y)


@dataclass(frozen=True)
class FreeRunModel(WrappedModel[ScaledRun], Generic[C]):
    """Input-output model used in free run."""

    config: C
    """Settings of the family."""
    run: PolynomialRun | None = None
    """Model in free run; None before training."""
    scaling: Scaling | None = None
    """Scaling from physical units to z-scores; None before training."""

    def _trained(self) -> ScaledRun:
        if self.run is None or self.scaling is None:
            raise UserError("input-output model: not trained yet; call train first")
        return ScaledRun(self.run, self.scaling)


def build(config: C, context: Context) -> FreeRunModel[C]:
    """Build an untrained model."""
    del context
    return FreeRunModel(config)


@dataclass(frozen=True)
class LagChoice:
    """Lags and delay, or limits of their choice: the fewest parameters within the tolerance of the
    best."""

    outputs: int | None
    """Number of lagged outputs; None: chosen from 1..max_order."""
    inputs: int | None
    """Number of lagged inputs; None: chosen from 1..max_order."""
    delay: int | None
    """Delay in samples; None: chosen from 0..`MOST_DELAY`."""
    max_order: int
    """Greatest number of lags tried."""
    scheduling: int = 0
    """Degree of the coefficients in the scheduling signals."""


def linear_run(
    records: ScaledData,
    lags: Lags,
    context: Context,
    ridge: float,
    margin: float,
    scheduling: int = 0,
) -> PolynomialRun:
    """Fit an ARX model by ridge regression, limited to the training range widened by `margin`
    times. Its coefficients are polynomials of degree `scheduling` in the newest scheduling
    signals."""
    terms = _linear_terms(lags, context, scheduling)
    rows = equations(records, lags, terms)
    theta = regress_outputs(*rows, lambda x, y: solve(x.T @ x, x.T @ y, ridge))
    model = Polynomial(terms, theta, np.ones(theta.shape, bool))
    return PolynomialRun(
        model, fit_history(records, lags, context), OutputRange.of(records, margin)
    )


def _linear_terms(lags: Lags, context: Context, degree: int) -> Terms:
    """Each regressor and the constant, times every product of scheduling signals up to a degree."""
    own = lags.outputs * context.ny
    places = [j for j, s in enumerate(context.inputs) if s.role == "scheduling"]
    if not (degree and places):
        return all_terms(own + lags.inputs * context.nu, 1)
    driven = [j for j in range(lags.inputs * context.nu) if j % context.nu not in places]
    factors = np.array([0, *(1 + own + j for j in places)])[all_terms(len(places), degree)]
    plain = [0, *range(1, own + 1), *(1 + own + j for j in driven)]
    return np.array([[k, *factor] for factor in factors for k in plain], dtype=np.intp)


def choose_lags(records: ScaledData, context: Context, choice: LagChoice) -> Lags:
    """Choose the lags of a linear model by its simulation error on samples left out of the fit."""
    part = selection(records, context, choice.max_order)
    highest = max(1, min(choice.max_order, min(len(r) for r in part) // 12))
    delay = choice.delay
    if delay is None:
        few = [Lags(min(2, highest), min(2, highest), d) for d in range(MOST_DELAY + 1)]
        delay = _best_lags(part, context, few, 0.01, choice.scheduling).delay
    counts = range(1, highest + 1)
    numbers = product(
        counts if choice.outputs is None else (choice.outputs,),
        counts if choice.inputs is None else (choice.inputs,),
    )
    lags = [Lags(a, b, delay) for a, b in numbers]
    if len(lags) == 1:
        return lags[0]
    ny, nu = context.ny, context.nu
    lags.sort(key=lambda item: item.outputs * ny + item.inputs * nu)
    return _best_lags(part, context, lags, 0.03, choice.scheduling)


def candidate_lags(records: ScaledData, context: Context, choice: LagChoice) -> list[Lags]:
    """Lags to compare for a nonlinear model: one number for all that are left open.

    An open delay is that of a linear model.
    """
    outputs, inputs, delay = choice.outputs, choice.inputs, choice.delay
    if delay is None:
        delay = choose_lags(records, context, LagChoice(1, 1, None, 1)).delay
    if outputs is not None and inputs is not None:
        return [Lags(outputs, inputs, delay)]
    part = selection(records, context, choice.max_order)
    highest = max(1, min(choice.max_order, min(len(r) for r in part) // 12))
    return [Lags(outputs or n, inputs or n, delay) for n in range(1, highest + 1)]


def selection(records: ScaledData, context: Context, max_order: int) -> list[ScaledTrajectory]:
    """Records for choices: parts long enough to leave something to simulate."""
    shortest = 3 * (past_length(context) + (context.horizon or 0)) + 12 * max_order
    long = [r for r in records if len(r) > past_length(context)]
    # Choices of lags take hundreds of fits; so many samples distinguish the candidates.
    return shortened(long, 6000, shortest)


def choose_ridge(
    records: ScaledData,
    context: Context,
    fit: Callable[[ScaledData, float], PolynomialRun],
    memory: int,
) -> float:
    """Choose the ridge with the least simulation error on samples left out of the fit."""
    errors = left_out_error(
        records, context, lambda kept: [fit(kept, ridge) for ridge in RIDGES], memory
    )
    return RIDGES[int(np.argmin(errors))]


def usable(records: ScaledData, lags: Lags) -> None:
    """Check that a record is long enough for the lags.

    Raises:
        UserError: if none is.
    """
    if all(len(r) <= lags.memory for r in records):
        raise UserError(
            f"training records: the longest has {max(len(r) for r in records)} samples, the model "
            f"needs {lags.memory} before the first it can predict; use fewer lags"
        )


def _best_lags(
    records: ScaledData,
    context: Context,
    lags: Sequence[Lags],
    tolerance: float,
    scheduling: int,
) -> Lags:
    longest = max(lags, key=lambda item: item.memory)
    usable(records, longest)
    errors = left_out_error(
        records,
        context,
        lambda kept: [linear_run(kept, item, context, 1e-7, 10.0, scheduling) for item in lags],
        longest.memory,
    )
    return lags[int(np.argmax(errors <= errors.min() + 2 * np.log1p(tolerance)))]
