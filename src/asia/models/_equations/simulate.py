"""Simulation of a grey-box, for NumPy and JAX."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from asia.models._arrays import AnyArray, folded, function, namespace, repeated, rows, scan
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.ode import Derivative, runge_kutta
from asia.models._equations.transport import (
    advance_buffer,
    along_record,
    constant_flow,
    empty_buffer,
)
from asia.problem.physics import ParameterRange

Step: TypeAlias = Callable[[AnyArray, AnyArray], AnyArray]
"""Function that advances the states by one sample: x (nx, R, S) and the samples of the inputs that
decide the interval, (memory + 1, nu, R, S) of `Between.windows` -> (nx, R, S)."""
Confinement: TypeAlias = Callable[[AnyArray], AnyArray]
"""Function that keeps states (nx, R, S) in their bounds."""


class Scales(NamedTuple):
    """Sizes of the signals, which make coordinates and effects free of units. In a fit of several
    rows each field has their number as last dimension."""

    x_center: AnyArray  # (nx,)
    x_scale: AnyArray  # (nx,)
    x_max: AnyArray  # (nx,)
    rate: AnyArray  # (nx,)
    u_center: AnyArray  # (nu,)
    u_scale: AnyArray  # (nu,)
    y_scale: AnyArray  # (ny,)
    low: AnyArray  # (nx,), keeps a simulation finite
    high: AnyArray  # (nx,)
    hidden: AnyArray
    """(units, nx + nu + 1), first layer of the residual network where its search starts."""

    def of_rows(self, chosen: AnyArray) -> Scales:
        """Scales of some rows (a number, a slice or an array of numbers)."""
        return Scales(*(np.asarray(a)[..., chosen] for a in self))

    def for_rows(self, count: int = 1) -> Scales:
        """Repeat the scales for every row."""
        return Scales(*(np.repeat(np.asarray(a)[..., None], count, axis=-1) for a in self))


class WindowPrior(NamedTuple):
    """Linear prediction of the state `n_fit` samples before the first simulated one from a past
    window."""

    mean: AnyArray
    """(nx, 1 + n_past_u nu + n_past_y ny): linear map from the window's normalised samples."""
    x_deviation: AnyArray  # (nx,): error of the map
    y_center: AnyArray  # (ny,): mean of the outputs
    y_deviation: AnyArray  # (ny,): the model's simulation error


class Effects(NamedTuple):
    """Coordinates in physical terms, for each row."""

    parameters: AnyArray  # (np, R)
    limits: AnyArray  # (nx, R), infinite where there is none
    spill: AnyArray  # (nx, R)
    linear: AnyArray  # (nx, nx + nu, R), or none
    rate_offset: AnyArray  # (nx, R)
    output_offset: AnyArray  # (ny, R)
    delay: AnyArray  # (nu, R), or none
    hidden: AnyArray  # (units, nx + nu + 1, R)
    readout: AnyArray  # (nx, units, R)


def physical_parameters(ranges: Sequence[ParameterRange], z: AnyArray) -> AnyArray:
    """Parameters (np, ...) in physical units from their coordinates; [-1, 1] spans the range."""
    values: list[AnyArray] = []
    for i, span in enumerate(ranges):
        low, high = span.min, span.max
        if span.min > 0:
            low, high = math.log(low), math.log(high)
        value = 0.5 * (low + high) + 0.5 * (high - low) * z[i]
        values.append(namespace(z).exp(value) if span.min > 0 else value)
    return rows(values, z)


