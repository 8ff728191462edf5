"""Steps of a grey-box model: one sample of its equations, and the state that it starts from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from asia.candidate import Steps
from asia.data import Array
from asia.models._arrays import AnyArray
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.fit import FittedEquations
from asia.models._equations.initial_state import METHOD, STEP, WEIGHTS
from asia.models._equations.simulate import Effects, Scales, effects, outputs, sample_by_sample
from asia.models._solvers.minimise import FACTORS
from asia.models._steps.shared import solved


def greybox_steps(structure: GreyBoxStructure, fitted: FittedEquations) -> Steps:
    """The state: that of the equations, and the inputs that a delay still holds back."""
    model = _Equations.of(structure, fitted)

    def initial(past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        import jax.numpy as jnp

        n_fit = structure.n_fit
        before = past_u[-1:] if structure.measured else past_u
        held = jnp.repeat(u[None], n_fit - len(before), axis=0)
        inputs = jnp.concatenate([held, before])
        first = inputs[0] if n_fit else u
        if structure.measured:
            order = np.array([structure.measured_states[i] for i in range(structure.nx)])
            x = past_y[-1, order]
        else:
            x = _FittedStart(model, fitted, inputs, first, past_y).state(past_u)
        state = model.begun(x, first)
        for k in range(n_fit):
            state, _ = model.step(state, inputs[k])
        return state

    return Steps(initial, model.step)


@dataclass(frozen=True)
class _Equations:
    structure: GreyBoxStructure
    scales: Scales
    effect: Effects
    late: Array
    """Delays of the inputs (nu,), in samples."""

    @classmethod
    def of(cls, structure: GreyBoxStructure, fitted: FittedEquations) -> _Equations:
        import jax
        import jax.numpy as jnp

        # As JAX arrays, so that functions of them are traced as those of the signals are.
        scales = Scales(*(jnp.asarray(a) for a in fitted.scales.for_rows()))
        effect = effects(structure, scales, jnp.asarray(fitted.z)[:, None])
        late = np.zeros(structure.nu)
        if structure.config.input_delay:
            with jax.ensure_compile_time_eval():
                known = effects(structure, fitted.scales.for_rows(), np.asarray(fitted.z)[:, None])
            late = np.asarray(known.delay)[:, 0]
        return cls(structure, scales, effect, late)

    def begun(self, x: AnyArray, first: AnyArray) -> Any:
        """The state with x (nx,) in its bounds, and the first input continued into the past."""
        import jax.numpy as jnp

        confine, _ = sample_by_sample(self.structure, self.scales, self.effect)
        line = jnp.repeat(first[None], int(np.ceil(self.late).max(initial=0)), axis=0)
        return confine(x[:, None, None])[:, 0, 0], line

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """One sample: the output is read before the states move."""
        import jax.numpy as jnp

        x, line = state
        known = jnp.concatenate([line, u[None]])
        held = self._acting(known)
        _, advance = sample_by_sample(self.structure, self.scales, self.effect)
        now = x[:, None, None]
        after = advance(now, held)
        y = outputs(self.structure, self.effect, now[None], held[None])
        return (after[:, 0, 0], known[1:]), y[0, :, 0, 0]

    def _acting(self, known: AnyArray) -> AnyArray:
        """The inputs (nu, 1, 1) that act now, between two samples where a delay ends there."""
        channel = np.arange(known.shape[1])
        older = known.shape[0] - 1 - np.ceil(self.late).astype(int)
        newer = np.minimum(older + 1, known.shape[0] - 1)
        later = np.ceil(self.late) - self.late
        acting = (1.0 - later) * known[older, channel] + later * known[newer, channel]
        return acting[:, None, None]


@dataclass(frozen=True)
class _FittedStart:
    """`asia.models._equations.initial_state`, for one case."""

    model: _Equations
    fitted: FittedEquations
    inputs: AnyArray
    """(n_fit, nu)."""
    first: AnyArray
    """(nu,)."""
    past_y: AnyArray
    """(n_past_y, ny)."""

    def state(self, past_u: AnyArray) -> AnyArray:
        """(nx,), `n_fit` samples before the first simulated one."""
        import jax
        import jax.numpy as jnp

        structure, prior = self.model.structure, self.fitted.prior
        expected = self._features(past_u) @ np.asarray(prior.mean).T
        if not structure.n_past_y:
            return expected
        deviation = np.asarray(prior.x_deviation)

        def errors(shift: AnyArray) -> AnyArray:
            return self._errors(expected + deviation * shift)

        def improve(carry: Any, _: Any) -> Any:
            return self._improved(errors, *carry), 0.0

        nx = structure.nx
        start = jnp.zeros(nx), jnp.asarray(METHOD.damping), jnp.asarray(0.0)
        (shift, _, _), _ = jax.lax.scan(improve, start, None, METHOD.iterations)
        return expected + deviation * shift

    def _improved(self, errors: Any, shift: AnyArray, damping: AnyArray, done: AnyArray) -> Any:
        """One iteration of `asia.models._solvers.minimise`: the best of several dampings."""
        import jax
        import jax.numpy as jnp

        # One program for all points: a row of simulations, not a copy for each of them.
        found = jax.lax.map(errors, shift + _ways(len(shift)))
        at, jacobian = found[0], _slopes(found[1:], len(shift))
        gram = jacobian.T @ jacobian + np.eye(len(shift))
        gradient = jacobian.T @ at + shift
        before = _finite(at @ at + shift @ shift)
        scale = jnp.sqrt(jnp.diagonal(gram))
        even, slope = gram / (scale[:, None] * scale), gradient / scale
        points = [
            shift - solved(even + damping * f * np.eye(len(shift)), slope) / scale for f in FACTORS
        ]
        after = jax.lax.map(errors, jnp.stack(points))
        costs = [_finite(e @ e + p @ p) for e, p in zip(after, points, strict=True)]
        best, cost, factor = points[0], costs[0], jnp.asarray(FACTORS[0])
        for point, one, f in zip(points[1:], costs[1:], FACTORS[1:], strict=True):
            less = one < cost
            best, factor = jnp.where(less, point, best), jnp.where(less, f, factor)
            cost = jnp.where(less, one, cost)
        better = (cost < before) & (done == 0.0)
        reached = jnp.where(better, cost, before)
        moved = jnp.where(better, best, shift)
        changed = jnp.where(better, damping * factor * 0.3, damping * FACTORS[-1] * 10.0)
        wider = jnp.where(done == 0.0, jnp.maximum(changed, 1e-12), damping)
        small = better & (jnp.where(better, before - cost, 0.0) <= METHOD.tolerance * before)
        ends = small | (wider > 1e12) | (reached == 0.0) | (done != 0.0)
        return moved, wider, jnp.where(ends, 1.0, 0.0)

    def _errors(self, x0: AnyArray) -> AnyArray:
        """Simulated less measured outputs in deviations (E,)."""
        import jax

        def one(state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
            return self.model.step(state, u)

        state = self.model.begun(x0, self.first)
        _, y = jax.lax.scan(one, state, self.inputs)
        n_fit = self.model.structure.n_fit
        recent = self.past_y[max(len(self.past_y) - n_fit, 0) :]
        deviation = np.asarray(self.fitted.prior.y_deviation)
        return ((y[n_fit - len(recent) :] - recent) / deviation).reshape(-1)

    def _features(self, past_u: AnyArray) -> AnyArray:
        import jax.numpy as jnp

        scales, prior = self.fitted.scales, self.fitted.prior
        parts = (
            jnp.ones(1),
            ((past_u - scales.u_center) / scales.u_scale).reshape(-1),
            ((self.past_y - prior.y_center) / scales.y_scale).reshape(-1),
        )
        return jnp.concatenate(parts)


def _ways(n: int) -> Array:
    """Steps (1 + 4 n, n): none, then those of each weight along each axis."""
    return np.concatenate([np.zeros((1, n)), *(way * STEP * np.eye(n) for way in WEIGHTS)])


def _slopes(found: AnyArray, n: int) -> AnyArray:
    """(E, n) from errors (4 n, E) after these steps, by differences of fourth order."""
    total = np.zeros(1)
    for k, weight in enumerate(WEIGHTS.values()):
        total = total + weight * found[k * n : (k + 1) * n]
    return total.T / (12.0 * STEP)


def _finite(cost: AnyArray) -> AnyArray:
    import jax.numpy as jnp

    return jnp.where(jnp.isfinite(cost), cost, np.inf)
