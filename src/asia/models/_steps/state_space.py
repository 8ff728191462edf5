"""Steps of a neural state-space model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from asia.candidate import Steps
from asia.models._arrays import AnyArray
from asia.models._data.records import window
from asia.models._state_space.past_fit import fitted_state
from asia.models._state_space.structure import StateSpaceStructure
from asia.models._steps.carried import carried_steps
from asia.models._steps.shared import first_of_line, median, through_line, turned

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
                held = known[np.maximum(rows, 0)]
                recent = y[-how.samples :]
                x = fitted_state(structure, params, how, x, held[None], recent[None])
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
