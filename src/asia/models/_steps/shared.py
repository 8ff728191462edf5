"""What the steps of several families are made of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from asia.candidate import Steps
from asia.data import Array
from asia.models._arrays import AnyArray
from asia.models._data.turns import SignalTurns


def first_of_line(past: AnyArray, u: AnyArray, delay: int) -> AnyArray:
    """The last `delay` inputs (delay, nu) before the first sample, the oldest first, from past
    (n_past_u, nu) and the first input u (nu,): before the first known one it is held backwards, as
    in `asia.models._data.records.delayed`."""
    import jax.numpy as jnp

    known = jnp.concatenate([past, u[None]])
    return known[np.maximum(np.arange(len(past) - delay, len(past)), 0)]


def through_line(line: AnyArray, u: AnyArray) -> tuple[AnyArray, AnyArray]:
    """The line after an input u (nu,), and the input that acts now."""
    import jax.numpy as jnp

    known = jnp.concatenate([line, u[None]])
    return known[1:], known[0]


def turned(steps: Steps, turns: SignalTurns | None) -> Steps:
    """Averaged over the elements of a group, as `SignalTurns.averaged` does."""
    if turns is None:
        return steps
    elements: list[tuple[Array, Array]] = list(zip(turns.inputs, turns.outputs, strict=True))

    def initial(past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        return [
            steps.initial(past_u @ by_u.T, past_y @ by_y.T, u @ by_u.T) for by_u, by_y in elements
        ]

    def step(states: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        after: list[Any] = []
        outputs: list[AnyArray] = []
        for state, (by_u, by_y) in zip(states, elements, strict=True):
            state, y = steps.step(state, u @ by_u.T)
            after.append(state)
            outputs.append(y @ by_y)
        return after, mean(outputs)

    return Steps(initial, step)


def mean(values: Sequence[AnyArray]) -> AnyArray:
    """Of arrays of one shape."""
    return sum(values[1:], values[0]) / len(values)


def median(values: Sequence[AnyArray]) -> AnyArray:
    """Of arrays of one shape, number by number."""
    import jax.numpy as jnp

    ranked = list(values)
    for last in range(len(ranked) - 1, 0, -1):
        for i in range(last):
            a, b = ranked[i], ranked[i + 1]
            ranked[i], ranked[i + 1] = jnp.minimum(a, b), jnp.maximum(a, b)
    middle = len(ranked) // 2
    return ranked[middle] if len(ranked) % 2 else 0.5 * (ranked[middle - 1] + ranked[middle])
