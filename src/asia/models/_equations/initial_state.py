"""Simulation of cases: initial state of a trained grey-box, and its response. NumPy or JAX."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from asia.data.trajectory import Array
from asia.models._arrays import AnyArray, folded, function, namespace, scan
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.simulate import (
    Confinement,
    Effects,
    Scales,
    Step,
    WindowPrior,
    effects,
    outputs,
    sample_by_sample,
    simulate,
)
from asia.models._equations.transport import advance_buffer, empty_buffer
from asia.models._least_squares import (
    LevenbergMarquardt,
    NormalEquations,
    minimise,
    solve,
    traced_minimum,
)

_METHOD = LevenbergMarquardt(iterations=12, damping=1e-3, tolerance=1e-10)
# Step of fourth-order differences, in units of the initial state's deviation.
_STEP = 1e-3
# Greatest change of a coordinate by the last step, in the same units.
_SETTLED = 1e-3
_WEIGHTS = {1: 8.0, -1: -8.0, 2: -1.0, -2: 1.0}


def simulate_cases(
    structure: GreyBoxStructure,
    scales: Scales,
    prior: WindowPrior,
    z: Array,
    cases: tuple[Array, Array, Array],
) -> Array:
    """Simulate cases from their past windows, with coordinates z (size,): past_u (B, n_past_u, nu),
    past_y (B, n_past_y, ny), u (B, H, nu) -> outputs (B, H, ny)."""
    past_u, past_y, u = cases
    scales, z = scales.for_rows(), z[:, None]

    before = start_inputs(structure, past_u, u[:, 0])

    def simulated(x0: Array) -> Array:
        return simulate(structure, scales, z, x0, before)[0]

    with np.errstate(all="ignore"):
        x0 = case_start(structure, scales, prior, simulated, past_u, past_y)
        inputs = np.concatenate([before, u.transpose(1, 2, 0)])
        y, _ = simulate(structure, scales, z, x0[:, None], inputs)
    return y[structure.n_fit :, :, 0].transpose(2, 0, 1)


class _Parts(NamedTuple):
    """Parts of a step; all but the first are functions of their own in printed code."""

    confine: Confinement
    update: Step
    output: Step
    transport: Callable[..., Any]  # As `advance_buffer`, of line, x and u


@dataclass(frozen=True)
class CaseSteps:
    """Step-by-step form of `simulate_cases`, for a batch of cases."""

    structure: GreyBoxStructure
    scales: Scales
    prior: WindowPrior
    z: AnyArray  # Coordinates (size, 1)
    effect: Effects
    late: Array  # Delays of the inputs (nu,), in samples

    @classmethod
    def of(
        cls,
        structure: GreyBoxStructure,
        scales: Scales,
        prior: WindowPrior,
        z: AnyArray,
        u: AnyArray,
    ) -> CaseSteps:
        """Make the steps with arrays of the library of the inputs u."""
        scales, z, late = scales.for_rows(), z[:, None], np.zeros(structure.nu)
        if structure.config.input_delay:
            late = np.asarray(effects(structure, scales, z).delay)[:, 0]
        if namespace(u) is not np:
            import jax.numpy as jnp

            scales, z = Scales(*(jnp.asarray(a) for a in scales)), jnp.asarray(z)
        return cls(structure, scales, prior, z, effects(structure, scales, z), late)

    @cached_property
    def _parts(self) -> _Parts:
        structure, effect, xp = self.structure, self.effect, namespace(self.effect.parameters)
        confine, advance = sample_by_sample(structure, self.scales, effect)

        def observe(x: AnyArray, u: AnyArray) -> AnyArray:
            return outputs(structure, effect, x[None], u[None])[0]

        def transport(line: AnyArray, x: AnyArray, u: AnyArray) -> Any:
            return advance_buffer(structure, effect.parameters, line, x, u)

        if structure.equations.delays:
            transport = function(xp, "transport past states inputs", transport)
        update = function(xp, "update states inputs", advance)
        return _Parts(confine, update, function(xp, "output states inputs", observe), transport)

    def initial(self, past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        """States (B, nx), the inputs (B, held, nu) that still act, and the buffer (B, L, n) of the
        delays in the equations: at the first sample, with inputs that move between samples at the
        one before."""
        _ = self._parts  # Made here, as the function below is traced on its own.
        inputs = start_inputs(self.structure, past_u, u)

        def start(past_u: AnyArray, past_y: AnyArray, inputs: AnyArray) -> AnyArray:
            simulated = partial(self._simulated, inputs=inputs)
            return case_start(self.structure, self.scales, self.prior, simulated, past_u, past_y)

        estimate = function(namespace(u), "estimate past_u past_y inputs", start)
        x = estimate(past_u, past_y, inputs)
        state = self._begin(x, inputs[0] if len(inputs) else u.T)
        known = inputs.swapaxes(1, 2)[1 if self.structure.between.memory else 0 :]
        return folded(lambda state, row: self.step(state, row)[0], state, known)

    def _simulated(self, x0: AnyArray, inputs: AnyArray) -> AnyArray:
        """Outputs (T, ny, K, B) from states x0 (nx, K, B), with inputs (T, nu, B)."""
        if namespace(x0) is np:
            return simulate(self.structure, self.scales, self.z, x0, inputs)[0]
        import jax

        one = function(namespace(x0), "past_outputs states past_u", self._past_outputs)
        return jax.lax.map(lambda x: one(x, inputs), x0.swapaxes(0, 1)).transpose(1, 3, 0, 2)

    def _begin(self, x: AnyArray, first: AnyArray) -> Any:
        """State before an input (nu, B) that has always been held, with states x (nx, B)."""
        xp, now = namespace(x, first), self._parts.confine(x[:, None])
        with np.errstate(all="ignore"):
            buffer = empty_buffer(self.structure, self.effect.parameters, now, first[:, None])
        held = int(np.ceil(self.late).max(initial=0)) + self.structure.between.memory
        line = xp.repeat(first.T[:, None], held, axis=1)
        return now[:, 0].T, line, buffer[:, :, 0].transpose(2, 0, 1)

    def _past_outputs(self, x: AnyArray, inputs: AnyArray) -> AnyArray:
        """Outputs (T, B, ny) with inputs (T, nu, B) and states x (nx, B) at the first of them."""
        state, rows = self._begin(x, inputs[0]), inputs.swapaxes(1, 2)
        if not self.structure.between.memory:
            return scan(self.step, state, rows)[1]
        first = self._observe(state[0].T[:, None], inputs[0][:, None])
        if len(rows) == 1:
            return first[None]
        later = scan(self.step, state, rows[1:])[1]
        return namespace(later).concatenate([first[None], later])

    def _observe(self, now: AnyArray, acting: AnyArray) -> AnyArray:
        """Outputs (B, ny) at states (nx, 1, B) with inputs (nu + m, 1, B)."""
        return self._parts.output(now, acting)[:, 0].T

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one sample. With held inputs the output is read before the states move; with
        others the states move from the sample before to this one first."""
        (x, line, buffer), memory = state, self.structure.between.memory
        known = u[:, None]
        if line.shape[1]:
            known = namespace(line, u).concatenate([line, known], axis=1)
            line = known[:, 1:]
        window = namespace(u).stack([self._acting(known, k).T for k in range(memory, -1, -1)])
        now, window = x.T[:, None], window[:, :, None]
        with np.errstate(all="ignore"):
            past = buffer.transpose(1, 2, 0)[:, :, None]
            buffer, acting = self._parts.transport(past, now, window[-1])
            # Equations with delays have held inputs.
            after = self._parts.update(now, window if memory else acting[None])
            here = after if memory else now
            y = self._observe(here, acting)
        return (after[:, 0].T, line, buffer[:, :, 0].transpose(2, 0, 1)), y

    def _acting(self, known: AnyArray, before: int) -> AnyArray:
        """Inputs (B, nu) that act so many samples before the last of `known` (B, L, nu)."""
        last = known.shape[1] - 1 - before
        if not self.structure.config.input_delay:
            return known[:, last]
        channel = np.arange(known.shape[2])
        older = last - np.ceil(self.late).astype(int)
        newer = np.minimum(older + 1, last)
        # Interpolate between two samples for a fractional delay.
        later = np.ceil(self.late) - self.late
        return (1.0 - later) * known[:, older, channel] + later * known[:, newer, channel]


