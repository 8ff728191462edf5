"""Steps of a neural state-space model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from asia.candidate import Steps
from asia.models._arrays import AnyArray
from asia.models._data.records import window
from asia.models._state_space.past_fit import DAMPING, DIFFERENCE, LESS, MORE, STEPS, PastFit
from asia.models._state_space.structure import StateSpaceStructure
from asia.models._steps.carried import carried_steps
from asia.models._steps.shared import first_of_line, median, solved, through_line, turned

if TYPE_CHECKING:
    from asia.models._state_space.fitted import FittedStateSpace


def state_space_steps(f: FittedStateSpace) -> Steps:
    """The median over the members."""
    structure, scaling = f.structure, f.scaling

    def initial(past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        import jax.numpy as jnp

        past, y, first = scaling.inputs(past_u), scaling.outputs(past_y), scaling.inputs(u)
        features = window(past[None], y[None])
        known = jnp.concatenate([past, first[None]])
        states: list[AnyArray] = []
        for i, (params, encoder) in enumerate(f.members):
            x = _start(structure, encoder, features)
            if i < len(f.starts):
                how = f.starts[i]
                rows = np.arange(len(past) - how.samples, len(past) + 1) - f.delay
                fit = _PastWindow(structure, params, how, x, known[np.maximum(rows, 0)], y)
                x = fit.state()
            states.append(x)
        return states, first_of_line(past, first, f.delay)

    def step(state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        states, line = state
        line, acting = through_line(line, scaling.inputs(u))
        after: list[AnyArray] = []
        outputs: list[AnyArray] = []
        for x, (params, _) in zip(states, f.members, strict=True):
            x, w = structure.split(params, x, structure.input(params, acting[None]))
            after.append(x)
            outputs.append(structure.output(params, w))
        return (after, line), scaling.physical(median(outputs)[0])

    steps = turned(Steps(initial, step), f.turns)
    return steps if f.transport is None else carried_steps(steps, f.transport)


def _start(structure: StateSpaceStructure, encoder: Any, features: AnyArray) -> AnyArray:
    if structure.lags is not None:
        return features @ structure.lags.selection()
    return encoder(features)


@dataclass(frozen=True)
class _PastWindow:
    """`asia.models._state_space.past_fit.fitted_state` for one window."""

    structure: StateSpaceStructure
    params: Mapping[str, Any]
    how: PastFit
    guess: AnyArray
    u: AnyArray
    past_y: AnyArray

    def state(self) -> AnyArray:
        """After the window (1, n)."""
        import jax
        import jax.numpy as jnp

        def improve(carry: Any, _: Any) -> Any:
            x, damping = carry
            residual, cost = self._residual(x)
            moved = x + self._step(x, residual, damping)
            _, costs = self._residual(moved)
            better = costs < cost
            x = jnp.where(better, moved, x)
            return (x, jnp.where(better, damping * LESS, damping * MORE)), 0.0

        start = self.guess, jnp.asarray(DAMPING)
        (x, _), _ = jax.lax.scan(improve, start, None, STEPS)
        return self._simulated(x)[0]

    def _simulated(self, x: AnyArray) -> tuple[AnyArray, AnyArray]:
        """The state after the window (1, n), and the outputs in it (samples, ny)."""
        import jax

        def one(x: AnyArray, u: AnyArray) -> tuple[AnyArray, AnyArray]:
            after, w = self.structure.split(
                self.params, x, self.structure.input(self.params, u[None])
            )
            return after, self.structure.output(self.params, w)[0]

        return jax.lax.scan(one, x, self.u[:-1])

    def _residual(self, x: AnyArray) -> tuple[AnyArray, AnyArray]:
        import jax.numpy as jnp

        _, y = self._simulated(x)
        error = (y - self.past_y[-self.how.samples :]) / self.how.y_deviation
        both = jnp.concatenate([error.reshape(-1), ((x - self.guess) / self.how.x_deviation)[0]])
        cost = (both**2).sum()
        return both, jnp.where(jnp.isfinite(cost), cost, np.inf)

    def _step(self, x: AnyArray, residual: AnyArray, damping: AnyArray) -> AnyArray:
        import jax.numpy as jnp

        n = x.shape[1]
        width = DIFFERENCE * self.how.x_deviation
        columns = [
            (self._residual(x + np.eye(n)[j] * width[j])[0] - residual) / width[j] for j in range(n)
        ]
        slope = _finite(jnp.stack(columns, axis=1))
        gram = slope.T @ slope
        gradient = slope.T @ _finite(residual)
        held = gram + damping * (gram * np.eye(n)) + 1e-12 * np.eye(n)
        return -solved(held, gradient)[None]


def _finite(x: AnyArray) -> AnyArray:
    import jax.numpy as jnp

    return jnp.where(jnp.isfinite(x), x, 0.0)
