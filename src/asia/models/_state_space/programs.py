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
# Weight of the stability term, as a share of the error of the linear model.
_STABILITY = 0.01

Watch: TypeAlias = Callable[[int, float], None]
"""Function that receives the number of completed iterations, and the cost after them."""


class StateSamples(NamedTuple):
    """Records or segments side by side."""

    x0: Array  # Initial states (R, n), or starting points of their search unless `known`
    u: Array  # (R, T, nu)
    y: Array  # (R, T, ny)
    weight: Array  # (R, T, ny), 0 in the padding
    known: bool  # The initial states are given


class StabilityTerm(NamedTuple):
    """Cost of a linear part that is unstable: its functions are bounded, so that simulations would
    diverge outside the range of the records.

    The squares of the entries of the power 2^doublings of its matrix: nothing while its free motion
    dies out in so many samples, and beyond all limits where it grows.
    """

    weight: float
    doublings: int

    @classmethod
    def of(cls, a: Array, samples: int, error: float) -> "StabilityTerm | None":
        """Term for a fit that begins with a linear model; None where that is unstable.

        Args:
            a: its matrix (n, n), without integrators.
            samples: number of samples of the records; ten times as many are foreseen.
            error: its mean squared error in z-scores.
        """
        if not np.isfinite(error) or spectral_radius(a) >= 1.0:
            return None
        return cls(_STABILITY * error, int(np.ceil(np.log2(10 * samples))))


def spectral_radius(a: Array) -> float:
    return float(np.abs(np.linalg.eigvals(a)).max(initial=0.0))


class SampleChunks(NamedTuple):
    """Chunks of samples in time order."""

    u: Any  # (K, c, R, nu)
    y: Any  # (K, c, R, ny)
    weight: Any  # (K, c, R, ny), scaled so that the sum of squares is a mean
    x0: Any  # Initial states (R, n)
    pull: Any  # Ridge (P,) of each parameter towards `origin`
    origin: Any  # (P,)
    through: InnovationFilter | None = None
    """Filter of the noise model, (K, c, R, ny) each; None without one."""
    huber: Any = None  # Threshold on the innovations, in the unit of the errors; None without one
    stability: StabilityTerm | None = None


