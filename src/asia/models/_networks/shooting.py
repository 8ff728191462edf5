"""The training loop of `methods.MultipleShooting`."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from asia.errors import UserError
from asia.models._data.chunks import Simulations, laid
from asia.models._data.records import PaddedBatch
from asia.models._networks.adam import finite, joined, merged, optimiser, scheduled, split
from asia.models._networks.monitor import Monitor, marks
from asia.models._networks.objective import objective, scan
from asia.models._networks.structure import Cell, NetworkStructure, Params, SequenceMap
from asia.models.methods import MultipleShooting

_MEMORY = 0.98


class ShootingSegments(NamedTuple):
    """Pieces of the records in time order, and which of them (B,) open a record."""

    data: Simulations
    first: jax.Array


class _ShootingState(NamedTuple):
    """Parameters, and initial states of all segments; those that open a record are not used."""

    trained: Any
    starts: Any
    memory: tuple[Any, Any]
    loss: jax.Array


def run(
    cell: NetworkStructure,
    params: Params,
    batch: PaddedBatch,
    method: MultipleShooting,
    steps: int,
    monitor: Monitor,
) -> Params:
    """The parameters after `steps` updates, or after those that `monitor` allows. A step whose
    gradient is not finite is skipped."""
    if isinstance(cell, SequenceMap) or not isinstance(cell, Cell):
        raise UserError(
            "MultipleShooting: the network computes all samples at once and has no state to start "
            "a segment from; train it with Adam"
        )
    segments = ShootingSegments(
        laid(batch, method.length, overlap=False), _openings(batch, method.length)
    )
    trained, fixed = split(params)
    starts = jax.jit(cell.initial)(merged(trained, fixed), segments.data.window)
    rules = _rules(method)
    memory = (rules[0].init(trained), rules[1].init(starts))
    state = _ShootingState(trained, starts, memory, jnp.zeros((), jnp.float32))

    def current() -> Params:
        return joined(state.trained, fixed)

    done = 0
    for mark in marks(method, steps):
        span = jnp.int32(done), jnp.int32(mark)
        rate = jnp.float32(monitor.rate)
        state = _advance(cell, method, segments, fixed, state, span, rate)
        done = mark
        monitor(mark, current, float(state.loss))
        if monitor.stopped:
            break
    return current()


def _openings(batch: PaddedBatch, length: int) -> jax.Array:
    counts = -(-np.asarray(batch.lengths) // min(length, batch.u.shape[1]))
    first = np.zeros(counts.sum(), bool)
    first[np.concatenate([[0], np.cumsum(counts)[:-1]])] = True
    return jnp.asarray(first)


def _rules(
    method: MultipleShooting,
) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    # The loss changes on the way: squares of gradients are averaged over fewer steps than usual.
    return optimiser(method.optimiser, _MEMORY), optax.adam(1.0, b2=_MEMORY)


@partial(jax.jit, static_argnums=(0, 1))
def _advance(
    cell: Cell,
    method: MultipleShooting,
    segments: ShootingSegments,
    fixed: Any,
    state: _ShootingState,
    span: tuple[jax.Array, jax.Array],
    rate: jax.Array,
) -> _ShootingState:
    data, (rule, start_rule) = segments.data, _rules(method)

    def loss_of(trained: Any, starts: Any, step: jax.Array) -> tuple[jax.Array, jax.Array]:
        params = merged(trained, fixed)
        seen = cell.initial(params, data.window)
        opening = jax.tree.map(lambda a, b: _where(segments.first, a, b), seen, starts)
        features, last = scan(cell, params, opening, data.u)
        residual = cell.output(params, features, data.u) - data.y
        error = objective(method.loss, residual, data.weight)
        growth = (method.penalty / method.penalty_start) ** (step / method.steps)
        tied = _gap(jax.tree.map(lambda v: v[1:], opening), last, segments.first)
        learned = _gap(
            jax.tree.map(lambda v: jax.lax.stop_gradient(v[1:]), opening),
            jax.tree.map(lambda v: jnp.concatenate([v[1:], v[:1]]), seen),
            segments.first,
        )
        return error + method.penalty_start * growth * tied + learned, error

    def update(step: jax.Array, state: _ShootingState) -> _ShootingState:
        gradient_of = jax.value_and_grad(loss_of, argnums=(0, 1), has_aux=True)
        (_, error), (slope, start_slope) = gradient_of(state.trained, state.starts, step)
        pace = scheduled(method.optimiser, rate, step)
        change, memory = rule.update(slope, state.memory[0], state.trained)
        start_change, start_memory = start_rule.update(
            _clipped(start_slope, method.clip), state.memory[1]
        )
        trained = optax.apply_updates(state.trained, jax.tree.map(lambda c: pace * c, change))
        starts = optax.apply_updates(state.starts, jax.tree.map(lambda c: pace * c, start_change))
        moved = _ShootingState(trained, starts, (memory, start_memory), error)
        good = finite((slope, start_slope))
        return jax.tree.map(lambda a, b: jnp.where(good, a, b), moved, state)

    return jax.lax.fori_loop(*span, update, state)


def _clipped(slopes: Any, clip: float) -> Any:
    """Gradients of the starts, each that of its own segment's loss and clipped by itself: one
    segment that explodes must not hold up the others, nor itself for long."""
    leaves = jax.tree.leaves(slopes)
    count = leaves[0].shape[0]
    squares = sum((jnp.sum(v.reshape(count, -1) ** 2, axis=1) for v in leaves), jnp.zeros(count))
    scale = count / jnp.maximum(1.0, count * jnp.sqrt(squares) / clip)
    return jax.tree.map(lambda v: v * scale.reshape(-1, *[1] * (v.ndim - 1)), slopes)


def _gap(starts: Any, ends: Any, first: jax.Array) -> jax.Array:
    """Mean squared distance of start i + 1 from end i, over the pairs within a record."""
    linked = ~first[1:]
    gaps = [
        jnp.sum(linked * ((a - b[:-1]) ** 2).reshape(len(linked), -1).mean(axis=1))
        for a, b in zip(jax.tree.leaves(starts), jax.tree.leaves(ends), strict=True)
    ]
    return sum(gaps, jnp.zeros(())) / (len(gaps) * jnp.maximum(jnp.sum(linked), 1))


def _where(rows: jax.Array, one: jax.Array, other: jax.Array) -> jax.Array:
    return jnp.where(rows.reshape(-1, *[1] * (one.ndim - 1)), one, other)
