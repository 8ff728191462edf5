"""Costs and normal equations of a neural state-space model, as compiled programs.

The Jacobian comes from the sensitivity equations: derivatives of one step are taken by reverse
differentiation at many samples at once, and only the product of state Jacobians runs through time.
It is never stored as a whole: its products are summed chunk by chunk, so that memory does not grow
with the length of the records.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from asia.data.trajectory import Array
from asia.models._arrays import Packing
from asia.models._least_squares import NormalEquations
from asia.models._noise.model import ErrorWeighting, InnovationFilter, huber_root
from asia.models._numerics.training_records import padded
from asia.models._state_space.structure import StateSpaceStructure

# Limits on the numbers in the derivatives of one chunk, and of each of several chunks.
_CHUNK_VALUES, _FEWER_VALUES = 4_000_000, 400_000
_ITERATIONS_BETWEEN_LOGS = 5

Watch: TypeAlias = Callable[[int, float], None]
"""Function that receives the number of completed iterations, and the cost after them."""


class StateSamples(NamedTuple):
    """Records or segments side by side."""

    x0: Array  # Initial states (R, n), or starting points of their search unless `known`
    u: Array  # (R, T, nu)
    y: Array  # (R, T, ny)
    weight: Array  # (R, T), 0 in the padding
    known: bool  # The initial states are given


class SampleChunks(NamedTuple):
    """Chunks of samples in time order."""

    u: Any  # (K, c, R, nu)
    y: Any  # (K, c, R, ny)
    weight: Any  # (K, c, R), scaled so that the sum of squares is a mean
    x0: Any  # Initial states (R, n)
    pull: Any  # Ridge (P,) of each parameter towards `origin`
    origin: Any  # (P,)
    through: InnovationFilter | None = None
    """Filter of the noise model, (K, c, R, ny) each; None without one."""
    huber: Any = None  # Threshold on the innovations, in the unit of the errors; None without one


def chunked(
    samples: StateSamples,
    structure: StateSpaceStructure,
    pull: Array,
    origin: Array,
    weighting: ErrorWeighting | None,
) -> SampleChunks:
    count, length = samples.weight.shape
    values = count * (structure.size + structure.ny) * len(origin)
    size = min(_CHUNK_VALUES // values, length)
    if size < length:
        size = max(1, min(_FEWER_VALUES, _CHUNK_VALUES) // values)
    chunks = -(-length // size)
    total = max(float((samples.weight**2).sum()) * structure.ny, 1.0)

    def cut(array: Array) -> Array:
        timed = np.swapaxes(array, 0, 1)
        return padded(timed, chunks * size).reshape(chunks, size, *timed.shape[1:])

    u, y, weight = cut(samples.u), cut(samples.y), cut(samples.weight / np.sqrt(total))
    plain = SampleChunks(u, y, weight, samples.x0, pull, origin)
    if weighting is None:
        return plain
    decay, gain, scale = (cut(values) for values in weighting.through)
    huber = None if weighting.huber is None else weighting.huber * weighting.unit
    through = InnovationFilter(decay, gain, weighting.unit * scale)
    return plain._replace(through=through, huber=huber)


class CompiledEquations:
    """Costs and normal equations of one fit, for `minimise`."""

    def __init__(
        self, structure: StateSpaceStructure, packing: Packing, data: SampleChunks, watch: Watch
    ) -> None:
        self._program, self._data, self._watch = (structure, packing), data, watch
        self.done = 0

    def costs(self, theta: Array) -> Array:
        """Costs at theta (1, K, P) -> (1, K)."""
        with jax.enable_x64(True):
            return np.asarray(_costs(*self._program, self._data, theta[0]))[None]

    def normal(self, theta: Array) -> NormalEquations:
        """Normal equations at theta (1, P)."""
        with jax.enable_x64(True):
            found = [np.asarray(v) for v in _normal(*self._program, self._data, theta[0])]
        if self.done and self.done % _ITERATIONS_BETWEEN_LOGS == 0:
            self._watch(self.done, float(found[0]))
        self.done += 1
        return NormalEquations(*(value[None] for value in found))


class _Simulation:
    """Simulation of chunks, common to the programs."""

    def __init__(
        self, structure: StateSpaceStructure, packing: Packing, data: SampleChunks
    ) -> None:
        self.structure, self.packing, self.data = structure, packing, data
        self.parts = data.u, data.y, data.weight, data.through

    def initial(self, theta: jax.Array) -> jax.Array:
        """Initial states (R, n)."""
        tree = self.packing.unpack(theta)
        return tree["x0"] if "x0" in tree else jnp.asarray(self.data.x0)

    def step(self, theta: jax.Array, x: jax.Array, u: jax.Array) -> jax.Array:
        """Map (n,), (nu,) to next state and output in one vector (n + ny,)."""
        p, structure = self.packing.unpack(theta), self.structure
        state, w = structure.split(p, x, structure.input(p, u))
        return jnp.concatenate([state, structure.output(p, w)])

    def chunk(self, theta: jax.Array, x: jax.Array, part: Any) -> Any:
        """Simulate a chunk from x (R, n): the last state, all states (c, R, n), errors (c, R,
        ny)."""
        u, y = part[:2]
        n, many = self.structure.size, jax.vmap(self.step, (None, 0, 0))

        def move(x: jax.Array, u: jax.Array) -> Any:
            both = many(theta, x, u)
            return both[:, :n], (x, both[:, n:])

        x, (states, outputs) = jax.lax.scan(move, x, u)
        return x, states, outputs - y

    def predicted(self, columns: int) -> jax.Array | None:
        """Initial prediction of the noise model, for so many columns of errors."""
        if self.data.through is None:
            return None
        return jnp.zeros((*self.data.y.shape[2:], columns))

    def weighed(self, predicted: Any, values: jax.Array, part: Any) -> tuple[Any, jax.Array]:
        """Whiten and weigh columns of errors (c, R, ny, P); return the filter's last state too."""
        weight, through = part[2], part[3]
        if through is not None:

            def move(predicted: jax.Array, at: Any) -> tuple[jax.Array, jax.Array]:
                value, decay, gain = at
                after = decay[..., None] * predicted + gain[..., None] * value
                return after, value - predicted

            known = values, through.decay, through.gain
            predicted, values = jax.lax.scan(move, predicted, known)
            values = through.weight[..., None] * values
        return predicted, weight[..., None, None] * values

    def bent(self, error: jax.Array, part: Any) -> tuple[jax.Array, jax.Array | None]:
        """Transform weighted errors (c, R, ny) so that their square is Huber's loss, with the
        derivatives; without a threshold return them unchanged, and None."""
        if self.data.huber is None:
            return error, None
        threshold = jnp.maximum(self.data.huber * part[2][..., None], 1e-30)
        scaled = error / threshold
        root = huber_root(scaled, 1.0)
        slope = jnp.where(abs(scaled) > 1.0, 1.0 / jnp.maximum(abs(root), 1.0), 1.0)
        return threshold * root, slope