def chunked(
    samples: StateSamples,
    structure: StateSpaceStructure,
    pull: Array,
    origin: Array,
    weighting: ErrorWeighting | None,
) -> SampleChunks:
    count, length = samples.weight.shape[:2]
    known = structure.size * (count - 1) * (not samples.known)
    values = count * (structure.size + structure.ny) * (len(origin) - known)
    size = min(_CHUNK_VALUES // values, length)
    if size < length:
        size = max(1, min(_FEWER_VALUES, _CHUNK_VALUES) // values)
    chunks = -(-length // size)
    total = max(float((samples.weight**2).sum()), 1.0)

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

    def growth(self, theta: jax.Array) -> jax.Array:
        """Residuals of the stability term."""
        term, free = self.data.stability, self.structure.order - self.structure.integrators
        if term is None:
            return jnp.zeros(0)
        a = self.packing.unpack(theta)["a"][:free, :free]
        power = jax.lax.fori_loop(0, term.doublings, lambda _, a: a @ a, a)
        return jnp.sqrt(term.weight) * power.ravel()

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
        return predicted, weight[..., None] * values

    def bent(self, error: jax.Array, part: Any) -> tuple[jax.Array, jax.Array | None]:
        """Transform weighted errors (c, R, ny) so that their square is Huber's loss, with the
        derivatives; without a threshold return them unchanged, and None."""
        if self.data.huber is None:
            return error, None
        threshold = jnp.maximum(self.data.huber * part[2], 1e-30)
        scaled = error / threshold
        root = huber_root(scaled, 1.0)
        slope = jnp.where(abs(scaled) > 1.0, 1.0 / jnp.maximum(abs(root), 1.0), 1.0)
        return threshold * root, slope


@partial(jax.jit, static_argnums=(0, 1))
def _costs(
    structure: StateSpaceStructure, packing: Packing, data: SampleChunks, thetas: jax.Array
) -> jax.Array:
    """Mean squared errors with ridge and stability term (K,) at thetas (K, P)."""
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
        total = total + jnp.sum(run.growth(theta) ** 2)
        return total + jnp.sum(data.pull * (theta - data.origin) ** 2)

    return jax.vmap(cost)(thetas)


@partial(jax.jit, static_argnums=(0, 1))
def _normal(
    structure: StateSpaceStructure, packing: Packing, data: SampleChunks, theta: jax.Array
) -> Any:
    """Sum of squares, J' J and J' e, including the ridge and the stability term.

    A record depends on its own initial state only: its rows of J hold the derivatives by the common
    parameters and by that state.
    """
    run, n, count = _Simulation(structure, packing, data), structure.size, data.y.shape[2]
    own = n if "x0" in packing.unpack(theta) else 0
    p = theta.size - count * own  # The initial states are last

    def step(common: jax.Array, x: jax.Array, u: jax.Array) -> jax.Array:
        return run.step(jnp.concatenate([common, theta[p:]]), x, u)

    by_step = jax.jacrev(step, argnums=(0, 1))
    derivatives = jax.vmap(jax.vmap(by_step, (None, 0, 0)), (None, 0, 0))

    def chunk(carry: Any, part: Any) -> Any:
        x, s, predicted, total, sums = carry
        x, states, error = run.chunk(theta, x, part)
        by_common, by_x = derivatives(theta[:p], states, part[0])

        def move(s: jax.Array, at: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            both = (at[0] @ s).at[..., :p].add(at[1])
            return both[:, :n], both[:, n:]

        s, sensitivity = jax.lax.scan(move, s, (by_x, by_common))
        before = predicted if predicted is None else predicted[..., :1]
        last, error = run.weighed(before, error[..., None], part)
        error, slope = run.bent(error[..., 0], part)
        after = predicted if predicted is None else predicted[..., 1:]
        after, rows = run.weighed(after, sensitivity, part)
        rows = rows if slope is None else slope[..., None] * rows
        if predicted is not None:
            predicted = jnp.concatenate([last, after], axis=-1)
        common, each = rows[..., :p].reshape(-1, p), rows[..., p:]
        found = (
            common.T @ common, common.T @ error.ravel(),
            jnp.einsum("trop,tron->rpn", rows[..., :p], each),
            jnp.einsum("tron,trom->rnm", each, each), jnp.einsum("tron,tro->rn", each, error),
        )  # fmt: skip
        sums = jax.tree.map(jnp.add, sums, found)
        return (x, s, predicted, total + jnp.sum(error**2), sums), None

    by_initial = jnp.concatenate([jnp.zeros((n, p)), jnp.eye(n)[:, :own]], axis=1)
    s0 = jnp.broadcast_to(by_initial, (count, *by_initial.shape))
    shapes = (p, p), (p,), (count, p, own), (count, own, own), (count, own)
    zeros = tuple(jnp.zeros(shape) for shape in shapes)
    begin = run.initial(theta), s0, run.predicted(1 + p + own), jnp.zeros(()), zeros
    (_, _, _, total, sums), _ = jax.lax.scan(chunk, begin, run.parts)
    gram, gradient, cross, inner, side = sums
    cross, record = cross.swapaxes(0, 1).reshape(p, -1), jnp.arange(count)
    blocks = jnp.zeros((count, own, count, own)).at[record, :, record, :].set(inner)
    gram = jnp.block([[gram, cross], [cross.T, blocks.reshape(2 * (count * own,))]])
    gradient = jnp.concatenate([gradient, side.ravel()])
    # The stability term and the ridge have residuals of their own.
    growth, rows, away = run.growth(theta), jax.jacfwd(run.growth)(theta), theta - data.origin
    total = total + growth @ growth + jnp.sum(data.pull * away**2)
    gram = gram + rows.T @ rows + jnp.diag(data.pull)
    return total, gram, gradient + rows.T @ growth + data.pull * away
