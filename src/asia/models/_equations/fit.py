"""Fitting a grey-box to records: screening, multi-start, then the additions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from asia.data import Array
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.measured_windows import measured_fitter
from asia.models._equations.past_window import window_prior
from asia.models._equations.simulate import Scales, WindowPrior, prior_residuals, simulate_states
from asia.models._equations.starts import (
    RecordPieces,
    Starts,
    add_network,
    augment,
    draws,
    initial_states,
    screen,
    simulate_many,
)
from asia.models._solvers.levenberg_marquardt import (
    LevenbergMarquardt,
    LMResult,
    levenberg_marquardt,
    value_and_jacobian,
)

_INITIAL_RIDGE = 1e-6


@dataclass(frozen=True)
class FittedEquations:
    """What training found."""

    z: Array
    """Coordinates (size,)."""
    scales: Scales
    """Sizes of the signals."""
    prior: WindowPrior
    """What a past window says of the state."""
    history: Array
    """Cost after each iteration."""


def fit(
    structure: GreyBoxStructure, segments: RecordPieces, method: LevenbergMarquardt, seed: int
) -> FittedEquations:
    """The best of `method.starts` fits, in up to three stages: the equations alone, from points
    drawn in their ranges and screened; from the better half of these the additions, with starting
    points drawn anew; from the best of these the residual network, which starts without effect.

    The same seed gives bitwise the same result. Raises FloatingPointError when no starting point
    gives a finite simulation.
    """
    rng = np.random.default_rng(seed)
    layout = structure.layout
    with jax.enable_x64(True):
        run = _fitter(structure, method)
        if structure.measured:
            run = measured_fitter(structure, method, _segment_residual)
        active = np.zeros(layout.size)
        active[layout.parameters] = 1.0
        starts = screen(structure, segments, method.starts, rng)
        result: LMResult = jax.device_get(run(starts, segments, active))
        curve = [result.history[np.argmin(result.cost)]]
        if structure.config.augmented:
            active = np.ones(layout.size)
            active[layout.hidden] = active[layout.readout] = 0.0
            starts = augment(structure, segments, starts, result, rng)
            result = jax.device_get(run(starts, segments, active))
            curve.append(result.history[np.argmin(result.cost)])
        if structure.config.residual:
            starts = add_network(structure, starts, result, rng)
            result = jax.device_get(run(starts, segments, np.ones(layout.size)))
            curve.append(result.history[np.argmin(result.cost)])
        if not np.isfinite(result.cost).any():
            raise FloatingPointError("grey-box: no starting point gives a finite simulation")
        return _finish(structure, segments, starts, result, np.concatenate(curve))


@lru_cache(maxsize=64)
def _fitter(structure: GreyBoxStructure, method: LevenbergMarquardt) -> Any:
    """Compiled fit: (starts, segments, active) -> LMResult, one row a start."""

    def one(start: Starts, segments: RecordPieces, active: jax.Array) -> LMResult:
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
    structure: GreyBoxStructure,
    start: Starts,
    segments: RecordPieces,
    theta: jax.Array,
    i: jax.Array,
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
    structure: GreyBoxStructure,
    start: Starts,
    segments: RecordPieces,
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


def _linearised(
    structure: GreyBoxStructure, start: Starts, segments: RecordPieces, active: jax.Array
) -> Any:
    """Residuals and Jacobian; a segment's errors depend on its own initial state only."""
    size, count, nx = structure.layout.size, segments.u.shape[0], structure.nx

    def linearised(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
        z, shift = theta[:size], theta[size:].reshape(count, nx)

        def one(i: jax.Array) -> tuple[jax.Array, jax.Array]:
            def errors(own: jax.Array) -> jax.Array:
                return _segment_residual(structure, start, segments, own, i)

            return value_and_jacobian(errors, jnp.concatenate([z, shift[i]]))

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
            [values.ravel(), weight * shift.ravel(), active * prior_residuals(structure, z)]
        )
        jacobian = jnp.concatenate([errors, states, prior])
        return value, jacobian.at[:, :size].multiply(active)

    return linearised


def _finish(
    structure: GreyBoxStructure,
    segments: RecordPieces,
    starts: Starts,
    result: LMResult,
    history: Array,
) -> FittedEquations:
    """Learn from the training simulation what a past window says of the state, and the range
    outside which a simulation has run away."""
    best = int(np.argmin(result.cost))
    z = np.asarray(result.theta)[best, : structure.layout.size]
    scales: Scales = jax.tree.map(lambda a: a[best], starts.scales)
    x0 = initial_states(structure, starts, result, best)
    # As many rows as there were draws: the program is then compiled already.
    rows = draws(structure, segments, len(starts.z))
    simulated = simulate_many(structure)(
        np.tile(z, (rows, 1)),
        jax.tree.map(lambda a: np.tile(a, (rows,) + (1,) * np.ndim(a)), scales),
        np.tile(x0, (rows, 1, 1)),
        segments.u,
    )
    y, x = (np.asarray(part[0]) for part in simulated)
    inside = segments.mask > 0
    low, high = x[inside].min(axis=0), x[inside].max(axis=0)
    rest = np.maximum(1e-3 * np.abs(high), 1e-6 * np.asarray(scales.x_scale))
    span = np.maximum(high - low, rest)
    scales = scales._replace(low=low - 10.0 * span, high=high + 10.0 * span)
    deviation = _deviation(structure, (y - segments.y)[inside])
    deviation = np.maximum(deviation, 1e-3 * np.asarray(scales.y_scale))
    prior = window_prior(structure, segments, scales, x, deviation)
    return FittedEquations(np.asarray(z), scales, prior, np.asarray(history))


def _deviation(structure: GreyBoxStructure, error: Array) -> Array:
    """Size of the simulation error (N, ny) per output, deaf to outliers where the loss is."""
    if structure.config.robust is not None:
        return 1.4826 * np.median(np.abs(error), axis=0)
    return np.sqrt((error**2).mean(axis=0))
