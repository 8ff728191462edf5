"""Steps of a linear state-space model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from asia.candidate import Steps
from asia.models._arrays import AnyArray
from asia.models._data.records import window
from asia.models._steps.shared import first_of_line, through_line

if TYPE_CHECKING:
    from asia.models.linear import FittedLevels, FittedLinear


def linear_steps(f: FittedLinear) -> Steps:
    """x' = A x + B u, y = C x + D u + offset."""
    s, scaling = f.system, f.scaling

    def initial(past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        past, first = scaling.inputs(past_u), scaling.inputs(u)
        x = f.encoder(window(past[None], scaling.outputs(past_y)[None]))[0]
        return x, first_of_line(past, first, f.delay)

    def step(state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        x, line = state
        line, v = through_line(line, scaling.inputs(u))
        y = x @ s.c.T + v @ s.d.T + s.offset
        return (x @ s.a.T + v @ s.b.T, line), scaling.physical(y)

    return Steps(initial, step)


def level_steps(found: FittedLevels) -> Steps:
    """Systems for levels of excitation, between whose outputs the running level decides."""
    each = [linear_steps(f) for f in found.systems]
    scaling, memory, levels = found.systems[0].scaling, found.memory, found.levels

    def initial(past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        import jax.numpy as jnp

        power = (scaling.inputs(past_u)[-memory:] ** 2).mean(axis=1)
        held = jnp.concatenate([jnp.zeros(memory - len(power)), power])
        count = jnp.asarray(float(len(power)))
        states = [one.initial(past_u, past_y, u) for one in each]
        return states, held, count

    def step(state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        import jax.numpy as jnp

        states, held, count = state
        power = (scaling.inputs(u) ** 2).mean()
        held = jnp.concatenate([held[1:], power[None]])
        count = jnp.minimum(count + 1.0, float(memory))
        at = jnp.sqrt(jnp.maximum(held.sum(), 0.0) / count)
        after: list[Any] = []
        total: AnyArray = 0.0
        for place, (one, x) in enumerate(zip(each, states, strict=True)):
            x, y = one.step(x, u)
            after.append(x)
            total = total + _share(levels, place, at) * y
        return (after, held, count), total

    return Steps(initial, step)


def _share(levels: Any, place: int, at: AnyArray) -> AnyArray:
    """Weight of a level at another one: 1 there, 0 at its neighbours, a straight line between."""
    import jax.numpy as jnp

    weight: AnyArray = jnp.asarray(1.0)
    if place > 0:
        rise = (at - levels[place - 1]) / (levels[place] - levels[place - 1])
        weight = jnp.minimum(weight, rise)
    if place + 1 < len(levels):
        fall = (levels[place + 1] - at) / (levels[place + 1] - levels[place])
        weight = jnp.minimum(weight, fall)
    return jnp.maximum(weight, np.float64(0.0))