def effects(structure: GreyBoxStructure, scales: Scales, z: AnyArray) -> Effects:
    """Decode coordinates z (size, R)."""
    xp, layout, config = namespace(z), structure.layout, structure.config
    nx, nu, count = structure.nx_own, structure.nu, z.shape[1]
    states, outputs = structure.equations.states, structure.equations.outputs
    limits: list[AnyArray] = [math.inf] * structure.nx
    spill: list[AnyArray] = [0.0] * structure.nx
    rate_offset: list[AnyArray] = [0.0] * nx
    output_offset: list[AnyArray] = [0.0] * structure.ny
    for k, i in enumerate(states.index(name) for name in config.saturation):
        reach = (scales.x_max[i] - scales.x_center[i]) * xp.exp(z[layout.limits][k])
        limits[i] = scales.x_center[i] + reach
        if config.spill:
            # Use the states' own scales, so that the fraction does not depend on them.
            ratio = scales.x_scale[(i + 1) % nx] / scales.x_scale[i]
            spill[i] = xp.exp(z[layout.spill][k]) * ratio
    for k, i in enumerate(states.index(name) for name in config.offset if name in states):
        rate_offset[i] = z[layout.rate_offset][k]
    biased = [outputs.index(n) for n in config.offset if n in outputs and n not in states]
    for k, i in enumerate(biased):
        output_offset[i] = z[layout.output_offset][k] * scales.y_scale[i]
    parameters = physical_parameters(structure.ranges, z[layout.parameters])
    learned = structure.learned
    if learned.names:
        # Those of additions, and spans and rates of states.
        values = learned.values(z[layout.learned])
        for i in (states.index(name) for name in learned.spans):
            low, high = structure.low[i], structure.high[i]
            below = scales.x_center[i] - 2.0 * scales.x_scale[i]
            values.append(low if math.isfinite(low) else below)
            above = xp.maximum(scales.x_max[i], values[-1] + scales.x_scale[i])
            values.append(high if math.isfinite(high) else above)
        values += [scales.rate[states.index(name)] for name in learned.rates]
        parameters = xp.concatenate([parameters, rows(values, z)])
    units = config.residual
    return Effects(
        parameters=parameters,
        limits=rows(limits, z),
        spill=rows(spill, z),
        linear=z[layout.linear].reshape(-1, nx + nu, count),
        rate_offset=rows(rate_offset, z),
        output_offset=rows(output_offset, z),
        delay=config.input_delay * xp.minimum(xp.maximum(z[layout.delay], 0.0), 1.0),
        hidden=scales.hidden + z[layout.hidden].reshape(units, nx + nu + 1, count),
        readout=z[layout.readout].reshape(nx, units, count),
    )


def delayed(structure: GreyBoxStructure, delay: AnyArray, u: AnyArray) -> AnyArray:
    """Delay inputs u (T, nu, S) by `delay` (nu, R) samples to (T, nu, R, S), R being 1 where the
    structure has no delay; the first sample is held before it."""
    if not structure.config.input_delay:
        return u[:, :, None]
    return constant_flow(u[:, :, None], delay[..., None], len(u))


def simulate(
    structure: GreyBoxStructure, scales: Scales, z: AnyArray, x0: AnyArray, u: AnyArray
) -> tuple[AnyArray, AnyArray]:
    """Simulate a grey-box with coordinates z (size, R) from states x0 (nx, R, S) at the first
    sample of u (T, nu, S): outputs (T, ny, R, S) and states (T, nx, R, S)."""
    effect = effects(structure, scales, z)
    held = acting(structure, effect, u)
    states, late = simulate_states(structure, scales, effect, x0, held)
    return outputs(structure, effect, states, joined(held, late)), states


def acting(structure: GreyBoxStructure, effect: Effects, u: AnyArray) -> AnyArray:
    """Inputs (T, nu + n, R, S) as they act, from u (T, nu, S): delayed, and in NumPy followed by
    the n delayed signals of the equations that depend on no state."""
    held = delayed(structure, effect.delay, u)
    if namespace(held, effect.parameters) is not np:
        return held
    return along_record(structure, effect.parameters, held)[0]


def simulate_states(
    structure: GreyBoxStructure, scales: Scales, effect: Effects, x0: AnyArray, held: AnyArray
) -> tuple[AnyArray, AnyArray | None]:
    """States (T, nx, R, S) from x0 (nx, R, S), with the inputs of `acting`, and the delayed signals
    (T, m, R, S) that these lack, None where there is none."""
    confine, advance = sample_by_sample(structure, scales, effect)
    x0, known, windows = confine(x0), held.shape[1], structure.between.windows(held)
    if known == structure.nu + len(structure.equations.delays):
        return scan(lambda x, v: (advance(x, v), x), x0, windows)[1], None

    def step(state: tuple[AnyArray, AnyArray], v: AnyArray) -> Any:
        line, v = advance_buffer(structure, effect.parameters, state[1], state[0], v)
        return (advance(state[0], v[None]), line), (state[0], v[known:])

    line = empty_buffer(structure, effect.parameters, x0, held[0])
    return scan(step, (x0, line), held)[1]


def joined(held: AnyArray, late: AnyArray | None) -> AnyArray:
    """Inputs with all delayed signals, from the results of `acting` and `simulate_states`."""
    if late is None:
        return held
    xp = namespace(held, late)
    held = xp.broadcast_to(held, (*held.shape[:2], *late.shape[2:]))
    return xp.concatenate([held, late], axis=1)


