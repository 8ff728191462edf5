"""Fit of a linear state-space system: subspace start, refinement, order, levels."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from asia._progress import tracked
from asia.candidate import Context, ParameterEstimate, ParameterEstimates
from asia.data.trajectory import Array
from asia.models import uncertainty
from asia.models._arrays import AnyArray, namespace
from asia.models._config import Progress
from asia.models._least_squares import (
    SEQUENTIAL,
    LevenbergMarquardt,
    NormalEquations,
    damped_step,
    minimise,
    solve_or_fit,
)
from asia.models._linear.response import DrivenRecords, Response
from asia.models._linear.system import LinearSystem, unpacked
from asia.models._noise.model import (
    LEAST_DEVIATION,
    NOISE_ROUNDS,
    ErrorWeighting,
    NoiseChoice,
    estimate_noise,
    settled,
)
from asia.models._numerics.encoder import Encoder, window_encoder
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import (
    ScaledData,
    ScaledTrajectory,
    contiguous_splits,
    past_length,
    past_windows,
    side_by_side,
)

if TYPE_CHECKING:
    from asia.models._linear.joint import SampledResponse

# Starts for a linear state-space fit: (A, C) from subspace and realisation methods.
#
# Only A and C are taken: given these the simulated output is linear in B, D, the offset and the
# initial states, which are then found by least squares on the simulation error itself. Sources:
# Van Overschee and De Moor, Subspace Identification for Linear Systems, 1996 (oblique projection);
# Juang and Pappa, J. Guidance 8(5), 1985 (realisation from Markov parameters).

# Columns of the Hankel matrices in memory at a time.
_CHUNK = 8192


@dataclass(frozen=True)
class Observability:
    """Left factor of a Hankel-like matrix: its first n columns give a start of order n."""

    factor: Array  # (blocks * ny, m), columns scaled by the roots of the singular values
    ny: int  # Number of outputs

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
    noise; fewer where the records are too short for a method."""
    found = [
        _oblique_projection(records, max_order + 2),
        _oblique_projection(records, 2 * max_order + 5),
        _realisation(records, max_order),
    ]
    return [factor for factor in found if factor is not None]


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
            part = np.concatenate(
                [
                    values[start : start + size].T
                    for ahead in (first, first + horizon)
                    for values in (r.u, r.y)
                    for start in range(ahead, ahead + horizon)
                ]
            )
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
    theta = np.asarray(np.linalg.solve(gram, moment), np.float64)
    # Markov parameters of the ARX model.
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


# Linear systems whose last states integrate: their poles are held at 1.
#
# A = [[A1, 0], [F, L]] with L lower triangular and ones on its diagonal, so that each of the last
# states integrates those before it. A start is found from differences of the outputs.


def free_entries(order: int, integrators: int) -> Array:
    """Mask of A (order, order): 1 where an entry is searched, 0 where it is held."""
    free, m = np.ones((order, order)), order - integrators
    free[:m, m:] = 0.0
    free[m:, m:] = np.tril(np.ones((integrators, integrators)), -1)
    return free


def held_entries(order: int, integrators: int) -> Array:
    """Values of the held entries of A (order, order), zero elsewhere."""
    return np.diag(np.r_[np.zeros(order - integrators), np.ones(integrators)])


def integrating_starts(
    records: ScaledData, order: int, integrators: int
) -> list[tuple[Array, Array] | None]:
    """Pairs (A, C) of the order, at least the number of integrators, from differences of the
    outputs that change least from sample to sample."""
    if order < integrators:
        raise ValueError(f"{integrators} integrators need an order of at least {integrators}")
    # Number of integrations of each output: the slowest first, and again from the slowest.
    y = [r.y for r in records]
    changes = np.concatenate([np.diff(v, axis=0) for v in y]).std(axis=0)
    slowest = np.argsort(changes / np.maximum(np.concatenate(y).std(axis=0), 1e-12), kind="stable")
    times = [0] * len(slowest)
    for k in range(integrators):
        times[int(slowest[k % len(slowest)])] += 1
    ny, m = len(times), order - integrators
    if m == 0:
        return [_extended(np.zeros((0, 0)), np.zeros((ny, 0)), times)]
    differences = [np.array(r.y) for r in records]
    for output, count in enumerate(times):
        for y in differences:
            for _ in range(count):
                y[:-1, output] = np.diff(y[:, output])
                y[-1, output] = y[-2, output]
    size = np.concatenate(differences).std(axis=0)
    size = np.where(size > 0, size, 1.0)
    steps = [replace(r, y=y / size) for r, y in zip(records, differences, strict=True)]
    pairs = [s.start(m) for s in starts(steps, max(m, 4))]
    found = [_extended(a, c * size[:, None], times) for a, c in (p for p in pairs if p is not None)]
    return [*found, _extended(*spread_poles(m, ny), times)]