def start_inputs(structure: GreyBoxStructure, past_u: AnyArray, u: AnyArray) -> AnyArray:
    """Inputs (n_fit, nu, B) from `n_fit` samples before the first simulated one on. Its input u (B,
    nu) is held back where the past window past_u (B, n_past_u, nu) has too few."""
    xp, before = namespace(past_u, u), past_u[:, -1:] if structure.states_measured else past_u
    held_back = xp.repeat(u[:, None], structure.n_fit - before.shape[1], axis=1)
    return xp.concatenate([held_back, before], axis=1).transpose(1, 2, 0)


def case_start(
    structure: GreyBoxStructure,
    scales: Scales,
    prior: WindowPrior,
    simulated: Callable[[AnyArray], AnyArray],
    past_u: AnyArray,
    past_y: AnyArray,
) -> AnyArray:
    """States (nx, B) of cases, `n_fit` samples before the first simulated one, from their past
    windows, past_u (B, n_past_u, nu) and past_y (B, n_past_y, ny).

    `simulated` gives outputs (n_fit, ny, K, B) from states (nx, K, B), with `start_inputs`.
    """
    xp, n_fit = namespace(past_u, past_y), structure.n_fit
    if structure.states_measured:
        order = np.array([structure.measured_states[i] for i in range(structure.nx)])
        return past_y[:, -1][:, order].T
    # The most probable state given the outputs from there on, weighted by the model's simulation
    # error, and the prior from training, which uses the whole past window.
    count = len(past_y)
    features = (
        np.ones((count, 1)),
        ((past_u - scales.u_center[:, 0]) / scales.u_scale[:, 0]).reshape(count, -1),
        ((past_y - prior.y_center) / scales.y_scale[:, 0]).reshape(count, -1),
    )
    expected = np.asarray(prior.mean) @ xp.concatenate(features, axis=1).T
    if not structure.n_past_y:
        return expected
    nx = structure.nx
    recent = past_y[:, max(structure.n_past_y - n_fit, 0) :].transpose(1, 2, 0)[:, :, None]
    deviation = np.asarray(prior.x_deviation)
    ways = np.concatenate([np.zeros((1, nx)), *(way * _STEP * np.eye(nx) for way in _WEIGHTS)])
    weights = np.array(list(_WEIGHTS.values())) / (12.0 * _STEP)

    def errors(shift: AnyArray) -> AnyArray:
        """Errors (B, K, E) at shifts (B, K, nx) of the expected state, in deviations."""
        x0 = expected[:, None] + deviation[:, None, None] * shift.transpose(2, 1, 0)
        y = simulated(x0)
        found = (y[n_fit - len(recent) :] - recent) / prior.y_deviation[:, None, None]
        return found.reshape(-1, *found.shape[2:]).transpose(2, 1, 0)

    def cost(shift: AnyArray) -> AnyArray:
        return (errors(shift) ** 2).sum(axis=-1) + (shift**2).sum(axis=-1)

    def linearise(shift: AnyArray) -> NormalEquations:
        found = errors(shift[:, None] + ways)
        error, around = found[:, 0], found[:, 1:].reshape(count, len(weights), nx, -1)
        slope = (weights[:, None, None] * around).sum(axis=1)
        return NormalEquations(
            (error**2).sum(axis=1) + (shift**2).sum(axis=1),
            slope @ slope.swapaxes(1, 2) + np.eye(nx),
            (slope @ error[..., None])[..., 0] + shift,
        )

    start = xp.zeros((count, nx))
    if xp is np:
        shift = minimise(cost, linearise, start, _METHOD).theta
    else:
        shift = traced_minimum(cost, linearise, start, _METHOD)
    # Near the minimum rounding decides whether a step lowers the cost. This last step needs no such
    # decision, so that printed programs start from the same state.
    last = linearise(shift)
    step = solve(last.gram, last.gradient)
    small = abs(step).max(axis=1, keepdims=True) < _SETTLED
    shift = xp.where(small, shift - step, shift)
    return expected + deviation[:, None] * shift.T
