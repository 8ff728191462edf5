"""Levenberg-Marquardt on the simulation error of a neural state-space model.

The Jacobian comes from the sensitivity equations: derivatives of one step are taken by reverse
differentiation at many samples at once, and only the product of state Jacobians runs through time.
It is never held as a whole: its products are summed chunk by chunk, so that memory does not grow
with the length of the records.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from asia.candidate import Context
from asia.data import Array
from asia.models._arrays import AnyArray
from asia.models._data.cuts import padded, side_by_side
from asia.models._data.encoder import Encoder, fit_encoder
from asia.models._data.records import ScaledData, past_length, windows
from asia.models._solvers.levenberg_marquardt import (
    LevenbergMarquardt,
    LMLimits,
    LMState,
    Normal,
    advance,
    finite_cost,
    initial_state,
    normal_from_sums,
)
from asia.models._solvers.progress import Progress
from asia.models._state_space.structure import StateSpaceStructure

# Numbers in the derivatives of one chunk of samples.
_CHUNK_VALUES = 4_000_000
_ITERATIONS_BETWEEN_LOGS, _ITERATIONS_HELD = 5, 64


class StateSamples(NamedTuple):
    """Samples side by side."""

    x0: Array
    """Where the search for the initial states (R, n) starts or, when `known`, what they are."""
    u: Array
    """(R, T, nu)."""
    y: Array
    """(R, T, ny)."""
    weight: Array
    """(R, T), 0 in the padding."""
    known: bool
    """Whether the initial states are given."""


class SampleChunks(NamedTuple):
    """Chunks of samples in time order."""

    u: Any
    """(K, c, R, nu)."""
    y: Any
    """(K, c, R, ny)."""
    weight: Any
    """(K, c, R), scaled so that the sum of squares is a mean."""
    x0: Any
    """Initial states (R, n)."""
    pull: Any
    """Ridge (P,) of each parameter towards `origin`."""
    origin: Any
    """(P,)."""


class StateFit(NamedTuple):
    """A fit from one start."""

    x0: Array
    """Initial states (R, n)."""
    params: dict[str, Any]
    """As the structure reads them."""
    cost: float
    """Mean squared error and ridge."""
    history: Array
    """Root of the cost by iteration."""


def of_records(records: ScaledData, x0: Array) -> StateSamples:
    """Whole records, their initial states to be found from x0 (R, n)."""
    u, y, weight = (
        side_by_side([getattr(r, name) for r in records]) for name in ("u", "y", "weight")
    )
    return StateSamples(x0, u, y, weight, known=False)


def fit_states(
    structure: StateSpaceStructure,
    starts: Sequence[dict[str, Any]],
    samples: StateSamples,
    ridge: dict[str, float],
    method: LevenbergMarquardt,
    log: Progress,
) -> list[StateFit]:
    """A fit from each start, the least cost first. `ridge` maps each top-level parameter name,
    and "x0", to its ridge. log(iteration, root of the least cost so far) over all starts."""
    lowest, results = np.inf, list[StateFit]()
    for i, start in enumerate(starts):
        tree = start if samples.known else {**start, "x0": samples.x0}
        pull = {
            name: jax.tree.map(lambda v, r=ridge[name]: np.full(np.shape(v), r), value)
            for name, value in tree.items()
        }
        theta, shapes = _flat(tree), _shapes(tree)
        data = _chunked(samples, structure, _flat(pull), theta)
        limits = LMLimits(method.iterations, method.tolerance)
        with jax.enable_x64(True):
            state = initial_state(theta, replace(method, iterations=_rounded(method.iterations)))
            for stop in _stops(method.iterations):
                state = _advance(structure, shapes, limits, state, data, stop)
                lowest = min(lowest, float(state.cost))
                log(float(i * method.iterations + int(state.iteration)), float(np.sqrt(lowest)))
                if state.done:
                    break
        best = shapes.tree(np.asarray(state.theta))
        history = np.sqrt(np.asarray(state.history))[: int(state.iteration) + 1]
        x0 = best.pop("x0", samples.x0)
        results.append(StateFit(x0, best, float(state.cost), history))
    return sorted(results, key=lambda r: r.cost)


def state_encoder(
    structure: StateSpaceStructure,
    fit: StateFit,
    records: ScaledData,
    context: Context,
    hidden: int,
) -> Encoder:
    """Map from the past window to the state, from the fitted model's own states on the records."""
    skip = past_length(context)
    long = [i for i, r in enumerate(records) if len(r) > skip]
    states = [
        structure.simulate(fit.params, fit.x0[i, None], records[i].u[None])[0][0, skip:]
        for i in long
    ]
    return fit_encoder([windows(records[i], context) for i in long], states, hidden, context.seed)


def _stops(iterations: int) -> list[int]:
    return [*range(_ITERATIONS_BETWEEN_LOGS, iterations, _ITERATIONS_BETWEEN_LOGS), iterations]


