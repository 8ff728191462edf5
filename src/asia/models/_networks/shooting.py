"""Training loop of `methods.MultipleShooting`."""

from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax

from asia.errors import UserError
from asia.models._arrays import AnyArray, Packing, packed
from asia.models._networks.adam import joined, merged, split
from asia.models._networks.monitor import Monitor, marks
from asia.models._networks.objective import (
    AdamNumbers,
    AdamProgram,
    Number,
    all_finite,
    either,
    objective,
    scan,
    started,
)
from asia.models._networks.structure import Cell, NetworkStructure, Params, SequenceMap
from asia.models._numerics.segments import laid
from asia.models._numerics.training_records import SegmentBatch
from asia.models.methods import MultipleShooting

_MEMORY = 0.98


class ShootingSegments(NamedTuple):
    """Segments of the records in time order, and a mask (B,) of those that open a record."""

    data: SegmentBatch
    first: AnyArray


class ShootingNumbers(NamedTuple):
    """Numbers of `methods.MultipleShooting`: arguments of its program."""

    optimiser: AdamNumbers
    clip: Number
    penalty: Number
    penalty_start: Number


class _ShootingState(NamedTuple):
    """Parameters in one vector, and initial states of all segments; those that open a record are
    not used."""

    trained: AnyArray
    starts: Any
    memory: tuple[Any, Any]
    loss: AnyArray


def run(
    cell: NetworkStructure,
    params: Params,
    batch: SegmentBatch,
    method: MultipleShooting,
    steps: int,
    monitor: Monitor,
) -> Params:
    """Train for `steps` updates, or for as many as `monitor` allows. A step whose gradient is
    not finite is skipped."""
    if isinstance(cell, SequenceMap) or not isinstance(cell, Cell):
        raise UserError(
            "MultipleShooting: the network computes all samples at once and has no state to start "
            "a segment from; train it with Adam"
        )
    counts = -(-np.asarray(batch.lengths) // min(method.length, batch.u.shape[1]))
    first = np.zeros(counts.sum(), bool)
    first[np.concatenate([[0], np.cumsum(counts)[:-1]])] = True
    segments = ShootingSegments(laid(batch, method.length, overlap=False), first)
    trained, fixed = split(params)
    packing, theta = Packing.of(trained), packed(trained, np.float32)
    starts = jax.tree.map(np.asarray, cell.initial(params, segments.data.window))
    adam = method.optimiser
    program = AdamProgram.of(adam, method.length)
    numbers = ShootingNumbers(
        AdamNumbers.of(adam), method.clip, method.penalty, method.penalty_start
    )
    rules = _rules(program, numbers)
    memory = started(rules[0], theta), started(rules[1], starts)
    state = _ShootingState(theta, starts, memory, np.float32(0.0))

    def current() -> Params:
        return joined(packing.unpack(np.asarray(state.trained)), fixed)

    done = 0
    for mark in marks(method, steps):
        span, rate = (np.int32(done), np.int32(mark)), np.float32(monitor.rate)
        state = _advance(cell, program, packing, numbers, segments, fixed, state, span, rate)
        done = mark
        monitor(mark, current, float(state.loss))
        if monitor.stopped:
            break
    return current()


def _rules(
    program: AdamProgram, numbers: ShootingNumbers
) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    # The loss changes on the way: squares of gradients are averaged over fewer steps than usual.
    return program.optimiser(numbers.optimiser, _MEMORY), optax.adam(1.0, b2=_MEMORY)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _advance(
    cell: Cell,
    program: AdamProgram,
    packing: Packing,
    numbers: ShootingNumbers,
    segments: ShootingSegments,
    fixed: Any,
    state: _ShootingState,
    span: tuple[jax.Array, jax.Array],
    rate: jax.Array,
) -> _ShootingState:
    data, (rule, start_rule) = segments.data, _rules(program, numbers)

    def loss_of(trained: jax.Array, starts: Any, step: jax.Array) -> tuple[jax.Array, jax.Array]:
        params = merged(packing.unpack(trained), fixed)
        seen = cell.initial(params, data.window)
        opening = jax.tree.map(lambda a, b: _where(segments.first, a, b), seen, starts)
        features, last = scan(cell, params, opening, data.u)
        residual = cell.output(params, features, data.u) - data.y
        error = objective(program.loss, residual, data.weight)
        growth = (numbers.penalty / numbers.penalty_start) ** (step / numbers.optimiser.steps)
        tied = _gap(jax.tree.map(lambda v: v[1:], opening), last, segments.first)
        learned = _gap(
            jax.tree.map(lambda v: jax.lax.stop_gradient(v[1:]), opening),
            jax.tree.map(lambda v: jnp.concatenate([v[1:], v[:1]]), seen),
            segments.first,
        )
        return error + numbers.penalty_start * growth * tied + learned, error

    def update(step: jax.Array, state: _ShootingState) -> _ShootingState:
        gradient_of = jax.value_and_grad(loss_of, argnums=(0, 1), has_aux=True)
        (_, error), (slope, start_slope) = gradient_of(state.trained, state.starts, step)
        pace = program.scheduled(numbers.optimiser, rate, step)
        change, memory = rule.update(slope, state.memory[0], state.trained)
        start_change, start_memory = start_rule.update(
            _clipped(start_slope, numbers.clip), state.memory[1]
        )
        trained = state.trained + pace * cast(jax.Array, change)
        starts = optax.apply_updates(state.starts, jax.tree.map(lambda c: pace * c, start_change))
        moved = _ShootingState(trained, starts, (memory, start_memory), error)
        return either(all_finite(slope, start_slope), moved, state)

    return jax.lax.fori_loop(*span, update, state)


def _clipped(slopes: Any, clip: Number) -> Any:
    """Gradients of the starts, each that of its own segment's loss and clipped separately: one
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
