"""Simulation of an augmented grey-box: pure functions of JAX arrays in float64."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from asia.models._equations.config import GreyBoxStructure, Range
from asia.models._equations.ode import runge_kutta
from asia.models._solvers.least_squares import LevenbergMarquardt
from asia.models._solvers.levenberg_marquardt import levenberg_marquardt

ArrayLike = Any  # NumPy or JAX array

_WINDOW_METHOD = LevenbergMarquardt(iterations=12, damping=1e-3, tolerance=1e-10)


class Scales(NamedTuple):
    """Sizes of the signals, which make coordinates and effects free of units.

    x_*, rate, low, high (nx,); u_* (nu,); y_scale (ny,); hidden (units, nx + nu + 1): first layer
    of the residual network where its search starts. low and high keep a simulation finite.
    """

    x_center: ArrayLike
    x_scale: ArrayLike
    x_max: ArrayLike
    rate: ArrayLike
    u_center: ArrayLike
    u_scale: ArrayLike
    y_scale: ArrayLike
    low: ArrayLike
    high: ArrayLike
    hidden: ArrayLike


class WindowPrior(NamedTuple):
    """What training says of the state `n_fit` samples before the first simulated one.

    mean (nx, 1 + n_past_u nu + n_past_y ny): linear map from the window's normalised samples to
    the state; x_deviation (nx,): its error; y_center, y_deviation (ny,): mean of the outputs and
    the model's simulation error on them.
    """

    mean: ArrayLike
    x_deviation: ArrayLike
    y_center: ArrayLike
    y_deviation: ArrayLike


class Effects(NamedTuple):
    """The coordinates in physical terms."""

    parameters: jax.Array
    limits: jax.Array
    spill: jax.Array
    linear: jax.Array
    rate_offset: jax.Array
    output_offset: jax.Array
    delay: jax.Array
    hidden: jax.Array
    readout: jax.Array


def physical_parameters(ranges: Sequence[Range], z: jax.Array) -> jax.Array:
    """Parameters (np,) in physical units from their coordinates; [-1, 1] spans the range."""
    values: list[jax.Array] = []
    for i, span in enumerate(ranges):
        low, high = jnp.asarray(span.min), jnp.asarray(span.max)
        if span.min > 0:
            low, high = jnp.log(low), jnp.log(high)
        value = 0.5 * (low + high) + 0.5 * (high - low) * z[i]
        values.append(jnp.exp(value) if span.min > 0 else value)
    return jnp.stack(values) if values else jnp.zeros(0)


def effects(structure: GreyBoxStructure, scales: Scales, z: jax.Array) -> Effects:
    """Decode coordinates z (size,)."""
    layout, config = structure.layout, structure.config
    nx, nu, ny = structure.nx, structure.nu, structure.ny
    states, outputs = structure.equations.states, structure.equations.outputs
    full = jnp.array([states.index(name) for name in config.saturation], dtype=int)
    reach = (scales.x_max - scales.x_center)[full] * jnp.exp(z[layout.limits])
    limits = jnp.full(nx, jnp.inf).at[full].set(scales.x_center[full] + reach)
    spill = jnp.zeros(nx)
    if config.spill:
        # In units of the states' own scales, so that the fraction does not depend on them.
        ratio = jnp.roll(scales.x_scale, -1)[full] / scales.x_scale[full]
        spill = spill.at[full].set(jnp.exp(z[layout.spill]) * ratio)
    biased_x = [states.index(name) for name in config.offset if name in states]
    biased_y = [outputs.index(n) for n in config.offset if n in outputs and n not in states]
    delay = config.input_delay * jnp.clip(z[layout.delay], 0.0, 1.0)
    units = config.residual
    return Effects(
        parameters=physical_parameters(structure.ranges, z[layout.parameters]),
        limits=limits,
        spill=spill,
        linear=z[layout.linear].reshape(nx, nx + nu) if config.linear else jnp.zeros((nx, nx + nu)),
        rate_offset=jnp.zeros(nx).at[jnp.array(biased_x, dtype=int)].set(z[layout.rate_offset]),
        output_offset=jnp.zeros(ny).at[jnp.array(biased_y, dtype=int)].set(z[layout.output_offset])
        * scales.y_scale,
        delay=delay,
        hidden=scales.hidden + z[layout.hidden].reshape(units, nx + nu + 1),
        readout=z[layout.readout].reshape(nx, units),
    )


def prior_residuals(structure: GreyBoxStructure, z: jax.Array) -> jax.Array:
    """Square roots of the penalties on coordinates z."""
    layout, config = structure.layout, structure.config
    weights = jnp.full(layout.size, jnp.sqrt(config.ridge))
    # Physical quantities are held only as far as the data say nothing of them.
    for part in (layout.parameters, layout.limits, layout.spill):
        weights = weights.at[part].set(1e-3)
    network = jnp.sqrt(config.residual_ridge)
    weights = weights.at[layout.hidden].set(network).at[layout.readout].set(network)
    effect = z.at[layout.spill].set(jnp.exp(z[layout.spill]))
    return weights * effect


def delayed(structure: GreyBoxStructure, delay: jax.Array, u: jax.Array) -> jax.Array:
    """u (T, nu) shifted by `delay` (nu,) samples, the first sample held before it."""
    if not structure.config.input_delay:
        return u
    position = jnp.arange(u.shape[0])[:, None] - delay
    floor = jnp.floor(position)
    fraction = position - floor
    earlier = jnp.clip(floor, 0, u.shape[0] - 1).astype(int)
    later = jnp.clip(floor + 1, 0, u.shape[0] - 1).astype(int)
    channel = jnp.arange(u.shape[1])
    return (1.0 - fraction) * u[earlier, channel] + fraction * u[later, channel]


def simulate_states(
    structure: GreyBoxStructure, scales: Scales, z: jax.Array, x0: jax.Array, u: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Outputs (T, ny) and states (T, nx) from x0 (nx,) at the first sample of u (T, nu)."""
    effect = effects(structure, scales, z)
    derivative = _derivative(structure, scales, effect)
    substeps = structure.config.substeps
    held = jnp.repeat(delayed(structure, effect.delay, u), substeps, axis=0)

    def advance(x: jax.Array, u_now: jax.Array) -> tuple[jax.Array, jax.Array]:
        moved = runge_kutta(derivative, x, u_now, structure.sampling_time / substeps)
        moved = jnp.where(jnp.isfinite(moved), moved, x)
        return _confine(structure, scales, effect, moved), x

    _, states = jax.lax.scan(advance, _confine(structure, scales, effect, x0), held)
    x = states[::substeps]
    y = jax.vmap(lambda a, b: structure.equations.observe(effect.parameters, a, b))(
        x, held[::substeps]
    )
    y = y + effect.output_offset
    return jnp.where(jnp.isfinite(y), y, 0.0), x


