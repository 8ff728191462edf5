"""Training loop of `methods.Adam`, compiled as one loop over steps."""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from asia.models._arrays import AnyArray, Packing, packed
from asia.models._networks.monitor import Monitor, marks
from asia.models._networks.objective import (
    AdamNumbers,
    AdamProgram,
    NoiseWeighting,
    all_finite,
    check_structure,
    either,
    forward,
    objective,
    started,
)
from asia.models._networks.structure import NetworkStructure, Params, Penalised
from asia.models._numerics.segments import (
    Places,
    gently,
    laid,
    places,
    random_chunks,
    whole,
)
from asia.models._numerics.training_records import SegmentBatch
from asia.models.methods import Adam


class AdamState(NamedTuple):
    """State of training between two steps."""

    trained: AnyArray  # Parameters that change, in one vector
    optimiser: Any  # State of the optimiser
    average: AnyArray | None  # Moving average of the parameters, or None
    loss: AnyArray  # Sum of the loss over the steps since the last check
    taken: AnyArray  # Number of these steps


def run(
    cell: NetworkStructure,
    params: Params,
    batch: SegmentBatch,
    method: Adam,
    horizon: int | None,
    seed: int,
    steps: int,
    monitor: Monitor,
    whiten: NoiseWeighting | None = None,
) -> Params:
    """Train for `steps` updates, or for as many as `monitor` allows. A step whose gradient is
    not finite is skipped."""
    check_structure(cell, params, method)
    length = method.truncation or horizon
    data: SegmentBatch | Places
    if length is None:
        data = whole(batch)
    elif method.full_batch:
        data = laid(batch, length)
    else:
        data = places(batch, length)
        if method.gentle > 0:
            data = gently(data, length, method.gentle)
    program, numbers = AdamProgram.of(method, length), AdamNumbers.of(method)
    trained, fixed = split(params)
    packing, theta = Packing.of(trained), packed(trained, np.float32)
    average, blank = theta if method.average > 0 else None, np.float32(0.0)
    memory = started(program.optimiser(numbers), theta)
    state = AdamState(theta, memory, average, blank, blank)

    def current() -> Params:
        reached = state.trained if state.average is None else state.average
        return joined(packing.unpack(np.asarray(reached)), fixed)

    done = 0
    for mark in marks(method, steps):
        span, rate = (np.int32(done), np.int32(mark)), np.float32(monitor.rate)
        args = numbers, data, fixed, state, span, rate, seed, whiten
        state = _advance(cell, program, packing, *args)
        taken, done = float(state.taken), mark
        monitor(mark, current, float(state.loss) / taken if taken > 0 else float("inf"))
        if monitor.stopped:
            break
    return current()


def split(params: Params) -> tuple[dict[str, Any], Any]:
    """Split parameters into trained and fixed ones."""
    return {k: v for k, v in params.items() if k != "fixed"}, params.get("fixed")


def joined(trained: Mapping[str, Any], fixed: Any) -> Params:
    """Join parameters that `split` separated, as NumPy arrays."""
    return cast(Params, jax.tree.map(np.array, merged(trained, fixed)))


def merged(trained: Mapping[str, Any], fixed: Any) -> dict[str, Any]:
    """Trained and fixed parameters as a structure reads them."""
    return dict(trained) if fixed is None else {**trained, "fixed": fixed}


@partial(jax.jit, static_argnums=(0, 1, 2))
def _advance(
    cell: NetworkStructure,
    program: AdamProgram,
    packing: Packing,
    numbers: AdamNumbers,
    data: SegmentBatch | Places,
    fixed: Any,
    state: AdamState,
    span: tuple[jax.Array, jax.Array],
    rate: jax.Array,
    seed: jax.Array,
    whiten: NoiseWeighting | None,
) -> AdamState:
    rule, root, length = program.optimiser(numbers), jax.random.key(seed), program.length or 1

    def loss_of(trained: jax.Array, step: jax.Array) -> jax.Array:
        params, part = merged(packing.unpack(trained), fixed), data
        drawn, shaken = jax.random.split(jax.random.fold_in(root, step))
        if isinstance(part, Places):
            part = random_chunks(part, length, program.batch, drawn)
        y = forward(cell, program, numbers, params, part, step=step, key=shaken)
        error = objective(program.loss, y - part.y, part.weight, program.horizons, whiten)
        return error + (cell.penalty(params) if isinstance(cell, Penalised) else 0.0)

    def update(step: jax.Array, state: AdamState) -> AdamState:
        loss, gradient = jax.value_and_grad(loss_of)(state.trained, step)
        change, memory = rule.update(gradient, state.optimiser, state.trained)
        pace = program.scheduled(numbers, rate, step)
        trained = state.trained + pace * cast(jax.Array, change)
        average = state.average
        if average is not None:
            slow = jnp.minimum(numbers.average, (1.0 + step) / (10.0 + step))
            average = slow * average + (1.0 - slow) * trained
        moved = AdamState(trained, memory, average, state.loss + loss, state.taken + 1.0)
        return either(all_finite(gradient), moved, state)

    blank = jnp.zeros((), jnp.float32)
    return jax.lax.fori_loop(*span, update, state._replace(loss=blank, taken=blank))