def _extended(a: Array, c: Array, times: list[int]) -> tuple[Array, Array]:
    """Append integrators to the outputs of a system (a, c) for differences."""
    m, k, ny = len(a), sum(times), len(c)
    whole, seen, place = np.zeros((m + k, m + k)), np.zeros((ny, m + k)), m
    whole[:m, :m] = a
    for output, count in enumerate(times):
        if count == 0:
            seen[output, :m] = c[output]
            continue
        for number in range(count):
            whole[place, place] = 1.0
            if number == 0:
                whole[place, :m] = c[output]
            else:
                whole[place, place - 1] = 1.0
            place += 1
        seen[output, place - 1] = 1.0
    return whole, seen


# Simulation-error fit of a linear state-space system: start, refinement, choice of order.

# Largest modulus of a pole: beyond it the system grows without bound on a longer record.
_LARGEST_RADIUS = 1.0 - 1e-9


@dataclass(frozen=True)
class Refinement:
    """Settings of Levenberg-Marquardt in NumPy."""

    iterations: int = 50  # Greatest number of steps
    initial_ridge: float = 30.0
    """Weight, in samples, of a prior that holds the initial states of the records to unit size;
    without it a slow mode started far off explains drift that the inputs did not cause."""
    damping: float = 1e-2  # First damping, relative to the scaled normal matrix
    tolerance: float = 1e-5  # Relative decrease of the cost below which it stops
    noise: NoiseChoice | None = None  # Noise model of `refined_under_noise`; None is least squares
    integrators: int = 0  # Number of last states whose pole is held at 1

    @classmethod
    def of(cls, method: LevenbergMarquardt | None) -> Refinement:
        """Take the settings from a method."""
        if method is None:
            return cls()
        tolerance, noise = max(method.tolerance, 1e-9), NoiseChoice.of(method)
        return cls(method.iterations, method.damping, tolerance, noise=noise)


@dataclass(frozen=True)
class LinearFit:
    """Fitted linear system."""

    system: LinearSystem  # System for z-scored signals
    x0: Array  # Initial states (R, n) of the training records
    error: float  # Weighted mean squared simulation error in z-scores, infinite where it diverges


def fit(
    records: ScaledData, order: int, refinement: Refinement, log: Progress | None = None
) -> LinearFit:
    """Find the best start of this order by simulation error and refine it; the log receives
    iteration and error."""
    if refinement.integrators:
        pairs = integrating_starts(records, order, refinement.integrators)
    else:
        pairs = [s.start(order) for s in starts(records, max(order, 4))]
        pairs.append(spread_poles(order, records[0].y.shape[1]))
    solved = [solve_linear_part(records, *pair) for pair in pairs if pair is not None]
    solved.sort(key=lambda s: s.error)
    best = solved[0]
    for i, start in enumerate(solved[:2]):

        def later(step: float, error: float, i: int = i, least: float = best.error) -> None:
            if log is not None:
                log(i * refinement.iterations + step, min(error, float(np.sqrt(least))))

        best = min(best, refine(records, start, refinement, later), key=lambda s: s.error)
    return best


def unseen_errors(
    records: ScaledData, context: Context, orders: Sequence[int], refinement: Refinement
) -> list[float]:
    """Root mean squared simulation error, in z-scores, of each order on held-out segments.

    The segments start from their own past windows, as the model will be used.
    """
    past = past_length(context)
    splits = contiguous_splits(records, 3, 2 * past + 4 * max(orders))
    errors: list[float] = []
    for order in tracked(orders, "order"):
        logs: list[float] = []
        for kept, left in splits:
            candidate = fit(kept, order, refinement)
            encoder = encoder_of(kept, candidate, context)
            count = sum(float(r.counts[past:].sum()) for r in left)
            error = unseen_error(left, candidate, encoder, context) / max(count, 1.0)
            logs.append(np.log(error + 1e-300))
        errors.append(float(np.exp(0.5 * np.mean(logs))))
    return errors


def encoder_of(records: ScaledData, fitted: LinearFit, context: Context) -> Encoder:
    """Map from a past window to the state, learned from the model's own states on the records of
    the fit."""
    response = DrivenRecords(records).response(fitted.system, fitted.x0)
    return window_encoder(records, response.states_of, context)


