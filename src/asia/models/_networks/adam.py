"""The training loop of `methods.Adam`, compiled as one loop over steps."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax

from asia.models._data.chunks import Places, Simulations, laid, places, random_chunks, tracks, whole
from asia.models._data.records import PaddedBatch
from asia.models._networks.monitor import Monitor, marks
from asia.models._networks.objective import check_structure, forward, objective
from asia.models._networks.structure import Cell, NetworkStructure, Params
from asia.models.methods import Adam


class AdamState(NamedTuple):
    """trained: the parameters that change, average: their moving average, or None; carried: state
    of the cell at the end of the last chunks, or None; loss, taken: sum over the steps since the
    last look, and how many these were."""

    trained: Any
    optimiser: Any
    average: Any
    carried: Any
    loss: jax.Array
    taken: jax.Array


def run(
    cell: NetworkStructure,
    params: Params,
    batch: PaddedBatch,
    method: Adam,
    horizon: int | None,
    seed: int,
    steps: int,
    monitor: Monitor,
) -> Params:
    """The parameters after `steps` updates, or after those that `monitor` allows. A step whose
    gradient is not finite is skipped."""
    check_structure(cell, params, method)
    length = method.truncation or horizon
    data = _seen(batch, method, length)
    trained, fixed = split(params)
    carried = None
    if isinstance(data, Simulations) and method.carry and isinstance(cell, Cell):
        carried = jax.tree.map(jnp.zeros_like, cell.initial(params, data.window))
    state = AdamState(
        trained,
        optimiser(method).init(trained),
        trained if method.average > 0 else None,
        carried,
        jnp.zeros((), jnp.float32),
        jnp.zeros((), jnp.float32),
    )

    def current() -> Params:
        return joined(state.trained if state.average is None else state.average, fixed)

    done = 0
    for mark in marks(method, steps):
        span = jnp.int32(done), jnp.int32(mark)
        rate = jnp.float32(monitor.rate)
        state = _advance(cell, method, length, data, fixed, state, span, rate, seed)
        loss, done = float(state.loss / jnp.maximum(state.taken, 1.0)), mark
        monitor(mark, current, loss if float(state.taken) > 0 else float("inf"))
        if monitor.stopped:
            break
    return current()


def split(params: Params) -> tuple[dict[str, Any], Any]:
    """What is trained, and what is not."""
    trained = {k: jax.tree.map(jnp.asarray, v) for k, v in params.items() if k != "fixed"}
    return trained, params.get("fixed")


def joined(trained: Mapping[str, Any], fixed: Any) -> Params:
    """The inverse of `split`, as NumPy arrays."""
    return cast(Params, jax.tree.map(np.asarray, merged(trained, fixed)))


def merged(trained: Mapping[str, Any], fixed: Any) -> dict[str, Any]:
    """Trained and fixed parameters as a structure reads them."""
    return dict(trained) if fixed is None else {**trained, "fixed": fixed}


def optimiser(method: Adam, memory: float = 0.999) -> optax.GradientTransformation:
    """The direction of a step, to be multiplied by the learning rate; `memory`: decay of the mean
    of squared gradients."""
    clip = optax.clip_by_global_norm(method.clip)
    if method.coupled:
        penalty = optax.add_decayed_weights(method.weight_decay)
        return optax.chain(clip, penalty, optax.adam(1.0, b2=memory))
    return optax.chain(clip, optax.adamw(1.0, b2=memory, weight_decay=method.weight_decay))


def scheduled(method: Adam, rate: jax.Array, step: jax.Array) -> jax.Array:
    """Learning rate of a step; `rate` is what the monitor says."""
    if method.schedule != "cosine":
        return rate
    return rate * 0.5 * (1.0 + jnp.cos(jnp.pi * step / method.steps))


def _seen(batch: PaddedBatch, method: Adam, length: int | None) -> Simulations | Places:
    if length is None:
        return whole(batch)
    if method.carry:
        return tracks(batch, length, method.batch, method.washout)
    return laid(batch, length) if method.full_batch else places(batch, length)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _advance(
    cell: NetworkStructure,
    method: Adam,
    length: int | None,
    data: Simulations | Places,
    fixed: Any,
    state: AdamState,
    span: tuple[jax.Array, jax.Array],
    rate: jax.Array,
    seed: jax.Array,
) -> AdamState:
    rule, root = optimiser(method), jax.random.key(seed)

    def loss_of(trained: Any, carried: Any, step: jax.Array) -> tuple[jax.Array, Any]:
        params = merged(trained, fixed)
        drawn, shaken = jax.random.split(jax.random.fold_in(root, step))
        teacher = method.teacher + (method.teacher_end - method.teacher) * step / method.steps
        if carried is not None and isinstance(cell, Cell) and isinstance(data, Simulations):
            part, fresh = _next_chunk(data, length or 1, step)
            start = _chosen(fresh, cell.initial(params, part.window), carried)
            y, last = forward(cell, method, params, part, teacher, shaken, start)
            error = objective(method.loss, y - part.y, part.weight, 0, method.horizons)
            return error, jax.lax.stop_gradient(last)
        part = data
        if isinstance(part, Places):
            part = random_chunks(part, length or 1, method.batch, drawn)
        y, _ = forward(cell, method, params, part, teacher, shaken)
        residual = y - part.y
        return objective(
            method.loss, residual, part.weight, method.washout, method.horizons
        ), carried

    def update(step: jax.Array, state: AdamState) -> AdamState:
        gradient_of = jax.value_and_grad(loss_of, has_aux=True)
        (loss, carried), gradient = gradient_of(state.trained, state.carried, step)
        change, memory = rule.update(gradient, state.optimiser, state.trained)
        pace = scheduled(method, rate, step)
        trained = optax.apply_updates(state.trained, jax.tree.map(lambda c: pace * c, change))
        average = state.average
        if average is not None:
            slow = jnp.minimum(method.average, (1.0 + step) / (10.0 + step))
            average = jax.tree.map(lambda a, t: slow * a + (1.0 - slow) * t, average, trained)
        moved = AdamState(trained, memory, average, carried, state.loss + loss, state.taken + 1.0)
        return _chosen(finite(gradient), moved, state)

    blank = jnp.zeros((), jnp.float32)
    return jax.lax.fori_loop(*span, update, state._replace(loss=blank, taken=blank))


def finite(tree: Any) -> jax.Array:
    """Whether every number in a tree of arrays is."""
    return jnp.isfinite(jnp.sum(jnp.stack([jnp.sum(g**2) for g in jax.tree.leaves(tree)])))


def _chosen(first: jax.Array, one: Any, other: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(first, a, b), one, other)


def _next_chunk(data: Simulations, length: int, step: jax.Array) -> tuple[Simulations, jax.Array]:
    """The chunk that follows the one of the step before, and whether it is the first of all."""
    index = step % (data.u.shape[1] // length)

    def cut(values: jax.Array) -> jax.Array:
        return jax.lax.dynamic_slice_in_dim(values, index * length, length, axis=1)

    return Simulations(data.window, cut(data.u), cut(data.y), cut(data.weight)), index == 0
