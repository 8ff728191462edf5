"""Steps of an input-output model in free run, and of an echo state network."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from asia.candidate import Steps
from asia.models._arrays import AnyArray, bounded
from asia.models._data.lags import FreeRun, lagged_inputs
from asia.models._data.records import window
from asia.models._data.scaling import Scaling
from asia.models._steps.shared import mean

if TYPE_CHECKING:
    from asia.models.esn import FittedReservoirs, Member


def free_run_steps(run: FreeRun, scaling: Scaling) -> Steps:
    """The state holds lagged inputs, the oldest first, and lagged outputs, the newest first."""
    lags = run.history.lags

    def initial(past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        signals = scaling.inputs(past_u), scaling.outputs(past_y), scaling.inputs(u)[None]
        old_u, old_y = run.history(*(s[None] for s in signals))
        return old_u, old_y[:, ::-1].reshape(1, -1)

    def step(state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        import jax.numpy as jnp

        old_u, past = state
        known = jnp.concatenate([old_u, scaling.inputs(u)[None, None]], axis=1)
        drive = lagged_inputs(known, lags)[:, 0]
        y = run.one_step(jnp.concatenate([past, drive], axis=1))
        y = bounded(y, run.limits.low, run.limits.high)
        past = jnp.concatenate([y, past], axis=1)[:, : past.shape[1]]
        return (known[:, 1:], past), scaling.physical(y[0])

    return Steps(initial, step)


def reservoir_steps(f: FittedReservoirs) -> Steps:
    """The mean over the reservoirs."""
    scaling = f.scaling

    def initial(past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        del u
        past = window(scaling.inputs(past_u)[None], scaling.outputs(past_y)[None])
        return [_begun(m, past) for m in f.members]

    def step(states: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        v = scaling.inputs(u)[None]
        pairs = [_advanced(m, s, v) for m, s in zip(f.members, states, strict=True)]
        return [s for s, _ in pairs], scaling.physical(mean([y for _, y in pairs])[0])

    return Steps(initial, step)


def _begun(member: Member, past: AnyArray) -> Any:
    import jax.numpy as jnp

    x = member.start(past)
    return (x,) if member.span is None else (x, past, jnp.asarray(0.0))


def _advanced(member: Member, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
    import jax.numpy as jnp

    r, (x, *held) = member.reservoir, state
    x = x + r.leak * (jnp.tanh(x @ r.recurrent + (u @ r.drive + r.bias)) - x)
    seen = [x, u]
    if member.span is not None:
        past, count = held
        count = count + 1.0
        seen += [past, past * (count / np.float64(member.span))]
        held = [past, count]
    return (x, *held), member.readout(jnp.concatenate(seen, axis=1))
