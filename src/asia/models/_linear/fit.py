"""Simulation-error fit of a linear state-space system: start, refinement, choice of order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from asia.candidate import Context
from asia.data import Array
from asia.models._config import Progress
from asia.models._data.cuts import side_by_side
from asia.models._data.encoder import BlockedRidge, Encoder
from asia.models._data.records import (
    ScaledData,
    contiguous_splits,
    past_length,
    window_rows,
    windows,
)
from asia.models._data.window_encoder import window_encoder
from asia.models._least_squares import (
    SEQUENTIAL,
    LevenbergMarquardt,
    NormalEquations,
    damped_step,
    minimise,
)
from asia.models._linear.integrators import free_entries, integrating_starts
from asia.models._linear.long import LongResponse
from asia.models._linear.response import DrivenRecords, Response
from asia.models._linear.subspace import spread_poles, starts
from asia.models._linear.system import LinearSystem
from asia.models._noise.choice import NoiseChoice
from asia.models._noise.estimate import LEAST_DEVIATION, NOISE_ROUNDS, estimate_noise, settled
from asia.models._noise.weighting import ErrorWeighting

# Largest modulus of a pole: beyond it the system grows without bound on a longer record.
_LARGEST_RADIUS = 1.0 - 1e-9


@dataclass(frozen=True)
class Refinement:
    """Settings of Levenberg-Marquardt in NumPy."""

    iterations: int = 50
    """Greatest number of steps."""
    initial_ridge: float = 30.0
    """Weight, in samples, of a prior that holds the initial states of the records to unit size;
    without it a slow mode started far off explains drift that the inputs did not cause."""
    damping: float = 1e-2
    """First damping, relative to the scaled normal matrix."""
    tolerance: float = 1e-7
    """Relative decrease of the cost below which it stops."""
    noise: NoiseChoice | None = None
    """Noise model of `refined_under_noise`; None is least squares."""
    integrators: int = 0
    """Number of last states whose pole is held at 1."""

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

    system: LinearSystem
    """System for z-scored signals."""
    x0: Array
    """Initial states (R, n) of the training records."""
    error: float
    """Weighted mean squared simulation error in z-scores, infinite where it diverges."""


def fit(
    records: ScaledData, order: int, refinement: Refinement, log: Progress | None = None
) -> LinearFit:
    """Find the best start of this order by simulation error and refine it.

    Args:
        records: records in z-scores.
        order: number of states.
        refinement: settings.
        log: receives iteration and error.
    """
    if refinement.integrators:
        pairs = integrating_starts(records, order, refinement.integrators)
    else:
        pairs = [s.start(order) for s in starts(records, max(order, 4))]
        pairs.append(spread_poles(order, records[0].y.shape[1]))
    solved = [solve_linear_part(records, *pair) for pair in pairs if pair is not None]
    solved.sort(key=lambda s: s.error)
    best = solved[0]
    for i, start in enumerate(solved[:2]):
        begun = i * refinement.iterations
        other = refine(records, start, refinement, _offset(log, begun, best.error))
        best = min(best, other, key=lambda s: s.error)
    return best


def _offset(log: Progress | None, by: int, least: float) -> Progress | None:
    """Iterations counted from `by`, errors never above `least`."""
    if log is None:
        return None
    return lambda step, error: log(by + step, min(error, float(np.sqrt(least))))


def choose_order(
    records: ScaledData, context: Context, max_order: int, tolerance: float, refinement: Refinement
) -> int:
    """Smallest order whose simulation error on held-out segments is within `tolerance` of the best.

    The segments start from their own past windows, as the model will be used; the tolerance is
    relative, of the root.
    """
    pairs = contiguous_splits(records, 3, 2 * past_length(context) + 4 * max_order)
    splits = [(kept, left, _regression_of(kept, context)) for kept, left in pairs]
    errors: list[float] = []
    least = min(max(1, refinement.integrators), max_order)
    for order in range(least, max_order + 1):
        logs: list[float] = []
        for kept, left, regression in splits:
            candidate = fit(kept, order, refinement)
            encoder = encoder_of(kept, candidate, context, regression)
            logs.append(np.log(unseen_error(left, candidate, encoder, context) + 1e-300))
        errors.append(float(np.exp(np.mean(logs))))
    limit = min(errors) * (1 + tolerance) ** 2
    return next((i for i, error in enumerate(errors, start=least) if error <= limit), least)


def encoder_of(
    records: ScaledData,
    fitted: LinearFit,
    context: Context,
    regression: BlockedRidge | None = None,
) -> Encoder:
    """Map from a past window to the state, learned from the model's own states on the records of
    the fit.

    Args:
        records: records of the fit.
        fitted: fit.
        context: context of the fit.
        regression: regression on the past windows of these records, if it is known.
    """
    response = DrivenRecords(records).summed(fitted.system, fitted.x0)
    return window_encoder(records, response.states_of, context, regression=regression)


def _regression_of(records: ScaledData, context: Context) -> BlockedRidge:
    long = [r for r in records if len(r) > past_length(context)]
    rows = window_rows(long, context)
    return BlockedRidge(
        np.concatenate([windows(r, context)[at] for r, at in zip(long, rows, strict=True)])
    )


def unseen_error(
    records: ScaledData, fitted: LinearFit, encoder: Encoder, context: Context
) -> float:
    """Sum of squared simulation errors of records that were not fitted, each from its past window.

    A record no longer than its past window adds nothing.
    """
    start, total = past_length(context), 0.0
    for r in (r for r in records if len(r) > start):
        x0 = encoder(windows(r, context)[:1])
        _, y = fitted.system.simulate(x0, r.u[None, start:])
        total += float((r.counts[start:, None] * (y[0] - r.y[start:]) ** 2).sum())
    return total


def solve_linear_part(records: ScaledData, a: Array, c: Array) -> LinearFit:
    """Solve B, D, offset and initial states by least squares on the simulation error, A and C
    given."""
    n, nu, ny = len(a), records[0].u.shape[1], records[0].y.shape[1]
    zero = LinearSystem(a, np.zeros((n, nu)), c, np.zeros((ny, nu)), np.zeros(ny))
    driven = DrivenRecords(records)
    at_zero = driven.summed(zero, np.zeros((len(records), n)))
    normal, gradient = at_zero.normal_equations(poles=False)
    theta = damped_step(normal, -gradient, 1e-8)
    b, d, offset, x0 = np.split(theta, np.cumsum([n * nu, ny * nu, ny]))
    system = LinearSystem(a, b.reshape(n, nu), c, d.reshape(ny, nu), offset)
    return normalised(driven.summed(system, x0.reshape(-1, n)))


def normalised(response: Response | LongResponse) -> LinearFit:
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
    settles;
    without a noise model the fit is returned unchanged.
    """
    choice, noise = refinement.noise, None
    if choice is None:
        return found
    for _ in range(NOISE_ROUNDS):
        response = DrivenRecords(records).summed(found.system, found.x0)
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
) -> LinearFit:
    """Refine A, B, C, D, offset and the initial states by Levenberg-Marquardt.

    The parametrisation is redundant (any change of state coordinates); the damping makes the
    step unique. A step to an unstable system is refused.
    """
    prior = refinement.initial_ridge * start.error if np.isfinite(start.error) else 0.0
    driven, held = DrivenRecords(records, weightings), refinement.integrators
    free = free_entries(start.system.order, held).ravel()
    s, steps = start.system, count()
    arrays = [s.a, s.b, s.c, s.d, s.offset, start.x0]
    shapes, ends = [p.shape for p in arrays], np.cumsum([p.size for p in arrays])[:-1]
    theta0 = np.concatenate([p.ravel() for p in arrays])
    # Last simulation, with its parameters.
    known = theta0, driven.summed(s, start.x0)

    def response(theta: Array) -> Response | LongResponse:
        nonlocal known
        if not np.array_equal(theta, known[0]):
            parts = zip(np.split(theta, ends), shapes, strict=True)
            *system, x0 = (part.reshape(shape) for part, shape in parts)
            known = theta, driven.summed(LinearSystem(*system), x0)
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
        return np.array([[weighted + prior * (found.x0**2).sum()]])

    def linearise(theta: Array) -> NormalEquations:
        current = response(theta[0])
        if log is not None:
            log(next(steps), float(np.sqrt(current.error)))
        normal, gradient = current.normal_equations()
        last = current.x0.size
        normal[-last:, -last:] += prior * np.eye(last)
        gradient[-last:] -= prior * current.x0.ravel()
        # Held entries of A.
        normal[: free.size] *= free[:, None]
        normal[:, : free.size] *= free
        gradient[: free.size] *= free
        square = current.square + prior * (current.x0**2).sum()
        return NormalEquations(np.array([square]), normal[None], -gradient[None])

    method = LevenbergMarquardt(
        refinement.iterations, damping=refinement.damping, tolerance=refinement.tolerance
    )
    found = response(minimise(cost, linearise, theta0[None], method, SEQUENTIAL).theta[0])
    return LinearFit(found.system, found.x0, found.error)