def unseen_error(
    records: ScaledData, fitted: LinearFit, encoder: Encoder, context: Context
) -> float:
    """Sum of squared simulation errors of records that were not fitted, each from its past window.

    A record no longer than its past window adds nothing.
    """
    start, total = past_length(context), 0.0
    for r in (r for r in records if len(r) > start):
        x0 = encoder(past_windows(r, context)[:1])
        _, y = fitted.system.simulate(x0, r.u[None, start:])
        total += float((r.counts[start:] * (y[0] - r.y[start:]) ** 2).sum())
    return total


def solve_linear_part(records: ScaledData, a: Array, c: Array) -> LinearFit:
    """Solve B, D, offset and initial states by least squares on the simulation error, A and C
    given."""
    n, nu, ny = len(a), records[0].u.shape[1], records[0].y.shape[1]
    zero = LinearSystem(a, np.zeros((n, nu)), c, np.zeros((ny, nu)), np.zeros(ny))
    driven = DrivenRecords(records)
    at_zero = driven.response(zero, np.zeros((len(records), n)))
    normal, gradient = at_zero.normal_equations(poles=False)
    theta = damped_step(normal, -gradient, 1e-8)
    b, d, offset, x0 = unpacked(theta, [(n, nu), (ny, nu), (ny,), (len(records), n)])
    return normalised(driven.response(LinearSystem(a, b, c, d, offset), x0))


def normalised(response: Response) -> LinearFit:
    """Scale the states to unit mean square over the training records.

    Full whitening would mix states of very different energy and lose accuracy.
    """
    scale = np.sqrt(response.state_squares)
    t = np.diag(1.0 / np.where(np.isfinite(scale) & (scale > 1e-12), scale, 1.0))
    return LinearFit(response.system.transformed(t), response.x0 @ t.T, response.error)


def refined_under_noise(
    records: ScaledData,
    found: LinearFit,
    refinement: Refinement,
    sampling_time: float,
    log: Progress | None = None,
) -> LinearFit:
    """Generalised least squares from a fit by least squares.

    The noise is estimated from the residuals and the fit refined, in turn until the estimate
    settles; without a noise model the fit is returned unchanged.
    """
    choice, noise = refinement.noise, None
    if choice is None:
        return found
    for _ in range(NOISE_ROUNDS):
        response = DrivenRecords(records).response(found.system, found.x0)
        residual = side_by_side([response.misfit(i) for i in range(len(records))])
        mask = side_by_side([r.weight for r in records])
        floor = np.full(residual.shape[-1], LEAST_DEVIATION)
        before, noise = noise, estimate_noise(residual, mask, sampling_time, choice, floor)
        if settled(before, noise):
            break
        weightings = [
            ErrorWeighting.of(noise, sampling_time, r.weight[None], choice.huber) for r in records
        ]
        # Hold initial states: a slow mode that starts far off would replace the slow disturbance.
        held = replace(refinement, initial_ridge=Refinement.initial_ridge)
        found = refine(records, found, held, log, weightings)
    return found


def refine(
    records: ScaledData,
    start: LinearFit,
    refinement: Refinement,
    log: Progress | None = None,
    weightings: Sequence[ErrorWeighting] | None = None,
    responses: Sequence[SampledResponse] = (),
) -> LinearFit:
    """Refine A, B, C, D, offset and the initial states by Levenberg-Marquardt.

    The squared errors of `responses` are added to those of the records.

    The parametrisation is redundant (any change of state coordinates); the damping makes the
    step unique. A step to an unstable system is refused.
    """
    prior = refinement.initial_ridge * start.error if np.isfinite(start.error) else 0.0
    driven, held = DrivenRecords(records, weightings), refinement.integrators
    free = free_entries(start.system.order, held).ravel()
    s, steps = start.system, itertools.count()
    arrays = [*s.matrices, start.x0]
    shapes = [p.shape for p in arrays]
    theta0 = np.concatenate([p.ravel() for p in arrays])
    # Last simulation, with its parameters.
    known = theta0, driven.response(s, start.x0)

    def response(theta: Array) -> Response:
        nonlocal known
        if not np.array_equal(theta, known[0]):
            *system, x0 = unpacked(theta, shapes)
            known = theta, driven.response(LinearSystem(*system), x0)
        return known[1]

    def cost(points: Array) -> Array:
        a = points[0, 0, : s.a.size].reshape(s.a.shape)
        own = a[: len(a) - held, : len(a) - held]
        unstable = not np.isfinite(a).all() or (
            abs(np.linalg.eigvals(own)).max(initial=0.0) > _LARGEST_RADIUS
        )
        if unstable:
            return np.array([[np.inf]])
        found = response(points[0, 0])
        weighted = found.error * max(found.samples, 1.0)
        for one in responses:
            weighted += one.error(found.system) * one.response.size
        return np.array([[weighted + prior * (found.x0**2).sum()]])

    def linearise(theta: Array) -> NormalEquations:
        current = response(theta[0])
        if log is not None:
            log(next(steps), float(np.sqrt(current.error)))
        normal, gradient = current.normal_equations()
        for one in responses:
            own, moment = one.normal_equations(current.system)
            normal[: len(own), : len(own)] += own
            gradient[: len(own)] += moment
        last = current.x0.size
        normal[-last:, -last:] += prior * np.eye(last)
        gradient[-last:] -= prior * current.x0.ravel()
        # Held entries of A.
        normal[: free.size] *= free[:, None]
        normal[:, : free.size] *= free
        gradient[: free.size] *= free
        square = current.square + sum(
            one.error(current.system) * one.response.size for one in responses
        )
        square += prior * (current.x0**2).sum()
        return NormalEquations(np.array([square]), normal[None], -gradient[None])

    method = LevenbergMarquardt(
        refinement.iterations, damping=refinement.damping, tolerance=refinement.tolerance
    )
    found = response(minimise(cost, linearise, theta0[None], method, SEQUENTIAL).theta[0])
    return LinearFit(found.system, found.x0, found.error)


