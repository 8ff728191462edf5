"""Simulation-error fit of a linear state-space system: start, refinement, choice of order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asia.candidate import Context
from asia.data import Array
from asia.models._data.encoder import Encoder, fit_encoder
from asia.models._data.records import (
    ScaledData,
    ScaledTrajectory,
    contiguous_splits,
    past_length,
    windows,
)
from asia.models._linear.subspace import spread_poles, starts
from asia.models._linear.system import LinearSystem, delayed_convolution, powers, states_of
from asia.models._solvers.progress import Progress

# A system this close to the unit circle or beyond grows without bound on a longer record.
_LARGEST_RADIUS = 1.0 - 1e-9


@dataclass(frozen=True)
class Refinement:
    """Levenberg-Marquardt in NumPy."""

    iterations: int = 50
    """Greatest number of steps."""
    initial_ridge: float = 30.0
    """Weight, in samples, of a prior that holds the initial states of the records to unit size;
    without it a slow mode started far off explains drift that the inputs did not cause."""
    damping: float = 1e-2
    """First damping, relative to the scaled normal matrix."""
    tolerance: float = 1e-7
    """Relative decrease of the cost below which it stops."""


@dataclass(frozen=True)
class LinearFit:
    """A fitted system."""

    system: LinearSystem
    """For z-scored signals."""
    x0: Array
    """Initial states (R, n) of the training records."""
    error: float
    """Weighted mean squared simulation error in z-scores, infinite where it diverges."""


def fit(
    records: ScaledData, order: int, refinement: Refinement, log: Progress | None = None
) -> LinearFit:
    """Best start of this order by simulation error, then refined; log(iteration, error)."""
    pairs = [s.start(order) for s in starts(records, max(order, 4))]
    pairs.append(spread_poles(order, records[0].y.shape[1]))
    solved = [solve_linear_part(records, *pair) for pair in pairs if pair is not None]
    solved.sort(key=lambda s: s.error)
    count, best = refinement.iterations, solved[0]
    for i, start in enumerate(solved[:2]):
        other = refine(records, start, refinement, _offset(log, i * count, best.error))
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
    """Smallest order whose simulation error on held-out stretches, started from their own past
    windows as the model will be used, is within `tolerance` (relative, of the root) of the best."""
    splits = contiguous_splits(records, 3, 2 * past_length(context) + 4 * max_order)
    errors: list[float] = []
    for order in range(1, max_order + 1):
        logs: list[float] = []
        for kept, left in splits:
            candidate = fit(kept, order, refinement)
            encoder = encoder_of(kept, candidate, context)
            logs.append(np.log(unseen_error(left, candidate, encoder, context) + 1e-300))
        errors.append(float(np.exp(np.mean(logs))))
    limit = min(errors) * (1 + tolerance) ** 2
    return next((i for i, error in enumerate(errors, start=1) if error <= limit), 1)


def encoder_of(records: ScaledData, fitted: LinearFit, context: Context) -> Encoder:
    """Past window -> state, from the model's own states on the records it was fitted to."""
    states = simulated_states(records, fitted.system, fitted.x0)
    pairs = [(r, x) for r, x in zip(records, states, strict=True) if len(r) > past_length(context)]
    return fit_encoder(
        [windows(r, context) for r, _ in pairs], [x[past_length(context) :] for _, x in pairs]
    )


def unseen_error(
    records: ScaledData, fitted: LinearFit, encoder: Encoder, context: Context
) -> float:
    """Sum of squared simulation errors of records not fitted, each from its past window; a record
    no longer than that adds nothing."""
    start, total = past_length(context), 0.0
    for r in (r for r in records if len(r) > start):
        x0 = encoder(windows(r, context)[:1])
        _, y = fitted.system.simulate(x0, r.u[None, start:])
        total += float(((y[0] - r.y[start:]) ** 2).sum())
    return total


def simulation_error(records: ScaledData, system: LinearSystem, x0: Array) -> float:
    """Weighted mean squared simulation error over records and channels."""
    residual = _residual(records, system, x0)
    total = sum(float((r.weight**2).sum()) for r in records) * records[0].y.shape[1]
    error = float(residual @ residual) / max(total, 1.0)
    return error if np.isfinite(error) else float("inf")


def solve_linear_part(records: ScaledData, a: Array, c: Array) -> LinearFit:
    """B, D, offset and initial states by least squares on the simulation error, A and C given."""
    n, nu, ny = len(a), records[0].u.shape[1], records[0].y.shape[1]
    zero = LinearSystem(a, np.zeros((n, nu)), c, np.zeros((ny, nu)), np.zeros(ny))
    free = slice(n * n, None)
    columns, targets = [], []
    for i, r in enumerate(records):
        jacobian = _record_jacobian(zero, r, np.zeros(n), i, len(records))
        jacobian = np.delete(jacobian, np.s_[n * (n + nu) : n * (n + nu) + ny * n], axis=1)
        columns.append(jacobian[:, free])
        targets.append((r.y * r.weight[:, None]).ravel())
    theta = _damped_solve(np.concatenate(columns), np.concatenate(targets), 1e-8)
    b, d, offset, x0 = np.split(theta, np.cumsum([n * nu, ny * nu, ny]))
    system = LinearSystem(a, b.reshape(n, nu), c, d.reshape(ny, nu), offset)
    system, x0 = normalised(records, system, x0.reshape(-1, n))
    return LinearFit(system, x0, simulation_error(records, system, x0))


