"""Linear plants from records taken under feedback: direct, two-stage, and through the controller.

Feedback carries noise of the output into the input, so that the least simulation error from the
measured input belongs to a biased plant. Each method here avoids that:

- "direct": one-step predictor of an innovations model, which models the noise with the plant.
- "two_stage": the parts of input and output that the reference explains are free of noise; the
  plant is fitted between them.
- "controller": the loop of plant and known controller is simulated from the reference alone.

Sources: Forssell and Ljung, Automatica 35(7), 1999; Van den Hof and Schrama, Automatica 29(6),
1993; Chiuso, Automatica 43(6), 2007 (start of the predictor).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import MOST_DELAY, Array, Trajectory
from asia.errors import UserError
from asia.models._arrays import AnyArray
from asia.models._least_squares import (
    SEQUENTIAL,
    LevenbergMarquardt,
    NormalEquations,
    minimise,
    solve_or_fit,
)
from asia.models._linear.fit import Refinement, fit, stabilised
from asia.models._linear.response import DrivenRecords, Response
from asia.models._linear.system import LinearSystem, unpacked
from asia.models._numerics.encoder import Encoder, affine
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import ScaledTrajectory, delayed, scaled

if TYPE_CHECKING:
    from asia.models.linear import Config
    from asia.problem.feedback import Loop

LoopMethod: TypeAlias = Literal["direct", "two_stage", "controller"]

# States of the model from the reference to inputs and outputs: those of plant and controller.
_STAGE_ORDER = 12
# Lags of the difference equation that starts a predictor, and of the filter that whitens errors.
_LAGS, _WHITENING = 20, 12
# Samples for the start of a predictor.
_MOST_SAMPLES = 20_000
# Greatest modulus of the poles of a plant whose output is simulated from its input alone.
_DECAYING = 0.999


@dataclass(frozen=True)
class Innovations:
    """x[k+1] = A x + B u + drift + K e,  y = C x + D u + offset + e, for z-scored signals."""

    system: LinearSystem
    drift: Array  # (n,)
    k: Array  # (n, ny)
    error: float  # Mean square of e

    @property
    def predictor(self) -> LinearSystem:
        """System from [u, y] to the one-step prediction of y."""
        s, k = self.system, self.k
        b = np.hstack([s.b - k @ s.d, k])
        return LinearSystem(s.a - k @ s.c, b, s.c, _padded(s.d, len(s.c)), s.offset)


def fit_in_loop(
    trajectories: Sequence[Trajectory],
    context: Context,
    method: LoopMethod,
    choices: Config,
    refinement: Refinement,
    scaling: Scaling,
) -> tuple[LinearSystem, Encoder, int, Scaling]:
    """Fit the plant of records taken in closed loop.

    Returns:
        System, encoder, delay and scaling of the fitted model. Where a constant input is needed
            to hold an integrating plant at rest, the scaling has it as the mean of the input.

    Raises:
        UserError: where the method needs a reference or a controller that the problem lacks, and
            where no start is stable in the loop.
    """
    if context.loop is not None and context.loop.inputs == "explained":
        raise UserError(
            f"linear: loop='{method}' needs measured inputs, but [loop] has inputs = 'explained': "
            "leave one of them out"
        )
    records = scaled(trajectories, scaling)
    delay = _delay(records, choices) if choices.delay is None else choices.delay
    late = [r.with_delay(delay) for r in records]
    plant = _direct(late, choices, refinement, context)
    if method != "direct":
        loop = context.loop
        if loop is None or any(t.reference is None for t in trajectories):
            raise UserError(
                f"linear: loop='{method}' needs the measured reference: name its column in "
                "[loop] reference of problem.toml, or take loop='direct'"
            )
        references = [t.reference for t in trajectories if t.reference is not None]
        direct, choices = plant, replace(choices, order=plant.system.order)
        plant = _two_stage(late, references, delay, choices, refinement, context)
        if method == "controller":
            starts = [direct, plant]
            plant = _through_controller(
                late, references, delay, loop, starts, refinement, scaling, context
            )
    plant, scaling = _at_rest(plant, scaling)
    measured = [r.with_delay(delay) for r in scaled(trajectories, scaling)]
    return plant.system, _encoder(plant, measured, delay, context), delay, scaling


# Direct method.


def _direct(
    records: Sequence[ScaledTrajectory], choices: Config, refinement: Refinement, context: Context
) -> Innovations:
    """Fit the predictor of an innovations model; an open order is the one of the least Bayesian
    information criterion."""
    nu, ny = records[0].u.shape[1], records[0].y.shape[1]
    driven = [replace(r, u=np.hstack([r.u, r.y]), undelayed_u=r.undelayed_u) for r in records]
    samples = sum(float((r.weight > 0).sum()) for r in records)
    start = _predictor_start(records)
    best, least = None, np.inf
    most = max(1, min(choices.max_order, min(len(r) for r in records) // 8))
    for n in range(1, most + 1) if choices.order is None else (choices.order,):
        shapes = [(n, n), (n, nu + ny), (ny, n), (ny, nu), (ny,)]

        def predictor(theta: Array, shapes: list[tuple[int, ...]] = shapes) -> list[Array]:
            f, b, c, d, offset = unpacked(theta, shapes)
            return [f, b, c, _padded(d, ny), offset]

        theta = np.concatenate([part.ravel() for part in start(n)])
        found, _, error = _minimised(driven, theta, n, predictor, refinement, context)
        f, both, c, d, offset = unpacked(found, shapes)
        b, k = both[:, :nu], both[:, nu:]
        criterion = samples * np.log(error + 1e-300) + n * (nu + 2 * ny) * np.log(samples)
        if best is None or criterion < least:
            system = LinearSystem(f + k @ c, b + k @ d, c, d, offset)
            best, least = Innovations(system, k @ offset, k, error), criterion
    assert best is not None
    return best


def _predictor_start(records: Sequence[ScaledTrajectory]) -> Callable[[int], list[Array]]:
    """Matrices F, [B K], C, D and offset of a predictor of any order, from a difference equation
    with many lags: its coefficients are the Markov parameters of the predictor."""
    nu, ny = records[0].u.shape[1], records[0].y.shape[1]
    m, total = nu + ny, sum(len(r) for r in records)
    lags = max(2, min(_LAGS, min(len(r) for r in records) // 3, total // (6 * m)))
    past, u, y = _lagged(records, lags)
    rows = np.hstack([past, u, np.ones((len(u), 1))])
    gram = rows.T @ rows + 1e-6 * len(rows) * np.eye(rows.shape[1])
    theta = np.linalg.solve(gram, rows.T @ y)
    markov = theta[: lags * m].reshape(lags, m, ny).transpose(0, 2, 1)
    # Observability times states, its rows shifted by one lag each.
    blocks = max(lags // 2, 2)
    shifted = np.zeros((blocks, ny, lags, m))
    for j in range(blocks):
        shifted[j, :, : lags - j] = markov[j:].transpose(1, 0, 2)
    product = shifted.reshape(blocks * ny, lags * m)
    centred = past - past.mean(axis=0)
    left, squares, _ = np.linalg.svd(product @ (centred.T @ centred / len(past)) @ product.T)

    def start(order: int) -> list[Array]:
        n = min(order, len(squares))
        scale = np.sqrt(np.maximum(squares[:n], 1e-12 * squares[0] + 1e-300))
        states = centred @ product.T @ (left[:, :n] / scale)
        if n < order:
            extra = np.random.default_rng(0).standard_normal((len(states), order - n))
            states = np.hstack([states, 1e-3 * extra])
        known = np.hstack([states, u, np.ones((len(u), 1))])
        c, d, offset = np.split(_regression(known, y).T, [order, order + nu], axis=1)
        # States of one record follow each other; rows where the next record begins are few.
        f, b = np.split(_regression(np.hstack([states, u, y])[:-1], states[1:]).T, [order], axis=1)
        return [stabilised(f), b, c, d, offset[:, 0]]

    return start


def _lagged(records: Sequence[ScaledTrajectory], lags: int) -> tuple[Array, Array, Array]:
    """Past inputs and outputs (N, lags * (nu + ny)), the last sample first, then the present
    inputs and outputs."""
    found: list[tuple[Array, Array, Array]] = []
    left = _MOST_SAMPLES
    for r in records:
        u, y = r.u[:left], r.y[:left]
        left -= len(u)
        if len(u) > lags:
            z = np.hstack([u, y])
            past = np.hstack([z[lags - i : len(z) - i] for i in range(1, lags + 1)])
            found.append((past, u[lags:], y[lags:]))
    past, u, y = (np.concatenate([part[i] for part in found]) for i in range(3))
    return past, u, y


def _regression(x: Array, y: Array) -> Array:
    gram = x.T @ x
    ridge = 1e-8 * np.trace(gram) / len(gram) * np.eye(len(gram))
    return np.linalg.solve(gram + ridge, x.T @ y)


def _delay(records: Sequence[ScaledTrajectory], choices: Config) -> int:
    """Smallest delay, 1 or more, whose difference equation of few lags predicts within 1 % of the
    best. A controller answers in the same sample: a predictor cannot tell a plant without delay
    from it."""
    lags, errors = choices.order or 3, list[float]()
    for delay in range(1, MOST_DELAY + 1):
        past, u, y = _lagged([r.with_delay(delay) for r in records], lags)
        rows = np.hstack([past, u, np.ones((len(u), 1))])[MOST_DELAY:]
        y = y[MOST_DELAY:]
        errors.append(float(((y - rows @ _regression(rows, y)) ** 2).mean()))
    return next(d for d, error in enumerate(errors, 1) if error <= 1.01 * min(errors))


def _padded(d: Array, ny: int) -> Array:
    return np.hstack([d, np.zeros((ny, ny))])


# Two-stage method.


def _two_stage(
    records: Sequence[ScaledTrajectory],
    references: Sequence[Array],
    delay: int,
    choices: Config,
    refinement: Refinement,
    context: Context,
) -> Innovations:
    """Fit the plant between the parts of its input and output that the reference explains."""
    nu = records[0].u.shape[1]
    r = _standardised(references)
    driven = [
        replace(one, u=given, y=np.hstack([one.u, one.y]), undelayed_u=given)
        for one, given in zip(records, r, strict=True)
    ]
    shortest = min(len(one) for one in records)
    found = fit(driven, max(1, min(_STAGE_ORDER + delay, shortest // 8)), refinement)
    response = DrivenRecords(driven).response(found.system, found.x0)
    explained = [one.y - response.misfit(i) for i, one in enumerate(driven)]
    clean = [
        replace(one, u=e[:, :nu], undelayed_u=e[:, :nu], y=e[:, nu:])
        for one, e in zip(records, explained, strict=True)
    ]
    plant = _direct(clean, choices, refinement, context)
    if plant.system.radius < _DECAYING:
        # The output itself has errors that its filtering by a predictor would amplify.
        outputs = [replace(c, y=one.y) for c, one in zip(clean, records, strict=True)]
        better = fit(outputs, plant.system.order, refinement, context.log)
        plant = replace(plant, system=better.system, drift=np.zeros(better.system.order))
    # The gain belongs to signals without noise.
    return _levelled(replace(plant, k=np.zeros((plant.system.order, len(plant.system.c)))), records)


def _standardised(references: Sequence[Array]) -> list[Array]:
    whole = np.concatenate(references)
    spread = whole.std(axis=0)
    if not (spread > 0).all():
        raise UserError(
            "linear: a reference is constant in every training record, so that it explains "
            "nothing: take loop='direct', or record data with a moving reference"
        )
    return [(r - whole.mean(axis=0)) / spread for r in references]


# Fit through the known controller.


def _through_controller(
    records: Sequence[ScaledTrajectory],
    references: Sequence[Array],
    delay: int,
    loop: Loop,
    starts: Sequence[Innovations],
    refinement: Refinement,
    scaling: Scaling,
    context: Context,
) -> Innovations:
    """Refine the plant by the simulation error of its loop with the controller.

    The errors are whitened by an autoregressive filter, since the loop colours the noise of the
    output.
    """
    if loop.controller is None or isinstance(loop.controller, str):
        raise UserError(
            "linear: loop='controller' needs [loop] controller in problem.toml: give it, or take "
            "loop='two_stage' or loop='direct'"
        )
    control = loop.controller.delayed(delay)
    ac, bc, cc, dc = control.matrices
    ys, us = scaling.y_std, scaling.u_std
    # Controller from errors in z-scores of the output to inputs in z-scores, and the constant
    # input that the means of the signals need.
    bc, cc, dc = bc * ys, cc / us[:, None], dc * ys / us[:, None]
    constant = -scaling.u_mean / us
    nr, ny, nu, nc = references[0].shape[1], len(ys), len(us), len(ac)
    to_error, to_input = np.eye(ny, nr), np.zeros((nu, nr))
    if loop.enters == "plant":
        to_error, to_input = np.zeros((ny, nr)), np.eye(nu, nr)
        signals = [np.roll(r, delay, axis=0) / us[:nr] for r in references]
        mean_error = -scaling.y_mean / ys
        for s, r in zip(signals, references, strict=True):
            s[:delay] = r[0] / us[:nr]
    else:
        signals = [(r - scaling.y_mean) / ys for r in references]
        mean_error = np.zeros(ny)
    to_error = np.hstack([to_error, mean_error[:, None]])
    to_input = np.hstack([to_input, constant[:, None]])
    driven = [
        replace(one, u=np.hstack([s, np.ones((len(s), 1))]), undelayed_u=s)
        for one, s in zip(records, signals, strict=True)
    ]

    def closed(n: int) -> Callable[[Array], list[Array]]:
        shapes = [(n, n), (n, nu), (n,), (ny, n), (ny, nu), (ny,)]

        def system_of(theta: Array) -> list[Array]:
            a, b, drift, c, d, offset = unpacked(theta, shapes)
            # y and u by [x, xc] and by [r, 1], the algebraic loop solved.
            inverse = np.linalg.inv(np.eye(ny) + d @ dc)
            injected = dc @ to_error + to_input
            injected_y = d @ injected
            injected_y[:, -1] += offset
            y_x, y_r = inverse @ np.hstack([c, d @ cc]), inverse @ injected_y
            u_x = np.hstack([np.zeros((nu, n)), cc]) - dc @ y_x
            u_r = injected - dc @ y_r
            by_drift = np.zeros((n, nr + 1), theta.dtype)
            by_drift[:, -1] = drift
            left = np.block([[a, np.zeros((n, nc))], [np.zeros((nc, n)), ac]])
            whole_a = left + np.vstack([b @ u_x, -bc @ y_x])
            whole_b = np.vstack([b @ u_r + by_drift, bc @ (to_error - y_r)])
            return [whole_a, whole_b, y_x, y_r, np.zeros(ny)]

        return system_of

    best: Innovations | None = None
    for start in starts:
        s = start.system
        n, system_of = s.order, closed(s.order)
        theta = np.concatenate([p.ravel() for p in (s.a, s.b, start.drift, s.c, s.d, s.offset)])
        if not abs(np.linalg.eigvals(system_of(theta)[0])).max(initial=0.0) < 1.0:
            continue
        settings = refinement, context
        theta, rest, error = _minimised(driven, theta, n + nc, system_of, *settings)
        weights = _whitening([rest.misfit(i) for i in range(len(driven))])
        white = [_filtered(one, weights) for one in driven]
        theta, _, error = _minimised(white, theta, n + nc, system_of, *settings)
        shapes = [(n, n), (n, nu), (n,), (ny, n), (ny, nu), (ny,)]
        a, b, drift, c, d, offset = unpacked(theta, shapes)
        if best is None or error < best.error:
            gain = np.zeros((n, ny))
            best = Innovations(LinearSystem(a, b, c, d, offset), drift, gain, error)
    if best is None:
        raise UserError(
            "linear: loop='controller': no start is stable in the loop with the controller of "
            "[loop]: check its signs, its sampling time and where the reference enters"
        )
    # An integrating controller hides the constants of the plant from its loop.
    return _levelled(best, records)


def _whitening(residuals: Sequence[Array]) -> Array:
    """Coefficients (lags + 1,) of an autoregressive filter, one for all outputs."""
    lags = max(1, min(_WHITENING, min(len(r) for r in residuals) // 8))
    columns = [column for r in residuals for column in (r / (r.std(axis=0) + 1e-300)).T]
    windows = np.concatenate(
        [np.lib.stride_tricks.sliding_window_view(column, lags + 1) for column in columns]
    )
    return np.concatenate([[1.0], -_regression(windows[:, -2::-1], windows[:, -1])])


def _filtered(record: ScaledTrajectory, weights: Array) -> ScaledTrajectory:
    lags = len(weights) - 1

    def through(values: Array) -> Array:
        return np.stack([np.convolve(c, weights)[lags : len(c)] for c in values.T], axis=1)

    weight = record.weight
    u, y = through(record.u), through(record.y)
    return replace(
        record, u=u, y=y, undelayed_u=u, weight=weight[lags:], counts=record.counts[lags:]
    )


# Shared parts: minimisation, constants, initial state.


def _minimised(
    records: Sequence[ScaledTrajectory],
    theta0: Array,
    states: int,
    system_of: Callable[[Array], list[Array]],
    refinement: Refinement,
    context: Context,
) -> tuple[Array, Response, float]:
    """Minimise the simulation error over the parameters of a system and its initial states.

    Args:
        records: inputs and outputs of the system.
        theta0: start.
        states: order of the system.
        system_of: matrices A, B, C, D and offset by the parameters; complex ones are allowed, so
            that derivatives by complex steps are exact.
        refinement: iterations, damping and tolerance.
        context: receives the log.

    Returns:
        Parameters, response and mean squared error.
    """
    driven, size = DrivenRecords(records), theta0.size
    start = np.concatenate([theta0, np.zeros(len(records) * states)])
    known: dict[bytes, Response] = {}

    def response(point: Array) -> Response:
        if point.tobytes() not in known:
            known.clear()
            x0 = point[size:].reshape(len(records), states)
            known[point.tobytes()] = driven.response(LinearSystem(*system_of(point[:size])), x0)
        return known[point.tobytes()]

    def cost(points: Array) -> Array:
        a = system_of(points[0, 0, :size])[0]
        if not np.isfinite(a).all() or abs(np.linalg.eigvals(a)).max(initial=0.0) >= 1.0:
            return np.array([[np.inf]])
        return np.array([[response(points[0, 0]).square]])

    def linearise(theta: Array) -> NormalEquations:
        current = response(theta[0])
        context.log(0, float(np.sqrt(current.error)))
        normal, gradient = current.normal_equations()
        # From derivatives by the matrices to those by the parameters.
        steps = theta[0, :size] + 1e-30j * np.eye(size)
        columns = [np.concatenate([m.imag.ravel() for m in system_of(s)]) for s in steps]
        slopes = np.zeros((len(normal), len(start)))
        slopes[: len(columns[0]), :size] = np.stack(columns, axis=1) * 1e30
        slopes[len(columns[0]) :, size:] = np.eye(len(start) - size)
        gram = slopes.T @ normal @ slopes
        return NormalEquations(np.array([current.square]), gram[None], -(gradient @ slopes)[None])

    method = LevenbergMarquardt(
        refinement.iterations, damping=refinement.damping, tolerance=refinement.tolerance
    )
    found = minimise(cost, linearise, start[None], method, SEQUENTIAL).theta[0]
    return found[:size], response(found), response(found).error


def _levelled(plant: Innovations, records: Sequence[ScaledTrajectory]) -> Innovations:
    """Drift and offset from the measured inputs, by the least error of the filter of the plant; its
    error becomes that of the noise of the output."""
    s, n, ny = plant.system, plant.system.order, len(plant.system.c)
    gain = _noise_filter(plant)[0]
    plain = replace(plant, system=replace(s, offset=np.zeros(ny)), drift=np.zeros(n), k=gain)
    # Free responses to the states of a record and to constants, which are states that stay.
    predictor = plain.predictor
    a = np.eye(2 * n + ny)
    a[:n] = np.hstack([predictor.a, np.eye(n), -gain])
    c = np.hstack([predictor.c, np.zeros((ny, n)), np.eye(ny)])
    nothing = np.zeros((len(a), 0))
    free = LinearSystem(a, nothing, c, np.zeros((ny, 0)), np.zeros(ny))
    longest = max(len(r) for r in records)
    basis = free.simulate(np.eye(len(a)), np.zeros((len(a), longest, 0)))[1]
    rows, left = list[Array](), list[Array]()
    for i, r in enumerate(records):
        y_hat = predictor.simulate(np.zeros((1, n)), np.hstack([r.u, r.y])[None])[1][0]
        kept = r.weight > 0
        response = basis[:, : len(r)][:, kept].T
        own = np.zeros((len(response), len(records) * n))
        own[:, i * n : (i + 1) * n] = response[:, :n]
        rows.append(np.hstack([response[:, n:], own]))
        left.append((r.y - y_hat)[kept])
    matrix, wanted = np.concatenate(rows), np.concatenate(left)
    found = np.linalg.lstsq(matrix, wanted, rcond=1e-8)[0]
    error = float(np.mean((wanted - matrix @ found) ** 2))
    system = replace(s, offset=found[n : n + ny])
    return replace(plant, system=system, drift=found[:n], error=error)


def _at_rest(plant: Innovations, scaling: Scaling) -> tuple[Innovations, Scaling]:
    """Move the drift of the states into the offset, and into the mean of the inputs where the
    plant integrates."""
    s, n = plant.system, plant.system.order
    stiffness = np.eye(n) - s.a
    rest = np.linalg.lstsq(stiffness, plant.drift, rcond=1e-9)[0]
    shift = np.zeros(s.b.shape[1])
    if np.abs(stiffness @ rest - plant.drift).max() > 1e-6 * np.abs(plant.drift).max():
        both = np.linalg.lstsq(np.hstack([stiffness, s.b]), plant.drift, rcond=1e-12)[0]
        rest, shift = both[:n], both[n:]
    system = replace(s, offset=s.offset + s.c @ rest - s.d @ shift)
    scaling = replace(scaling, u_mean=scaling.u_mean - shift * scaling.u_std)
    return replace(plant, system=system, drift=np.zeros(n)), scaling


def _noise_filter(
    plant: Innovations,
) -> tuple[Array, Array, Callable[[Array], tuple[Array, Array]]]:
    """Steady gain and covariance of the Kalman filter of the plant, and its update of a
    covariance."""
    s, noise = plant.system, plant.error * np.eye(len(plant.system.c))
    driving = plant.k @ noise @ plant.k.T + 1e-9 * np.eye(s.order)

    def update(p: Array) -> tuple[Array, Array]:
        spread = s.c @ p @ s.c.T + noise + 1e-12 * np.eye(len(noise))
        cross = s.a @ p @ s.c.T + plant.k @ noise
        gain = solve_or_fit(spread, cross.T).T
        after = s.a @ p @ s.a.T + driving - gain @ cross.T
        return gain, 0.5 * (after + after.T)

    gain, p = update(np.eye(s.order))
    for _ in range(200):
        gain, p = update(p)
    return gain, p, update


def _encoder(
    plant: Innovations, records: Sequence[ScaledTrajectory], delay: int, context: Context
) -> Encoder:
    """State after a past window by the Kalman filter of the plant.

    Before the window the state has mean and covariance of a filter over the records.
    """
    s = plant.system
    gain, p, update = _noise_filter(plant)
    steady = Innovations(s, plant.drift, gain, plant.error).predictor
    x, seen = np.zeros((1, s.order)), list[Array]()
    for r in records:
        seen.append(steady.simulate(x, np.hstack([r.u, r.y])[None])[0][0])
    states = np.concatenate(seen)
    mean, p = states.mean(axis=0), np.cov(states.T, ddof=0).reshape(s.order, s.order) + p
    nu, ny, length = s.b.shape[1], len(s.c), min(context.n_past_u, context.n_past_y)
    d = context.n_past_u * nu + context.n_past_y * ny
    features = np.vstack([np.zeros((1, d)), np.eye(d)])
    past_u = features[:, : context.n_past_u * nu].reshape(d + 1, context.n_past_u, nu)
    past_y = features[:, context.n_past_u * nu :].reshape(d + 1, context.n_past_y, ny)
    first = context.n_past_u - length
    u = delayed(past_u[:, :first], past_u[:, first:], delay) if length else past_u
    x: AnyArray = np.tile(mean, (d + 1, 1))
    for k in range(length):
        gain, p = update(p)
        error = past_y[:, context.n_past_y - length + k] - (x @ s.c.T + u[:, k] @ s.d.T + s.offset)
        x = x @ s.a.T + u[:, k] @ s.b.T + plant.drift + error @ gain.T
    return affine(x[1:] - x[0], x[0])