# Levels of excitation: groups of records, and weights of a simulation between their levels.


def groups_by_level(inputs: Sequence[Array]) -> list[list[int]]:
    """Numbers of the records whose inputs (T, nu) are alike in size, the smallest level first;
    levels are at least a factor of 1.2 apart."""
    sizes = np.array([level_of(u) for u in inputs])
    order = np.argsort(sizes, kind="stable")
    found = [[int(order[0])]]
    for before, number in pairwise(order):
        if sizes[number] > 1.2 * sizes[before]:
            found.append([])
        found[-1].append(int(number))
    return [sorted(group) for group in found]


def level_of(u: Array) -> float:
    """Root mean square of inputs (..., nu) over all of them."""
    return float(np.sqrt((u**2).mean()))


def running_levels(past_u: Array, u: Array, memory: int) -> Array:
    """Level (B, H) at each sample, of up to `memory` inputs (B, .., nu) up to it."""
    power = np.concatenate([past_u, u], axis=1)
    power = (power**2).mean(axis=2)
    sums = np.cumsum(np.pad(power, ((0, 0), (1, 0))), axis=1)
    last = np.arange(past_u.shape[1] + 1, sums.shape[1])
    first = np.maximum(last - memory, 0)
    return np.sqrt(np.maximum(sums[:, last] - sums[:, first], 0.0) / (last - first))


def shares(levels: Array, at: AnyArray) -> AnyArray:
    """Weights (..., L) of systems by linear interpolation between the two levels around each level
    `at` (...); the outermost of `levels` (L,), rising, beyond. NumPy or JAX."""
    xp, weights = namespace(at), list[AnyArray]()
    for place, level in enumerate(levels):
        weight = xp.ones_like(at)
        if place > 0:
            low = levels[place - 1]
            weight = xp.minimum(weight, (at - low) / (level - low))
        if place + 1 < len(levels):
            high = levels[place + 1]
            weight = xp.minimum(weight, (high - at) / (high - level))
        weights.append(xp.maximum(weight, 0.0))
    return xp.stack(weights, axis=-1)


def interpolated(levels: Array, each: Array, past: Array, future: Array, memory: int) -> Array:
    """Interpolate the outputs `each` (L, B, H, ny) of the rising levels (L,) to (B, H, ny), by the
    running level of up to `memory` scaled inputs: past (B, n_past_u, nu), future (B, H, nu)."""
    return np.einsum("bhl,lbho->bho", shares(levels, running_levels(past, future, memory)), each)


# Estimates of the static gains and time constants of a linear model, with their uncertainty.

# Greatest number of matrix entries: those of a larger model are no quantities of interest to users.
_MOST_ENTRIES = 150
# Greatest distance from the minimum in standard errors: a fit further away minimises another cost.
_NEAR = 0.5