def sample_by_sample(
    structure: GreyBoxStructure, scales: Scales, effect: Effects
) -> tuple[Confinement, Step]:
    """Functions that confine states (nx, R, S) to their bounds before the first sample, and that
    advance them by one sample."""
    xp, confine = namespace(effect.parameters), _confinement(structure, scales, effect)
    derivative, substeps = _derivative(structure, scales, effect), structure.config.substeps
    irregular, between = structure.time_step, structure.between

    def advance(x: AnyArray, window: AnyArray) -> AnyArray:
        u, whole = between.start(window), structure.sampling_time
        if irregular is not None:
            whole = xp.maximum(u[irregular], 0.0)
        step = whole / substeps

        def once(x: AnyArray, stages: AnyArray) -> AnyArray:
            moved = runge_kutta(derivative, x, stages, step)
            return confine(xp.where(xp.isfinite(moved), moved, x))

        if between.memory:
            return folded(once, x, between.stages(window, substeps))
        return repeated(lambda x: once(x, (u, u, u)), substeps, x)

    return confine, advance


def outputs(
    structure: GreyBoxStructure, effect: Effects, states: AnyArray, held: AnyArray
) -> AnyArray:
    """Outputs (T, ny, R, S) at states (T, nx, R, S) with the inputs of `joined`."""
    xp = namespace(states)
    parameters = effect.parameters[..., None]
    y = structure.equations.observe(parameters, xp.swapaxes(states, 0, 1), xp.swapaxes(held, 0, 1))
    y = xp.swapaxes(y, 0, 1) + effect.output_offset[..., None]
    return xp.where(xp.isfinite(y), y, 0.0)


def _derivative(structure: GreyBoxStructure, scales: Scales, effect: Effects) -> Derivative:
    config, xp = structure.config, namespace(effect.parameters)
    rates, parameters = structure.equations.rates(xp), effect.parameters[..., None]
    own_rates = function(xp, "derivative parameters states inputs", rates)
    if not (config.linear or config.offset or config.residual):
        return lambda x, u: own_rates(parameters, x, u)
    wide = Scales(*(a[..., None] for a in scales))
    offset, bias = effect.rate_offset[..., None], effect.hidden[:, -1, :, None]
    own, lags = structure.nx_own, structure.nx - structure.nx_own

    def derivative(x: AnyArray, u: AnyArray) -> AnyArray:
        drive = (u[: structure.nu] - wide.u_center) / wide.u_scale
        if drive.shape[1:] != x.shape[1:]:
            drive = xp.broadcast_to(drive, (len(drive), *x.shape[1:]))
        signals = xp.concatenate([((x - wide.x_center) / wide.x_scale)[:own], drive])
        extra = offset
        if config.linear:
            extra = extra + _product(effect.linear, signals)
        if config.residual:
            inner = _product(effect.hidden[:, :-1], signals) + bias
            extra = extra + _product(effect.readout, xp.tanh(inner))
        extra = wide.rate[:own] * extra
        if lags:
            extra = xp.concatenate([extra, xp.zeros((lags, *extra.shape[1:]), extra.dtype)])
        return own_rates(parameters, x, u) + extra

    return derivative


def _product(matrices: AnyArray, vectors: AnyArray) -> AnyArray:
    """Multiply by one matrix a row: (m, n, R), (n, R, S) -> (m, R, S)."""
    # XLA takes four times as long for products of small matrices.
    return (matrices[..., None] * vectors).sum(axis=1)


def _confinement(structure: GreyBoxStructure, scales: Scales, effect: Effects) -> Confinement:
    """Function that keeps states in their bounds and limits, and hands on what spills."""
    xp, limited = namespace(effect.limits), structure.config.saturation
    top = xp.minimum(scales.high, np.array(structure.high)[:, None])[..., None]
    bottom = xp.maximum(scales.low, np.array(structure.low)[:, None])[..., None]
    limits, spill = effect.limits[..., None], effect.spill[..., None]
    own = structure.nx_own

    def confine(x: AnyArray) -> AnyArray:
        if limited:
            kept: list[AnyArray] = []
            spilled = 0.0
            for i, name in enumerate(structure.equations.states):
                value, over = x[i] + spilled, 0.0
                if name in limited:
                    over = xp.maximum(value - limits[i], 0.0)
                kept.append(value - over)
                spilled = spill[i] * over if i + 1 < own else 0.0
            x = rows(kept, x)
        return xp.minimum(xp.maximum(x, bottom), top)

    return confine
