"""Identified models of a plant as the design of a controller needs them: at rest, linear, and in
many closed loops at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from asia.candidate import Context, StepModel
from asia.data.trajectory import Array, deviations
from asia.lowering.linear import LinearModel
from asia.models._arrays import AnyArray, namespace
from asia.problem.control_task import ControlTask

# Longest settling in samples, and blocks of it after which rest is looked for.
_SETTLING, _BLOCK = 4_000, 200
_STILL = 1e-4
# Change of an input in a response, of its range, and samples of the response.
_CHANGE, _RESPONSE = 0.02, 400
# Hankel singular values below this share of the largest one belong to no state.
_NEGLIGIBLE, _MOST_STATES = 2e-3, 8
_NEWTON = 12
# Load at the inputs in simulated loops, of their ranges: what no model knows is like one.
_LOAD = 0.05
_DIVERGED = 1e3


class Law(Protocol):
    """Control law for many loops at once, for NumPy and JAX; a row is one loop."""

    @property
    def rows(self) -> tuple[Array, ...]:
        """Parameters, each with the loops first, or one row for all of them."""
        ...

    def with_rows(self, rows: tuple[AnyArray, ...]) -> Law:
        """Return the law with other parameters."""
        ...

    def start(self, y: AnyArray) -> Any:
        """State before the first sample, whose outputs are y (rows, ny)."""
        ...

    def step(self, state: Any, r: AnyArray, y: AnyArray) -> tuple[Any, AnyArray]:
        """Next state and inputs (rows, nu) from set points (rows, nr) and outputs (rows, ny)."""
        ...


@dataclass(frozen=True)
class InputLimits:
    """Limits of all inputs as arrays (nu,)."""

    low: Array
    high: Array
    most: Array
    """Largest change from sample to sample."""
    start: Array

    @classmethod
    def of(cls, context: Context) -> InputLimits:
        """Return the limits of a context."""
        each = task_of(context).actuators
        return cls(
            np.array([a.min for a in each]), np.array([a.max for a in each]),
            np.array([a.rate for a in each]) * context.sampling_time,
            np.array([a.start for a in each]),
        )  # fmt: skip

    def __call__(self, wanted: AnyArray, last: AnyArray) -> AnyArray:
        """Return what the plant gets (rows, nu)."""
        xp = namespace(wanted)
        u = xp.clip(xp.nan_to_num(wanted), self.low, self.high)
        return xp.clip(u, last - self.most, last + self.most)


def task_of(context: Context) -> ControlTask:
    """Return the task of a context.

    Raises:
        ValueError: for a problem without one
    """
    if context.control is None:
        raise ValueError("controllers: the problem has no [control]")
    return context.control


@dataclass(frozen=True)
class PlantModel:
    """One identified model."""

    model: StepModel
    context: Context

    @cached_property
    def rest(self) -> tuple[Any, Array]:
        """State (1, ...) and outputs (ny,) at rest with the inputs at their start."""
        state, y = self.settle(InputLimits.of(self.context).start[None])
        return first_row(state), y[0]

    @cached_property
    def _block(self) -> Callable[[Any, Array], tuple[Any, Array]]:
        """Compiled responses (N, B, ny) over a block of samples to constant inputs (B, nu)."""
        import jax

        def block(state: Any, u: Any) -> tuple[Any, Any]:
            return jax.lax.scan(lambda x, _: self.model.step(x, u), state, None, length=_BLOCK)

        return jax.jit(block)

    def settle(self, u: Array) -> tuple[Any, Array]:
        """State and outputs (B, ny) at rest with constant inputs (B, nu); up to 2 nu + 1 of them.

        The state has more rows, so that all calls are one program.
        """
        import jax

        context, rows = self.context, 2 * u.shape[1] + 1
        records = np.concatenate([r.y for r in task_of(context).records])
        wide = np.concatenate([u, np.repeat(u[-1:], rows - len(u), axis=0)])
        past_u = np.repeat(wide[:, None], context.n_past_u, axis=1)
        past_y = np.tile(records.mean(axis=0), (rows, context.n_past_y, 1))
        scale, before = deviations(records), past_y[:, 0]
        y = before
        with jax.enable_x64(True):
            state = jax.tree.map(np.asarray, self.model.initial(past_u, past_y, wide))
            for _ in range(_SETTLING // _BLOCK):
                state, found = self._block(state, wide)
                y = np.asarray(found[-1], np.float64)
                if not np.isfinite(y).all() or np.abs((y - before) / scale).max() < _STILL:
                    break
                before = y
        return state, y[: len(u)]

    def inputs_at(self, r: Array) -> Array:
        """Constant inputs (nu,) within their limits that hold the controlled outputs nearest to
        r (nr,), by Newton's method."""
        limits, places = InputLimits.of(self.context), list(task_of(self.context).controlled)
        span = limits.high - limits.low
        change = _CHANGE * span
        u, scale = limits.start.copy(), np.array(task_of(self.context).tolerance)[: len(places)]
        best = np.inf, u
        for _ in range(_NEWTON):
            # Toward the inside of the limits.
            way = np.where(u + change > limits.high, -change, change)
            _, y = self.settle(np.concatenate([u[None], u + np.diag(way)]))
            error = (y[0, places] - r) / scale
            if not np.isfinite(y).all():
                break
            size = float(np.abs(error).max())
            best = min(best, (size, u), key=lambda one: one[0])
            if size < 1e-3:
                break
            slope = (y[1:, places] - y[0, places]).T / way / scale[:, None]
            step = np.asarray(np.linalg.lstsq(slope, -error, rcond=1e-6)[0], np.float64)
            step *= min(1.0, 0.5 / max(float(np.abs(step / span).max()), 1e-12))
            u = np.clip(u + step, limits.low + 1e-3 * span, limits.high - 1e-3 * span)
        return best[1]

    def linear_at(self, u: Array) -> LinearModel:
        """Linear model at rest with inputs u (nu,), from its responses to small changes (Juang and
        Pappa, J. Guidance 8, 1985). The input of a sample acts on the output of the next one."""
        import jax

        limits = InputLimits.of(self.context)
        change, nu = _CHANGE * (limits.high - limits.low), len(u)
        rows = np.concatenate([u + np.diag(change), u - np.diag(change), u[None]])
        state, y0 = self.settle(np.repeat(u[None], len(rows), axis=0))
        found: list[Array] = []
        with jax.enable_x64(True):
            for _ in range(_RESPONSE // _BLOCK):
                state, y = self._block(state, rows)
                found.append(np.asarray(y, np.float64))
        y = np.concatenate(found)
        steps = (y[:, :nu] - y[:, nu : 2 * nu]) / (2.0 * change[:, None])  # (N, nu, ny)
        # What comes with its own sample is seen with the next one too.
        markov = np.diff(steps, axis=0, prepend=0.0).swapaxes(1, 2)  # (N, ny, nu)
        if np.abs(markov[0]).max() < 1e-9 * np.abs(markov).max():
            markov = markov[1:]
        return _realised(markov, self.context.sampling_time, u, y0[-1])


def _realised(markov: Array, sampling_time: float, u0: Array, y0: Array) -> LinearModel:
    """Balanced realisation of Markov parameters (N, ny, nu), the first of which is C B."""
    count, ny, nu = markov.shape
    size = count // 2
    rows = [np.concatenate(list(markov[k : k + size]), axis=1) for k in range(size)]
    hankel = np.concatenate(rows, axis=0)
    left, values, right = np.linalg.svd(hankel, full_matrices=False)
    n = min(max(int((values > _NEGLIGIBLE * values[0]).sum()), 1), _MOST_STATES)
    root = np.sqrt(values[:n])
    observe, reach = left[:, :n] * root, root[:, None] * right[:n]
    shifted = np.linalg.lstsq(observe[:-ny], observe[ny:], rcond=None)[0]
    return LinearModel(
        np.asarray(shifted, np.float64), reach[:, :nu], observe[:ny], np.zeros((ny, nu)),
        sampling_time, u0, y0,
    )  # fmt: skip


def first_row(state: Any) -> Any:
    """First row of a state, which is a tree of arrays with the batch first."""
    import jax

    return jax.tree.map(lambda leaf: np.asarray(leaf)[:1], state)


def plant_models(models: Sequence[StepModel], context: Context) -> list[PlantModel]:
    """Return the models that are at rest somewhere; the first is that of all records.

    Raises:
        ValueError: where there is none
    """
    found = [PlantModel(one, context) for one in models]
    sound = [one for one in found if np.isfinite(one.rest[1]).all()]
    if not sound:
        raise ValueError("controllers: no identified model is stable at the start inputs")
    return sound


def simulated_cost(
    plants: Sequence[PlantModel], law: Law, context: Context
) -> Callable[[tuple[Array, ...]], Array]:
    """Compile the cost of control laws in the training scenarios, with changes of the load at the
    inputs in place of the disturbances, which no model knows; the worst of the models counts.

    Args:
        law: any law of the kind

    Returns:
        Function from the parameters of P laws, each (P, ...), to their costs (P,).
    """
    import jax
    import jax.numpy as jnp

    task, limits = task_of(context), InputLimits.of(context)
    nr, ny, nu = len(task.setpoints), len(context.outputs), len(limits.low)
    tolerance, places, scenarios = np.array(task.tolerance), list(task.controlled), task.scenarios
    length, count = min(map(len, scenarios)), len(scenarios)
    targets = np.stack([s.u[:length, :nr] for s in scenarios], axis=1)  # (T, S, nr)
    random = np.random.default_rng(0)
    noise = random.standard_normal((length, count, ny)) * np.array(task.noise)
    load = np.zeros((length, count, nu))
    for k in range(count):
        when = int(random.uniform(0.3, 0.7) * length)
        load[when:, k] = _LOAD * (limits.high - limits.low) * random.choice([-1.0, 1.0])
    power = 1 if task.metric == "mae" else 2
    parts = len(plants)

    def cost(rows: tuple[Any, ...], starts: Any) -> Any:
        total = len(rows[0])
        each = total * count
        wide = [jnp.tile(jnp.repeat(row, count, axis=0), (parts,) + (1,) * (row.ndim - 1))
                for row in rows]  # fmt: skip
        loops = law.with_rows(tuple(wide))
        states = [jax.tree.map(lambda leaf: jnp.repeat(leaf, each, axis=0), s) for s, _ in starts]
        y = jnp.concatenate([jnp.tile(one, (each, 1)) for _, one in starts])
        u = jnp.tile(jnp.asarray(limits.start), (parts * each, 1))

        def sample(carry: Any, given: Any) -> tuple[Any, None]:
            memory, states, y, u, sums = carry
            r, v, d = (jnp.tile(one, (parts * total, 1)) for one in given)
            memory, wanted = loops.step(memory, r, y + v)
            before, u = u, limits(wanted, u)
            after, found = list[Any](), list[Any]()
            for m, plant in enumerate(plants):
                own = slice(m * each, (m + 1) * each)
                state, one = plant.model.step(states[m], (u + d)[own])
                after.append(state)
                found.append(one)
            y = jnp.nan_to_num(jnp.concatenate(found), nan=1e6, posinf=1e6, neginf=-1e6)
            error = jnp.concatenate([y[:, places] - r, u - before], axis=1) / tolerance
            sums = sums + jnp.minimum(jnp.abs(error), _DIVERGED) ** power
            return (memory, after, y, u, sums), None

        begin = loops.start(y), states, y, u, jnp.zeros((parts * each, nr + nu))
        (*_, sums), _ = jax.lax.scan(sample, begin, (targets, noise, load))
        pooled = sums.reshape(parts, total, count, -1).mean(axis=2) / length
        return (pooled ** (1.0 / power)).mean(axis=2).max(axis=0)

    compiled, starts = jax.jit(cost), [plant.rest for plant in plants]

    def costs(rows: tuple[Array, ...]) -> Array:
        with jax.enable_x64(True):
            return np.asarray(compiled(rows, starts), np.float64)

    return costs


def searched(
    plants: Sequence[PlantModel],
    make: Callable[[Array], Law],
    bounds: Sequence[tuple[float, float]],
    context: Context,
    *,
    generations: int,
    population: int,
    near: float | None = None,
) -> Array:
    """Parameters (n,) of the law that costs least in simulation, by differential evolution (Storn
    and Price, J. Global Optim. 11, 1997).

    Args:
        near: standard deviation of the first population around 0, which is its first member; None
            for one that fills the bounds.
    """
    from scipy.optimize import differential_evolution

    begin: Any = "sobol"
    if near is not None:
        random = np.random.default_rng(context.seed)
        begin = near * random.standard_normal((max(population, 5), len(bounds)))
        begin[0] = 0.0
    middle = np.array([0.5 * (low + high) for low, high in bounds])
    costs = simulated_cost(plants, make(middle[None]), context)
    found = differential_evolution(
        lambda z: costs(make(np.ascontiguousarray(z.T)).rows),
        list(bounds),
        maxiter=generations,
        popsize=max(population // len(bounds), 1),
        tol=1e-3 if near is None else 0.0,
        rng=np.random.default_rng(context.seed),
        polish=False,
        init=begin,
        vectorized=True,
        updating="deferred",
        callback=lambda intermediate_result: context.log(
            float(intermediate_result.nit), float(intermediate_result.fun)
        ),
    )
    return np.asarray(found.x, np.float64)