def system_estimates(
    system: LinearSystem,
    records: ScaledData,
    report: Callable[[LinearSystem], Sequence[ParameterEstimate]],
) -> ParameterEstimates:
    """Estimate the uncertainty of quantities of a system, whatever the coordinates of its states.

    Args:
        system: fitted system.
        records: records of the fit; the initial state of each is fitted with the system.
        report: computes the quantities from a system.

    Raises:
        ValueError: for a system of too many numbers, if the simulation error of the records has
            no minimum at the system, and where `uncertainty.sandwich` raises it.
    """
    n, shapes = system.order, [part.shape for part in system.matrices]
    theta = np.concatenate([part.ravel() for part in system.matrices])
    if len(theta) > _MOST_ENTRIES:
        raise ValueError(f"{len(theta)} numbers: too many for standard errors; use a lower order")
    responses, starts = list[Array](), list[Array]()
    undisturbed = replace(system, offset=np.zeros_like(system.offset))
    for record in records:
        # Outputs (T, ny, n) to each initial state of length 1, and the best initial state.
        rest = np.zeros((n, *record.u.shape))
        responses.append(undisturbed.simulate(np.eye(n), rest)[1].transpose(1, 2, 0))
        forced = system.simulate(np.zeros((1, n)), record.u[None])[1][0]
        here = record.counts > 0
        starts.append(np.linalg.lstsq(responses[-1][here], (record.y - forced)[here])[0])

    def residuals(theta: Array) -> list[Array]:
        other = LinearSystem(*unpacked(theta, shapes))
        return [_errors(other, record, x0) for record, x0 in zip(records, starts, strict=True)]

    found, slopes = uncertainty.jacobians_of(residuals, theta)
    masks = [record.counts for record in records]
    covariance = uncertainty.sandwich(found, slopes, nuisance=responses, measured=masks)
    step = -covariance.information @ uncertainty.gradient(found, slopes, responses, masks)
    errors = np.sqrt(np.maximum(np.diagonal(covariance.matrix), 0.0))
    if np.any(np.abs(step) > _NEAR * errors + 1e-12):
        raise ValueError("the fit is no minimum of the simulation error of these records")
    return uncertainty.estimates(
        covariance, lambda x: report(LinearSystem(*unpacked(x, shapes))), theta
    )


def _errors(system: LinearSystem, record: ScaledTrajectory, x0: Array) -> Array:
    """Simulated minus measured outputs (T, ny)."""
    return -DrivenRecords([record]).response(system, x0[None]).misfit(0)


_INTEGRATOR = 1e-6
"""Distance of a pole from 1 below which no record tells it from an integrator."""


def invariants(system: LinearSystem, scaling: Scaling) -> dict[str, float]:
    """Static gains in physical units and the slowest decaying modes, by name: the time constant of
    a real mode in samples, frequency and damping ratio of an oscillating one. With an integrator
    there is no static gain."""
    poles = np.asarray(np.linalg.eigvals(system.a), np.complex128)
    integrators = int(np.sum(abs(poles - 1.0) < _INTEGRATOR))
    found = {"integrators": float(integrators)} if integrators else {}
    if not integrators:
        gain = system.gain * scaling.y_std[:, None] / scaling.u_std
        found = {f"gain y{i + 1}/u{j + 1}": float(g) for (i, j), g in np.ndenumerate(gain)}
        found = found if len(found) <= 20 else {}
    poles = poles[abs(poles - 1.0) >= _INTEGRATOR]
    sizes = np.abs(poles)
    # A negative real pole has neither a time constant nor a frequency below half the sampling rate.
    shown = ((poles.imag > 0) | ((poles.imag == 0) & (poles.real > 0))) & (sizes < 1)
    rates: list[complex] = np.log(poles[shown]).tolist()
    real = pairs = 0
    for rate in sorted(rates, key=lambda one: -one.real)[:6]:
        if rate.imag == 0:
            real += 1
            found[f"time constant {real} [samples]"] = float(-1.0 / rate.real)
        else:
            pairs += 1
            found[f"frequency {pairs} [1/sample]"] = float(abs(rate) / (2 * np.pi))
            found[f"damping {pairs}"] = float(-rate.real / abs(rate))
    return found


# Input offset at which a system with free integrators is at rest.


def drift_shift(records: ScaledData, order: int, integrators: int) -> Array:
    """Offset (nu,) to add to the inputs so that the integrators are at rest at zero.

    It is found by a fit with a constant as a further input; of several offsets it is the smallest.
    """
    known = [
        replace(r, u=np.hstack([r.u, np.ones((len(r), 1))]), undelayed_u=r.undelayed_u)
        for r in records
    ]
    refinement = Refinement(iterations=20, integrators=integrators)
    s = fit(known, max(order, integrators + 1), refinement).system
    m = s.order - integrators
    steady = solve_or_fit(np.eye(m) - s.a[:m, :m], s.b[:m])
    rates = s.a[m:, :m] @ steady + s.b[m:]
    # Only the first state of a chain drifts; the others integrate it.
    return np.asarray(np.linalg.lstsq(rates[:, :-1], rates[:, -1], rcond=1e-3)[0], np.float64)
