"""The training loop of `methods.Adam`, compiled as one loop over steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from asia.models._network import Cell, Params, rollout
from asia.models._records import Batch
from asia.models.methods import Adam

_REPORTS = 25

Log = Callable[[float, float], None]


class Data(NamedTuple):
    """Arrays of a `Batch` on the device: see there for shapes."""

    window: jax.Array
    u: jax.Array
    y: jax.Array
    weight: jax.Array
    start_windows: jax.Array
    starts: jax.Array


class _State(NamedTuple):
    params: Any
    optimiser: Any
    loss: jax.Array


def train_adam(
    cell: Cell,
    params: Params,
    batch: Batch,
    held_out: Batch | None,
    method: Adam,
    seed: int,
    log: Log,
) -> Params:
    """Minimises the mean squared simulation error in z-scores; returns the last parameters.

    `held_out`: the same records weighted where `batch` is not. With it the number of steps with
    the least held-out error is picked on a first run, then used on all samples. A step whose
    gradient is not finite is skipped.
    """
    full = batch
    steps = method.steps
    if held_out is not None:
        errors = _run(cell, params, batch, held_out, method, steps, seed, log)[1]
        steps = _marks(method)[int(np.argmin(errors))]
        full = replace(batch, weight=batch.weight + held_out.weight)
    return _run(cell, params, full, None, method, steps, seed, log)[0]


def _run(
    cell: Cell,
    params: Params,
    batch: Batch,
    held_out: Batch | None,
    method: Adam,
    steps: int,
    seed: int,
    log: Log,
) -> tuple[Params, list[float]]:
    data = _on_device(batch, method)
    other = None if held_out is None else _on_device(held_out, method)
    start = jax.tree.map(jnp.asarray, params)
    state = _State(start, _optimiser(method).init(start), jnp.zeros((), data.u.dtype))
    marks = sorted({min(mark, steps) for mark in _marks(method)})
    errors: list[float] = []
    done = 0
    for mark in marks:
        state = _advance(cell, method, data, state, jnp.int32(done), jnp.int32(mark), seed)
        done = mark
        log(mark, float(jnp.sqrt(state.loss)))
        if other is not None:
            error = float(_error(cell, state.params, other))
            errors.append(error if np.isfinite(error) else float("inf"))
    return jax.tree.map(np.asarray, state.params), errors


def _marks(method: Adam) -> list[int]:
    """Numbers of steps after which the error is reported: `_REPORTS` of them, fewer when there
    are fewer steps."""
    marks = {round(method.steps * (i + 1) / _REPORTS) for i in range(_REPORTS)}
    return sorted(marks - {0})


def _on_device(batch: Batch, method: Adam) -> Data:
    starts = np.asarray(batch.starts, np.int32)
    lengths = np.asarray(batch.lengths)
    rows = np.flatnonzero(starts[:, 1] == 0)
    if method.truncation is not None:
        own = lengths[starts[:, 0]]
        fits = starts[:, 1] + method.truncation <= own
        if fits.any():
            # A record shorter than a chunk is one whole, as often as it has samples.
            whole = own < method.truncation
            index = np.arange(len(starts))
            rows = np.where(whole, index - starts[:, 1], index)[fits | whole]
    arrays = (batch.window, batch.u, batch.y, batch.weight, batch.start_windows[rows])
    window, u, y, weight, windows = (jnp.asarray(a, jnp.float32) for a in arrays)
    return Data(window, u, y, weight, windows, jnp.asarray(starts[rows]))


def _optimiser(method: Adam) -> optax.GradientTransformation:
    rate: Any = method.learning_rate
    if method.schedule == "cosine":
        rate = optax.cosine_decay_schedule(method.learning_rate, method.steps)
    return optax.chain(
        optax.clip_by_global_norm(method.clip),
        optax.adamw(rate, weight_decay=method.weight_decay),
    )


@partial(jax.jit, static_argnums=(0, 1))
def _advance(
    cell: Cell,
    method: Adam,
    data: Data,
    state: _State,
    first: jax.Array,
    last: jax.Array,
    seed: jax.Array,
) -> _State:
    optimiser = _optimiser(method)
    root = jax.random.key(seed)

    def loss_of(params: Any, key: jax.Array) -> jax.Array:
        picked, shaken = jax.random.split(key)
        part = data if method.truncation is None else _chunks(data, method, picked)
        u = part.u
        if method.noise > 0:
            u = u + method.noise * jax.random.normal(shaken, u.shape, u.dtype)
        return _error(cell, params, part._replace(u=u))

    def update(step: jax.Array, state: _State) -> _State:
        loss, gradient = jax.value_and_grad(loss_of)(state.params, jax.random.fold_in(root, step))
        change, optimiser_state = optimiser.update(gradient, state.optimiser, state.params)
        moved = _State(optax.apply_updates(state.params, change), optimiser_state, loss)
        squares = [jnp.sum(g**2) for g in jax.tree.leaves(gradient)]
        finite = jnp.isfinite(jnp.sum(jnp.stack(squares)))
        return jax.tree.map(lambda new, old: jnp.where(finite, new, old), moved, state)

    return jax.lax.fori_loop(first, last, update, state)


def _chunks(data: Data, method: Adam, key: jax.Array) -> Data:
    """As many random chunks as cover the records once, each from its own past window."""
    length = min(method.truncation or data.u.shape[1], data.u.shape[1])
    count = max(1, data.u.shape[0] * data.u.shape[1] // length)
    picked = jax.random.randint(key, (count,), 0, data.starts.shape[0])

    def cut(values: jax.Array) -> jax.Array:
        def one(start: jax.Array) -> jax.Array:
            return jax.lax.dynamic_slice_in_dim(values[start[0]], start[1], length)

        return jax.vmap(one)(data.starts[picked])

    counts = (jnp.arange(length) >= method.washout).astype(data.weight.dtype)
    return data._replace(
        window=data.start_windows[picked],
        u=cut(data.u),
        y=cut(data.y),
        weight=cut(data.weight) * counts,
    )


@partial(jax.jit, static_argnums=0)
def _error(cell: Cell, params: Any, data: Data) -> jax.Array:
    residual = rollout(cell, params, data.window, data.u) - data.y
    weight = data.weight[..., None]
    return jnp.sum(weight * residual**2) / jnp.maximum(jnp.sum(weight) * data.y.shape[-1], 1.0)