@partial(jax.jit, static_argnums=(0, 1))
def _costs(
    structure: StateSpaceStructure, packing: Packing, data: SampleChunks, thetas: jax.Array
) -> jax.Array:
    """Mean squared errors with ridge (K,) at thetas (K, P)."""
    run = _Simulation(structure, packing, data)

    def cost(theta: jax.Array) -> jax.Array:
        def chunk(carry: Any, part: Any) -> Any:
            x, total, predicted = carry
            x, _, error = run.chunk(theta, x, part)
            predicted, error = run.weighed(predicted, error[..., None], part)
            error, _ = run.bent(error[..., 0], part)
            return (x, total + jnp.sum(error**2), predicted), None

        start = run.initial(theta), jnp.zeros(()), run.predicted(1)
        (_, total, _), _ = jax.lax.scan(chunk, start, run.parts)
        return total + jnp.sum(data.pull * (theta - data.origin) ** 2)

    return jax.vmap(cost)(thetas)


@partial(jax.jit, static_argnums=(0, 1))
def _normal(
    structure: StateSpaceStructure, packing: Packing, data: SampleChunks, theta: jax.Array
) -> Any:
    """Sum of squared errors, J' J and J' e, including the ridge."""
    run, n, p = _Simulation(structure, packing, data), structure.size, theta.size
    by_step = jax.jacrev(run.step, argnums=(0, 1))
    derivatives = jax.vmap(jax.vmap(by_step, (None, 0, 0)), (None, 0, 0))

    def chunk(carry: Any, part: Any) -> Any:
        x, s, predicted, total, gram, gradient = carry
        x, states, error = run.chunk(theta, x, part)
        by_theta, by_x = derivatives(theta, states, part[0])

        def move(s: jax.Array, at: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            both = at[0] @ s + at[1]
            return both[:, :n], both[:, n:]

        s, sensitivity = jax.lax.scan(move, s, (by_x, by_theta))
        before = predicted if predicted is None else predicted[..., :1]
        last, error = run.weighed(before, error[..., None], part)
        error, slope = run.bent(error[..., 0], part)
        after = predicted if predicted is None else predicted[..., 1:]
        after, rows = run.weighed(after, sensitivity, part)
        rows = rows if slope is None else slope[..., None] * rows
        rows, e = rows.reshape(-1, p), error.ravel()
        if predicted is not None:
            predicted = jnp.concatenate([last, after], axis=-1)
        sums = total + e @ e, gram + rows.T @ rows, gradient + rows.T @ e
        return (x, s, predicted, *sums), None

    x0, s0 = run.initial(theta), jax.jacfwd(run.initial)(theta)
    away = theta - data.origin
    # The ridge is a residual of its own.
    ridge = jnp.sum(data.pull * away**2), jnp.diag(data.pull), data.pull * away
    (_, _, _, *sums), _ = jax.lax.scan(chunk, (x0, s0, run.predicted(1 + p), *ridge), run.parts)
    return sums