def _derivative(structure: GreyBoxStructure, scales: Scales, effect: Effects) -> Any:
    config = structure.config

    def derivative(x: jax.Array, u: jax.Array) -> jax.Array:
        rate = structure.equations.derivative(effect.parameters, x, u)
        if not (config.linear or config.offset or config.residual):
            return rate
        signals = jnp.concatenate(
            [(x - scales.x_center) / scales.x_scale, (u - scales.u_center) / scales.u_scale]
        )
        extra = effect.rate_offset
        if config.linear:
            extra = extra + effect.linear @ signals
        if config.residual:
            inner = effect.hidden[:, :-1] @ signals + effect.hidden[:, -1]
            extra = extra + effect.readout @ jnp.tanh(inner)
        return rate + scales.rate * extra

    return derivative


def _confine(
    structure: GreyBoxStructure, scales: Scales, effect: Effects, x: jax.Array
) -> jax.Array:
    """Keep the states in their bounds and limits; hand on what spills."""
    kept: list[jax.Array] = []
    spilled = jnp.zeros(())
    for i, name in enumerate(structure.equations.states):
        value = x[i] + spilled
        spilled = jnp.zeros(())
        if name in structure.config.saturation:
            excess = jnp.maximum(value - effect.limits[i], 0.0)
            spilled, value = effect.spill[i] * excess, value - excess
        top = jnp.minimum(scales.high[i], structure.high[i])
        bottom = jnp.maximum(scales.low[i], structure.low[i])
        kept.append(jnp.clip(value, bottom, top))
    return jnp.stack(kept)


def window_features(
    scales: Scales, prior: WindowPrior, past_u: jax.Array, past_y: jax.Array
) -> jax.Array:
    """1 and the normalised samples of one past window."""
    return jnp.concatenate(
        [
            jnp.ones(1),
            ((past_u - scales.u_center) / scales.u_scale).ravel(),
            ((past_y - prior.y_center) / scales.y_scale).ravel(),
        ]
    )


@lru_cache(maxsize=64)
def simulator(structure: GreyBoxStructure) -> Any:
    """Compiled simulate: (z, scales, prior, past_u, past_y, u), batch first -> y_hat.

    The state `n_fit` samples before the first simulated one is the most probable one given the
    outputs from there on, weighted by the model's simulation error, and the prior from training,
    which has seen the whole past window. Without past inputs the first future one is held back.
    """

    def one(
        z: jax.Array,
        scales: Scales,
        prior: WindowPrior,
        past_u: jax.Array,
        past_y: jax.Array,
        u: jax.Array,
    ) -> jax.Array:
        n_fit = structure.n_fit
        recent = past_y[max(structure.n_past_y - n_fit, 0) :]
        whole = jnp.concatenate([u[: n_fit - structure.n_past_u], past_u, u])
        expected = prior.mean @ window_features(scales, prior, past_u, past_y)

        def residual(shift: jax.Array) -> jax.Array:
            x0 = expected + prior.x_deviation * shift
            y, _ = simulate_states(structure, scales, z, x0, whole[:n_fit])
            error = (y[n_fit - recent.shape[0] :] - recent) / prior.y_deviation
            return jnp.concatenate([error.ravel(), shift])

        shift = jnp.zeros(structure.nx)
        if structure.n_past_y:
            shift = levenberg_marquardt(residual, shift, _WINDOW_METHOD).theta
        x0 = expected + prior.x_deviation * shift
        y, _ = simulate_states(structure, scales, z, x0, whole)
        return y[n_fit:]

    return jax.jit(jax.vmap(one, in_axes=(None, None, None, 0, 0, 0)))