def normalised(records: ScaledData, system: LinearSystem, x0: Array) -> tuple[LinearSystem, Array]:
    """States scaled to unit mean square over the training records; full whitening would mix
    states of very different energy and lose accuracy."""
    states = np.concatenate(simulated_states(records, system, x0))
    scale = np.sqrt((states**2).mean(axis=0))
    t = np.diag(1.0 / np.where(np.isfinite(scale) & (scale > 1e-12), scale, 1.0))
    return system.transformed(t), x0 @ t.T


def simulated_states(records: ScaledData, system: LinearSystem, x0: Array) -> list[Array]:
    """States (T, n) of each record from its initial state."""
    power = powers(system.a, max(len(r) for r in records))
    return [states_of(system, power[: len(r)], x, r.u) for r, x in zip(records, x0, strict=True)]


def refine(
    records: ScaledData, start: LinearFit, refinement: Refinement, log: Progress | None = None
) -> LinearFit:
    """Levenberg-Marquardt on A, B, C, D, offset and the initial states.

    The parametrisation is redundant (any change of state coordinates); the damping makes the
    step unique. A step to an unstable system is refused.
    """
    prior = refinement.initial_ridge * start.error if np.isfinite(start.error) else 0.0
    current, damping = start, refinement.damping
    for iteration in range(refinement.iterations):
        if log is not None:
            log(iteration, float(np.sqrt(current.error)))
        jacobian, residual = _linearised(records, current, prior)
        cost = float(residual @ residual)
        scale = np.sqrt(np.einsum("ij,ij->j", jacobian, jacobian))
        scale = np.where(scale > 0, scale, 1.0)
        scaled = jacobian / scale
        normal, gradient = scaled.T @ scaled, scaled.T @ residual
        proposal, proposed = current, cost
        while damping < 1e8:
            step = np.linalg.solve(normal + damping * np.eye(len(normal)), gradient) / scale
            proposal = _moved(records, current, step)
            proposed = _penalised(records, proposal, prior)
            if proposed < cost:
                break
            damping *= 8.0
        if not proposed < cost:
            break
        current, damping = proposal, max(damping * 0.2, 1e-9)
        if 1 - proposed / cost < refinement.tolerance:
            break
    return current


def _penalised(records: ScaledData, fitted: LinearFit, prior: float) -> float:
    if not np.isfinite(fitted.error):
        return float("inf")
    samples = sum(float((r.weight**2).sum()) for r in records) * records[0].y.shape[1]
    return fitted.error * max(samples, 1.0) + prior * float((fitted.x0**2).sum())


def _linearised(records: ScaledData, current: LinearFit, prior: float) -> tuple[Array, Array]:
    count, root = len(records), float(np.sqrt(prior))
    parts = [
        _record_jacobian(current.system, r, x, i, count)
        for i, (r, x) in enumerate(zip(records, current.x0, strict=True))
    ]
    pull = np.zeros((current.x0.size, parts[0].shape[1]))
    pull[:, -current.x0.size :] = root * np.eye(current.x0.size)
    residual = _residual(records, current.system, current.x0)
    return np.concatenate([*parts, pull]), np.append(residual, -root * current.x0)


def _moved(records: ScaledData, current: LinearFit, step: Array) -> LinearFit:
    s = current.system
    shapes = [s.a, s.b, s.c, s.d, s.offset, current.x0]
    parts = np.split(step, np.cumsum([p.size for p in shapes])[:-1])
    a, b, c, d, offset, x0 = (
        old + part.reshape(old.shape) for old, part in zip(shapes, parts, strict=True)
    )
    system = LinearSystem(a, b, c, d, offset)
    if not np.isfinite(a).all() or system.radius > _LARGEST_RADIUS:
        return LinearFit(system, x0, float("inf"))
    return LinearFit(system, x0, simulation_error(records, system, x0))


def _residual(records: ScaledData, system: LinearSystem, x0: Array) -> Array:
    with np.errstate(all="ignore"):
        states = simulated_states(records, system, x0)
        return np.concatenate(
            [
                (
                    r.weight[:, None] * (r.y - x @ system.c.T - r.u @ system.d.T - system.offset)
                ).ravel()
                for r, x in zip(records, states, strict=True)
            ]
        )


def _record_jacobian(
    system: LinearSystem, record: ScaledTrajectory, x0: Array, index: int, count: int
) -> Array:
    """Derivative of the weighted output of one record, (T * ny, parameters), in the order
    A, B, C, D, offset, initial states of all `count` records."""
    length, n, nu, ny = len(record), system.order, record.u.shape[1], record.y.shape[1]
    power = powers(system.a, length)
    states = states_of(system, power, x0, record.u)
    observed = system.c @ power
    sources = np.concatenate([states, record.u], axis=1)
    response = delayed_convolution(observed, sources)
    eye = np.broadcast_to(np.eye(ny)[None, :, :, None], (length, ny, ny, 1))
    direct_x = (eye * states[:, None, None, :]).reshape(length, ny, ny * n)
    direct_u = (eye * record.u[:, None, None, :]).reshape(length, ny, ny * nu)
    initial = np.zeros((length, ny, count, n))
    initial[:, :, index] = observed
    full = np.concatenate(
        [
            response[..., :n].reshape(length, ny, n * n),
            response[..., n:].reshape(length, ny, n * nu),
            direct_x,
            direct_u,
            eye[..., 0],
            initial.reshape(length, ny, count * n),
        ],
        axis=2,
    )
    return (full * record.weight[:, None, None]).reshape(length * ny, -1)


def _damped_solve(matrix: Array, target: Array, ridge: float) -> Array:
    scale = np.sqrt(np.einsum("ij,ij->j", matrix, matrix))
    scale = np.where(scale > 0, scale, 1.0)
    scaled = matrix / scale
    normal = scaled.T @ scaled + ridge * np.eye(matrix.shape[1])
    return np.linalg.solve(normal, scaled.T @ target) / scale
