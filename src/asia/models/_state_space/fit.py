"""Levenberg-Marquardt on the simulation error of a neural state-space model.

The Jacobian comes from the sensitivity equations: derivatives of one step are taken by reverse
differentiation at many samples at once, and only the product of state Jacobians runs through time.
It is never held as a whole: its products are summed chunk by chunk, so that memory does not grow
with the length of the records.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from asia.candidate import Context
from asia.data import Array
from asia.models._data.cuts import padded, side_by_side
from asia.models._data.encoder import Encoder, fit_encoder
from asia.models._data.records import ScaledData, past_length, windows
from asia.models._solvers.least_squares import LevenbergMarquardt
from asia.models._solvers.minimise import NormalEquations, minimise
from asia.models._solvers.packing import Packing, packed
from asia.models._solvers.progress import Progress
from asia.models._state_space.structure import StateSpaceStructure

# Numbers in the derivatives of one chunk of samples.
_CHUNK_VALUES = 4_000_000
_ITERATIONS_BETWEEN_LOGS = 5

Watch: TypeAlias = Callable[[int, float], None]
"""Told the iterations that are done, and the cost after them."""


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
        theta, packing = packed(tree, np.float64), Packing.of(tree)
        data = _chunked(samples, structure, packed(pull, np.float64), theta)
        watch = _logged(log, i * method.iterations, lowest)
        equations = _CompiledEquations(structure, packing, data, watch)
        found = minimise(equations.costs, equations.normal, theta[None], method)
        best, cost, done = packing.unpack(found.theta[0]), float(found.cost[0]), equations.done
        watch(done, cost)
        lowest = min(lowest, cost)
        x0 = best.pop("x0", samples.x0)
        results.append(StateFit(x0, best, cost, np.sqrt(found.history[0, : done + 1])))
    return sorted(results, key=lambda r: r.cost)


def _logged(log: Progress, count: int, lowest: float) -> Watch:
    """The root of the least cost so far, by iterations counted from `count`."""

    def watch(done: int, cost: float) -> None:
        if np.isfinite(cost):
            log(float(count + done), float(np.sqrt(min(lowest, cost))))

    return watch


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


class _CompiledEquations:
    """Costs and normal equations of one fit, for `minimise`."""

    def __init__(
        self,
        structure: StateSpaceStructure,
        packing: Packing,
        data: SampleChunks,
        watch: Watch,
    ) -> None:
        self._program, self._data, self._watch = (structure, packing), data, watch
        self.done = 0

    def costs(self, theta: Array) -> Array:
        """theta (1, K, P) -> (1, K)."""
        with jax.enable_x64(True):
            return np.asarray(_costs(*self._program, self._data, theta[0]))[None]

    def normal(self, theta: Array) -> NormalEquations:
        """At theta (1, P)."""
        with jax.enable_x64(True):
            found = [np.asarray(v) for v in _normal(*self._program, self._data, theta[0])]
        if self.done and self.done % _ITERATIONS_BETWEEN_LOGS == 0:
            self._watch(self.done, float(found[0]))
        self.done += 1
        return NormalEquations(*(value[None] for value in found))


class _Simulation:
    """What the programs have in common."""

    def __init__(
        self, structure: StateSpaceStructure, packing: Packing, data: SampleChunks
    ) -> None:
        self.structure, self.packing, self.data = structure, packing, data

    def initial(self, theta: jax.Array) -> jax.Array:
        """Initial states (R, n)."""
        tree = self.packing.unpack(theta)
        return tree["x0"] if "x0" in tree else jnp.asarray(self.data.x0)

    def step(self, theta: jax.Array, x: jax.Array, u: jax.Array) -> jax.Array:
        """(n,), (nu,) -> next state and output in one vector (n + ny,)."""
        p, structure = self.packing.unpack(theta), self.structure
        state, w = structure.split(p, x, structure.input(p, u))
        return jnp.concatenate([state, structure.output(p, w)])

    def chunk(self, theta: jax.Array, x: jax.Array, part: Any) -> Any:
        """One chunk from x (R, n): the last state, all states (c, R, n), weighted errors
        (c, R, ny)."""
        u, y, weight = part
        n, many = self.structure.order, jax.vmap(self.step, (None, 0, 0))

        def move(x: jax.Array, u: jax.Array) -> Any:
            both = many(theta, x, u)
            return both[:, :n], (x, both[:, n:])

        x, (states, outputs) = jax.lax.scan(move, x, u)
        return x, states, weight[..., None] * (outputs - y)

    @property
    def parts(self) -> Any:
        """The chunks, for `scan`."""
        return self.data.u, self.data.y, self.data.weight


@partial(jax.jit, static_argnums=(0, 1))
def _costs(
    structure: StateSpaceStructure, packing: Packing, data: SampleChunks, thetas: jax.Array
) -> jax.Array:
    """Mean squared errors with ridge (K,) at thetas (K, P)."""
    run = _Simulation(structure, packing, data)

    def cost(theta: jax.Array) -> jax.Array:
        def chunk(carry: Any, part: Any) -> Any:
            x, total = carry
            x, _, error = run.chunk(theta, x, part)
            return (x, total + jnp.sum(error**2)), None

        (_, total), _ = jax.lax.scan(chunk, (run.initial(theta), jnp.zeros(())), run.parts)
        return total + jnp.sum(data.pull * (theta - data.origin) ** 2)

    return jax.vmap(cost)(thetas)


@partial(jax.jit, static_argnums=(0, 1))
def _normal(
    structure: StateSpaceStructure, packing: Packing, data: SampleChunks, theta: jax.Array
) -> Any:
    """Sum of squared errors, J' J and J' e, with those of the ridge."""
    run, n, p = _Simulation(structure, packing, data), structure.order, theta.size
    by_step = jax.jacrev(run.step, argnums=(0, 1))
    derivatives = jax.vmap(jax.vmap(by_step, (None, 0, 0)), (None, 0, 0))

    def chunk(carry: Any, part: Any) -> Any:
        x, s, total, gram, gradient = carry
        x, states, error = run.chunk(theta, x, part)
        by_theta, by_x = derivatives(theta, states, part[0])

        def move(s: jax.Array, at: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            both = at[0] @ s + at[1]
            return both[:, :n], both[:, n:]

        s, sensitivity = jax.lax.scan(move, s, (by_x, by_theta))
        rows = (part[2][..., None, None] * sensitivity).reshape(-1, p)
        e = error.ravel()
        return (x, s, total + e @ e, gram + rows.T @ rows, gradient + rows.T @ e), None

    x0, s0 = run.initial(theta), jax.jacfwd(run.initial)(theta)
    away = theta - data.origin
    # The ridge is a residual of its own.
    ridge = jnp.sum(data.pull * away**2), jnp.diag(data.pull), data.pull * away
    (_, _, *sums), _ = jax.lax.scan(chunk, (x0, s0, *ridge), run.parts)
    return sums
