"""Steps of a model whose inputs are carried through a pipe at the pace of one of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from asia.candidate import Steps
from asia.data._transport import Transport
from asia.models._arrays import AnyArray


def carried_steps(steps: Steps, transport: Transport) -> Steps:
    """`Transport.carried` before a model. The state holds what is in the pipe: the inputs of the
    samples in which it entered, the oldest first, and the amounts that have passed since these
    began."""
    length = transport.longest + 1

    def initial(past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        import jax
        import jax.numpy as jnp

        first = past_u[0] if len(past_u) else u
        pace = jnp.maximum(first[transport.pace], transport.least_pace)
        pipe = jnp.repeat(first[None], length, axis=0), pace * np.arange(length, 0.0, -1.0)
        leaving: AnyArray = jnp.zeros((0, len(u) + 1))
        if len(past_u):
            pipe, leaving = jax.lax.scan(lambda p, v: _through(transport, p, v), pipe, past_u)
        _, acting = _through(transport, pipe, u)
        return pipe, steps.initial(leaving, past_y, acting)

    def step(state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        pipe, inner = state
        pipe, acting = _through(transport, pipe, u)
        inner, y = steps.step(inner, acting)
        return (pipe, inner), y

    return Steps(initial, step)


def _through(transport: Transport, pipe: Any, u: AnyArray) -> tuple[Any, AnyArray]:
    """The pipe after an input u (nu,), and what leaves it during this sample (nu + 1,)."""
    import jax.numpy as jnp

    held, since = pipe
    pace = jnp.maximum(u[transport.pace], transport.least_pace)[None]
    known = jnp.concatenate([held, u[None]])
    began = jnp.concatenate([since, jnp.zeros(1)])
    amount = jnp.concatenate([since[:-1] - since[1:], since[-1:], pace])

    def left(most: AnyArray) -> AnyArray:
        """Share of each sample's amount that lies further back than so much."""
        return jnp.clip((began - most) / amount, 0.0, 1.0)

    share = left(transport.volume - pace) - left(jnp.asarray(transport.volume))
    acting = jnp.concatenate([share @ known / share.sum(), u[transport.pace, None]])
    return (known[1:], began[1:] + pace), acting
