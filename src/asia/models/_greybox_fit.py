"""Fitting a grey-box to records: screening, multi-start, then the additions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from asia.models._greybox_config import Structure
from asia.models._greybox_simulate import (
    Scales,
    WindowPrior,
    prior_residuals,
    simulate_states,
    window_features,
)
from asia.models._lm import LevenbergMarquardt, LMResult, levenberg_marquardt
from asia.models._ode import Equations
from asia.problem import Array, Trajectory
from asia.problem._expressions import Name

# Where an addition has no effect: a limit far above any state, a fraction of zero.
_NO_LIMIT = 20.0
_NO_SPILL = -30.0
_SCREENED_PER_START = 16
_MOST_INITIAL_STATES = 240
_INITIAL_RIDGE = 1e-4
_OPEN = 1e9
DEBUG = True


class Segments(NamedTuple):
    """Training records side by side: u (S, T, nu), y (S, T, ny), mask (S, T), 0 in the padding."""

    u: Array
    y: Array
    mask: Array


@dataclass(frozen=True)
class Fitted:
    """Coordinates, scales and window prior of a fitted model, with its cost after each
    iteration."""

    z: Array
    scales: Scales
    prior: WindowPrior
    history: Array


class _Starts(NamedTuple):
    """Starting points, one a row: coordinates and initial states with their normalisation."""

    z: Array
    shift: Array
    x_guess: Array
    scales: Scales


def cut_segments(
    structure: Structure, trajectories: Sequence[Trajectory], horizon: int | None
) -> Segments:
    """Whole records, or, with a horizon, windows of past and horizon spread over them."""
    pieces: list[Trajectory] = list(trajectories)
    if horizon is not None:
        length = structure.n_past + horizon
        pieces = [t[k : k + length] for t in trajectories for k in range(0, len(t), length)]
        pieces = [t for t in pieces if len(t) == length] or list(trajectories)
        most = max(1, _MOST_INITIAL_STATES // structure.nx)
        if len(pieces) > most:
            chosen = np.linspace(0, len(pieces) - 1, most).round().astype(int)
            pieces = [pieces[i] for i in chosen]
    longest = max(len(t) for t in pieces)

    def pad(values: Array) -> Array:
        return np.pad(values, ((0, longest - len(values)), (0, 0)), mode="edge")

    mask = np.array([np.arange(longest) < len(t) for t in pieces], dtype=np.float64)
    return Segments(
        np.stack([pad(t.u) for t in pieces]), np.stack([pad(t.y) for t in pieces]), mask
    )


def fit(structure: Structure, segments: Segments, method: LevenbergMarquardt, seed: int) -> Fitted:
    """The best of `method.starts` fits. First the equations alone, from points drawn in their
    ranges and screened; then, from the best of these, the additions. The same seed gives bitwise
    the same result."""
    rng = np.random.default_rng(seed)
    with jax.enable_x64(True):
        run = _fitter(structure, method)
        layout = structure.layout
        starts = _screen(structure, segments, method.starts, rng)
        active = np.zeros(layout.size)
        active[layout.parameters] = 1.0
        result: LMResult = jax.device_get(run(starts, segments, active))
        history = result.history[np.argmin(result.cost)]
        if structure.config.augmented:
            starts = _augment(structure, segments, starts, result, rng)
            result = jax.device_get(run(starts, segments, np.ones(layout.size)))
            history = np.concatenate([history, result.history[np.argmin(result.cost)]])
        best = int(np.argmin(result.cost))
        if DEBUG:
            print(np.round(np.sort(result.cost), 4), result.iterations)
        if not np.isfinite(result.cost).any():
            raise FloatingPointError("grey-box: no starting point gives a finite simulation")
        return _finish(structure, segments, starts, result, history)


def _initial_states(structure: Structure, starts: _Starts, result: LMResult, i: int) -> Array:
    shift = np.asarray(result.theta[i, structure.layout.size :]).reshape(-1, structure.nx)
    return starts.x_guess[i] + shift * starts.scales.x_scale[i]


@lru_cache(maxsize=64)
def _fitter(structure: Structure, method: LevenbergMarquardt) -> Any:
    """Compiled fit: (starts, segments, active) -> LMResult, one row a start."""

    def one(start: _Starts, segments: Segments, active: jax.Array) -> LMResult:
        linearised = _linearised(structure, start, segments, active)
        theta0 = jnp.concatenate([start.z, start.shift.ravel()])
        return levenberg_marquardt(
            lambda theta: _residuals(structure, start, segments, active, theta),
            theta0,
            method,
            linearised,
        )

    return jax.jit(jax.vmap(one, in_axes=(0, None, None)))


def _segment_residual(
    structure: Structure, start: _Starts, segments: Segments, theta: jax.Array, i: jax.Array
) -> jax.Array:
    """Normalised, masked and, where asked for, robust errors (T ny) of segment i;
    theta (size + nx,) holds its own initial state."""
    size = structure.layout.size
    x0 = start.x_guess[i] + theta[size:] * start.scales.x_scale
    y, _ = simulate_states(structure, start.scales, theta[:size], x0, segments.u[i])
    error = (y - segments.y[i]) / start.scales.y_scale
    threshold = structure.config.robust
    if threshold is not None:
        tail = jnp.sqrt(jnp.maximum(2.0 * threshold * jnp.abs(error) - threshold**2, 1e-12))
        error = jnp.where(jnp.abs(error) <= threshold, error, jnp.sign(error) * tail)
    weight = segments.mask[i] / jnp.sqrt(jnp.sum(segments.mask) * structure.ny)
    return (weight[:, None] * error).ravel()


def _residuals(
    structure: Structure,
    start: _Starts,
    segments: Segments,
    active: jax.Array,
    theta: jax.Array,
) -> jax.Array:
    size, count = structure.layout.size, segments.u.shape[0]
    z, shift = theta[:size], theta[size:].reshape(count, -1)

    def one(i: jax.Array) -> jax.Array:
        own = jnp.concatenate([z, shift[i]])
        return _segment_residual(structure, start, segments, own, i)

    errors = jax.vmap(one)(jnp.arange(count))
    ridge = jnp.sqrt(_INITIAL_RIDGE / count) * shift
    return jnp.concatenate([errors.ravel(), ridge.ravel(), active * prior_residuals(structure, z)])


def _linearised(structure: Structure, start: _Starts, segments: Segments, active: jax.Array) -> Any:
    """Residuals and Jacobian; a segment's errors depend on its own initial state only."""
    size, count, nx = structure.layout.size, segments.u.shape[0], structure.nx

    def linearised(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
        z, shift = theta[:size], theta[size:].reshape(count, nx)

        def one(i: jax.Array) -> tuple[jax.Array, jax.Array]:
            def both(own: jax.Array) -> tuple[jax.Array, jax.Array]:
                value = _segment_residual(structure, start, segments, own, i)
                return value, value

            jacobian, value = jax.jacfwd(both, has_aux=True)(jnp.concatenate([z, shift[i]]))
            return value, jacobian

        values, jacobians = jax.vmap(one)(jnp.arange(count))
        blocks = jnp.eye(count)[:, None, :, None] * jacobians[:, :, None, size:]
        errors = jnp.concatenate(
            [jacobians[:, :, :size], blocks.reshape(count, -1, count * nx)], axis=2
        ).reshape(values.size, -1)
        weight = jnp.sqrt(_INITIAL_RIDGE / count)
        states = jnp.eye(count * nx, size + count * nx, size) * weight
        prior = jax.jacfwd(lambda c: prior_residuals(structure, c))(z)
        prior = jnp.concatenate([prior, jnp.zeros((size, count * nx))], axis=1)
        value = jnp.concatenate(
            [
                values.ravel(),
                weight * shift.ravel(),
                active * prior_residuals(structure, z),
            ]
        )
        jacobian = jnp.concatenate([errors, states, prior])
        return value, jacobian.at[:, :size].multiply(active)

    return linearised


def _measured(equations: Equations) -> dict[int, int]:
    """Output index of each state that is observed as it is."""
    pairs = [
        (equations.states.index(expression.root.name), k)
        for k, expression in enumerate(equations.observation)
        if isinstance(expression.root, Name) and expression.root.name in equations.states
    ]
    return dict(pairs)


def _first_guess(structure: Structure, segments: Segments) -> Array:
    """Initial states (S, nx): the first measurement, else the middle of the bounds, else 0."""
    low, high = np.array(structure.low), np.array(structure.high)
    middle = np.where(np.isfinite(low) & np.isfinite(high), 0.5 * (low + high), 0.0)
    guess = np.tile(np.clip(middle, low, high), (segments.u.shape[0], 1))
    for state, output in _measured(structure.equations).items():
        guess[:, state] = segments.y[:, 0, output]
    return guess


def _base_scales(structure: Structure, segments: Segments) -> Scales:
    """Scales before any state is known."""
    nx, inside = structure.nx, segments.mask > 0

    def deviation(values: Array) -> Array:
        spread = values[inside].std(axis=0)
        return np.where(spread > 0, spread, 1.0)

    return Scales(
        x_center=np.zeros(nx),
        x_scale=np.ones(nx),
        x_max=np.ones(nx),
        rate=np.ones(nx),
        u_center=segments.u[inside].mean(axis=0),
        u_scale=deviation(segments.u),
        y_scale=deviation(segments.y),
        low=np.full(nx, -_OPEN),
        high=np.full(nx, _OPEN),
        hidden=np.zeros((structure.config.residual, nx + structure.nu + 1)),
    )


@lru_cache(maxsize=64)
def _simulate_many(structure: Structure) -> Any:
    """Compiled: (z (P, size), scales, x0 (P, S, nx), u (S, T, nu)) -> outputs, states."""

    def one(z: jax.Array, scales: Scales, x0: jax.Array, u: jax.Array) -> Any:
        return jax.vmap(lambda x, v: simulate_states(structure, scales, z, x, v))(x0, u)

    return jax.jit(jax.vmap(one, in_axes=(0, None, 0, None)))


def _neutral(structure: Structure) -> Array:
    z = np.zeros(structure.layout.size)
    z[structure.layout.limits] = _NO_LIMIT
    z[structure.layout.spill] = _NO_SPILL
    return z


def _screen(
    structure: Structure, segments: Segments, count: int, rng: np.random.Generator
) -> _Starts:
    """The `count` best of many points drawn in the parameter ranges, the middle among them."""
    layout, base = structure.layout, _base_scales(structure, segments)
    drawn = count * _SCREENED_PER_START if structure.ranges else count
    z = np.tile(_neutral(structure), (drawn, 1))
    z[1:, layout.parameters] = rng.uniform(-1.0, 1.0, (drawn - 1, len(structure.ranges)))
    guess = np.tile(_first_guess(structure, segments), (drawn, 1, 1))
    simulate = _simulate_many(structure)
    states = np.asarray(simulate(z, base, guess, segments.u)[1])
    center, scale = _spread(states, segments)
    hidden = [i for i in range(structure.nx) if i not in _measured(structure.equations)]
    guess[:, :, hidden] = center[:, None, hidden]
    outputs = np.asarray(simulate(z, base, guess, segments.u)[0])
    error = ((outputs - segments.y) / base.y_scale) ** 2 * segments.mask[:, :, None]
    best = np.argsort(error.sum(axis=(1, 2, 3)), kind="stable")[:count]
    scales = _repeat(base, count)._replace(x_center=center[best], x_scale=scale[best])
    return _Starts(z[best], np.zeros_like(guess[best]), guess[best], scales)


def _spread(states: Array, segments: Segments) -> tuple[Array, Array]:
    """Mean and standard deviation (P, nx) of simulated states (P, S, T, nx)."""
    inside = states[:, segments.mask > 0]
    deviation = inside.std(axis=1)
    # A start that runs away would make its own initial state weightless.
    floor = 1e-3 * np.maximum(np.abs(inside).max(axis=1), 1e-6)
    return inside.mean(axis=1), np.clip(np.maximum(deviation, floor), 1e-9, 1e6)


def _repeat(scales: Scales, count: int) -> Scales:
    return jax.tree.map(lambda a: np.tile(a, (count,) + (1,) * np.ndim(a)), scales)


def _augment(
    structure: Structure,
    segments: Segments,
    starts: _Starts,
    result: LMResult,
    rng: np.random.Generator,
) -> _Starts:
    """Starting points around the best fits of the equations alone, with the additions drawn."""
    layout, size = structure.layout, structure.layout.size
    count = len(starts.z)
    order = np.argsort(result.cost, kind="stable")
    # The better half of the first fits, in turn: others have often ended in a poor minimum.
    parents = np.resize(order[: max(1, count // 2)], count)
    z = np.asarray(result.theta)[parents, :size].copy()
    x0 = np.stack([_initial_states(structure, starts, result, i) for i in parents])
    z[:, layout.limits] = rng.uniform(np.log(0.5), 0.0, (count, len(structure.config.saturation)))
    z[:, layout.spill] = rng.uniform(-2.0, 1.0, z[:, layout.spill].shape)
    z[:, layout.delay] = rng.uniform(0.0, 0.8, z[:, layout.delay].shape)
    units, inner = structure.config.residual, structure.nx + structure.nu + 1
    base = _base_scales(structure, segments)
    simulate = _simulate_many(structure)
    plain = np.tile(_neutral(structure), (count, 1))
    plain[:, layout.parameters] = z[:, layout.parameters]
    states = np.asarray(simulate(plain, base, x0, segments.u)[1])
    center, scale = _spread(states, segments)
    rates = np.diff(states, axis=2) * segments.mask[:, 1:, None]
    rate = np.sqrt((rates**2).mean(axis=(1, 2))) / structure.sampling_time
    scales = _repeat(base, count)._replace(
        x_center=center,
        x_scale=scale,
        x_max=states[:, segments.mask > 0].max(axis=1),
        rate=np.maximum(rate, 1e-9),
        hidden=rng.normal(size=(count, units, inner)) / np.sqrt(inner),
    )
    return _Starts(z, np.zeros_like(x0), x0, scales)


def _finish(
    structure: Structure, segments: Segments, starts: _Starts, result: LMResult, history: Array
) -> Fitted:
    """Learn from the training simulation what a past window says of the state, and the range
    outside which a simulation has run away."""
    best = int(np.argmin(result.cost))
    z = np.asarray(result.theta)[best, : structure.layout.size]
    scales: Scales = jax.tree.map(lambda a: a[best], starts.scales)
    x0 = _initial_states(structure, starts, result, best)
    # As many rows as there are starts: the program is then compiled already.
    rows = len(starts.z)
    simulated = _simulate_many(structure)(
        np.tile(z, (rows, 1)), scales, np.tile(x0, (rows, 1, 1)), segments.u
    )
    y, x = (np.asarray(part[0]) for part in simulated)
    inside = segments.mask > 0
    low, high = x[inside].min(axis=0), x[inside].max(axis=0)
    span = np.maximum(high - low, 1e-6 + 1e-3 * np.abs(high))
    scales = scales._replace(low=low - 10.0 * span, high=high + 10.0 * span)
    error = (y - segments.y)[inside]
    deviation = np.maximum(np.sqrt((error**2).mean(axis=0)), 1e-3 * np.asarray(scales.y_scale))
    prior = _window_prior(structure, segments, scales, x, deviation)
    return Fitted(np.asarray(z), scales, prior, np.asarray(history))


def _window_prior(
    structure: Structure, segments: Segments, scales: Scales, x: Array, y_deviation: Array
) -> WindowPrior:
    """Ridge regression of the simulated state at a window's start on the window's samples."""
    n_past, inside = structure.n_past, segments.mask > 0
    width = 1 + structure.n_past_u * structure.nu + structure.n_past_y * structure.ny
    y_center = segments.y[inside].mean(axis=0)
    spread = np.maximum(x[inside].std(axis=0), 1e-6)
    prior = WindowPrior(np.zeros((structure.nx, width)), spread, y_center, y_deviation)
    features: list[Array] = []
    targets: list[Array] = []
    for u, y, states, mask in zip(segments.u, segments.y, x, inside, strict=True):
        for k in range(int(mask.sum()) - n_past + 1):
            past_u = u[k + n_past - structure.n_past_u : k + n_past]
            past_y = y[k + n_past - structure.n_past_y : k + n_past]
            features.append(np.asarray(_features(scales, prior, past_u, past_y)))
            targets.append(states[min(k, len(states) - 1)])
    mean = x[inside].mean(axis=0)
    if not features:
        return prior._replace(mean=np.hstack([mean[:, None], prior.mean[:, 1:]]))
    phi, target = np.stack(features), np.stack(targets) - mean
    normal = phi.T @ phi + np.eye(width)
    weights = np.linalg.solve(normal, phi.T @ target).T
    error = np.sqrt(((target - phi @ weights.T) ** 2).mean(axis=0))
    weights[:, 0] += mean
    return prior._replace(mean=weights, x_deviation=np.maximum(error, 1e-3 * spread))


def _features(scales: Scales, prior: WindowPrior, past_u: Array, past_y: Array) -> Any:
    return np.concatenate(
        [
            np.ones(1),
            ((past_u - scales.u_center) / scales.u_scale).ravel(),
            ((past_y - prior.y_center) / scales.y_scale).ravel(),
        ]
    )