def _chunked(
    samples: StateSamples, structure: StateSpaceStructure, pull: Array, origin: Array
) -> SampleChunks:
    count, length = samples.weight.shape
    values = count * (structure.order + structure.ny) * len(origin)
    size = int(np.clip(_CHUNK_VALUES // values, 1, length))
    chunks = -(-length // size)
    total = max(float((samples.weight**2).sum()) * structure.ny, 1.0)

    def cut(array: Array) -> Array:
        timed = np.swapaxes(array, 0, 1)
        return padded(timed, chunks * size).reshape(chunks, size, *timed.shape[1:])

    u, y, weight = cut(samples.u), cut(samples.y), cut(samples.weight / np.sqrt(total))
    return SampleChunks(u, y, weight, samples.x0, pull, origin)


def _rounded(iterations: int) -> int:
    """Iterations that a history has room for: one program serves fits of several lengths."""
    return -(-iterations // _ITERATIONS_HELD) * _ITERATIONS_HELD


def _flat(tree: Any) -> Array:
    return np.concatenate([np.ravel(v) for v in jax.tree.leaves(tree)], dtype=np.float64)


class _Shapes(NamedTuple):
    """Hashable recipe of a tree of arrays."""

    treedef: Any
    shapes: tuple[tuple[int, ...], ...]

    def tree(self, theta: AnyArray) -> Any:
        ends = np.cumsum([int(np.prod(s)) for s in self.shapes]).tolist()
        parts = [theta[a:b] for a, b in pairwise([0, *ends])]
        leaves = [p.reshape(s) for p, s in zip(parts, self.shapes, strict=True)]
        return jax.tree.unflatten(self.treedef, leaves)


def _shapes(tree: Any) -> _Shapes:
    leaves, treedef = jax.tree.flatten(tree)
    return _Shapes(treedef, tuple(np.shape(v) for v in leaves))


@partial(jax.jit, static_argnums=(0, 1))
def _advance(
    structure: StateSpaceStructure,
    shapes: _Shapes,
    limits: LMLimits,
    state: LMState,
    data: SampleChunks,
    until: Any,
) -> LMState:
    def initial(theta: jax.Array) -> jax.Array:
        tree = shapes.tree(theta)
        return tree["x0"] if "x0" in tree else jnp.asarray(data.x0)

    def step(theta: jax.Array, x: jax.Array, u: jax.Array) -> jax.Array:
        """(n,), (nu,) -> next state and output in one vector (n + ny,)."""
        p = shapes.tree(theta)
        state, w = structure.split(jnp, p, x, structure.input(jnp, p, u))
        return jnp.concatenate([state, structure.output(jnp, p, w)])

    def penalty(theta: jax.Array) -> jax.Array:
        return jnp.sum(data.pull * (theta - data.origin) ** 2)

    def cost(theta: jax.Array) -> jax.Array:
        def chunk(carry: Any, part: Any) -> Any:
            x, total = carry
            x, _, error = _run(step, structure.order, theta, x, part)
            return (x, total + jnp.sum(error**2)), None

        parts = (data.u, data.y, data.weight)
        (_, total), _ = jax.lax.scan(chunk, (initial(theta), jnp.zeros(())), parts)
        return finite_cost(total + penalty(theta))

    def normal(theta: jax.Array) -> Normal:
        total, gram, gradient = _sums(step, structure.order, theta, initial, data)
        pull = data.pull * (theta - data.origin)
        return normal_from_sums(total + penalty(theta), gram + jnp.diag(data.pull), gradient + pull)

    return advance(cost, normal, state, limits, until)


def _run(step: Any, n: int, theta: jax.Array, x: jax.Array, part: Any) -> Any:
    """One chunk from x (R, n): the last state, all states (c, R, n), weighted errors (c, R, ny)."""
    u, y, weight = part
    many = jax.vmap(step, (None, 0, 0))

    def move(x: jax.Array, u: jax.Array) -> Any:
        both = many(theta, x, u)
        return both[:, :n], (x, both[:, n:])

    x, (states, outputs) = jax.lax.scan(move, x, u)
    return x, states, weight[..., None] * (outputs - y)


def _sums(step: Any, n: int, theta: jax.Array, initial: Any, data: SampleChunks) -> Any:
    """Sum of squared errors, J' J and J' e."""
    derivatives = jax.vmap(jax.vmap(jax.jacrev(step, argnums=(0, 1)), (None, 0, 0)), (None, 0, 0))

    def chunk(carry: Any, part: Any) -> Any:
        x, s, total, gram, gradient = carry
        x, states, error = _run(step, n, theta, x, part)
        by_theta, by_x = derivatives(theta, states, part[0])

        def move(s: jax.Array, at: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            both = at[0] @ s + at[1]
            return both[:, :n], both[:, n:]

        s, sensitivity = jax.lax.scan(move, s, (by_x, by_theta))
        rows = (part[2][..., None, None] * sensitivity).reshape(-1, theta.size)
        e = error.ravel()
        return (x, s, total + e @ e, gram + rows.T @ rows, gradient + rows.T @ e), None

    x0, s0 = initial(theta), jax.jacfwd(initial)(theta)
    p = theta.size
    zero = (x0, s0, jnp.zeros(()), jnp.zeros((p, p)), jnp.zeros(p))
    (_, _, total, gram, gradient), _ = jax.lax.scan(chunk, zero, (data.u, data.y, data.weight))
    return total, gram, gradient
