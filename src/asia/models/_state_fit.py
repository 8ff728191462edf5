"""Levenberg-Marquardt on the simulation error of a neural state-space model.

The Jacobian comes from the sensitivity equations: derivatives of one step are taken by reverse
differentiation at all samples at once, and only the product of state Jacobians runs through time.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from asia.models._lm import LevenbergMarquardt, LMResult, levenberg_marquardt
from asia.models._records import Record
from asia.models._structure import Structure
from asia.problem import Array


class Data(NamedTuple):
    """Padded records: u (R, T, nu), y (R, T, ny), weight (R, T), scaled so that the sum of
    squares is a mean; pull (P,): roots of the ridge of each parameter towards its start."""

    u: Any
    y: Any
    weight: Any
    pull: Any


class StateFit(NamedTuple):
    """Initial states x0 (R, n), parameters, cost, and the root of the cost by iteration."""

    x0: Array
    params: dict[str, Any]
    cost: float
    history: Array


def padded(records: Sequence[Record]) -> tuple[Array, Array, Array]:
    """u, y, weight of all records, padded with zeros to the longest."""
    longest = max(len(r) for r in records)

    def pad(values: Array) -> Array:
        return np.pad(values, [(0, longest - len(values))] + [(0, 0)] * (values.ndim - 1))

    u, y, weight = (
        np.stack([pad(getattr(r, name)) for r in records]) for name in ("u", "y", "weight")
    )
    return u, y, weight


def fit_states(
    structure: Structure,
    starts: Sequence[dict[str, Any]],
    x0: Array,
    records: Sequence[Record],
    ridge: dict[str, float],
    method: LevenbergMarquardt,
) -> list[StateFit]:
    """A fit from each start, the least cost first. `ridge` maps each top-level parameter name,
    and "x0", to its ridge."""
    u, y, weight = padded(records)
    total = max(float((weight**2).sum()) * y.shape[-1], 1.0)
    results: list[StateFit] = []
    for start in starts:
        tree = {**start, "x0": x0}
        pull = {
            name: jax.tree.map(lambda v, r=ridge[name]: np.full(np.shape(v), np.sqrt(r)), value)
            for name, value in tree.items()
        }
        theta, unravel = _flat(tree)
        data = Data(u, y, weight / np.sqrt(total), _flat(pull)[0])
        with jax.enable_x64(True):
            result = _minimise(structure, method, _shapes(tree), theta, data)
            best = jax.tree.map(np.asarray, unravel(result.theta))
        history = np.sqrt(np.asarray(result.history))[: int(result.iterations) + 1]
        results.append(StateFit(best.pop("x0"), best, float(result.cost), history))
    return sorted(results, key=lambda r: r.cost)


def _flat(tree: Any) -> tuple[Any, Any]:
    with jax.enable_x64(True):
        flat, unravel = ravel_pytree(jax.tree.map(lambda v: jnp.asarray(v, jnp.float64), tree))
        return np.asarray(flat), unravel


class _Shapes(NamedTuple):
    """Hashable recipe of a tree of arrays."""

    treedef: Any
    shapes: tuple[tuple[int, ...], ...]

    def tree(self, theta: jax.Array) -> Any:
        sizes = [int(np.prod(s)) for s in self.shapes]
        parts = jnp.split(theta, np.cumsum(sizes)[:-1])
        leaves = [p.reshape(s) for p, s in zip(parts, self.shapes, strict=True)]
        return jax.tree.unflatten(self.treedef, leaves)


def _shapes(tree: Any) -> _Shapes:
    leaves, treedef = jax.tree.flatten(tree)
    return _Shapes(treedef, tuple(np.shape(v) for v in leaves))


@partial(jax.jit, static_argnums=(0, 1, 2))
def _minimise(
    structure: Structure, method: LevenbergMarquardt, shapes: _Shapes, theta0: Any, data: Data
) -> LMResult:
    n = structure.order

    def step(theta: Any, x: jax.Array, u: jax.Array) -> jax.Array:
        """(n,), (nu,) -> next state and output in one vector (n + ny,)."""
        p = shapes.tree(theta)
        state, w = structure.split(jnp, p, x, structure.input(jnp, p, u))
        return jnp.concatenate([state, structure.output(jnp, p, w)])

    def simulate(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
        many = jax.vmap(step, (None, 0, 0))

        def advance(x: jax.Array, u: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
            both = many(theta, x, u)
            return both[:, :n], (x, both[:, n:])

        _, (x, y) = jax.lax.scan(advance, shapes.tree(theta)["x0"], jnp.swapaxes(data.u, 0, 1))
        return x, jnp.swapaxes(y, 0, 1)

    def errors(theta: jax.Array, y: jax.Array) -> jax.Array:
        misfit = data.weight[..., None] * (y - data.y)
        return jnp.concatenate([misfit.ravel(), data.pull * (theta - theta0)])

    def residual(theta: jax.Array) -> jax.Array:
        return errors(theta, simulate(theta)[1])

    def linearised(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
        x, y = simulate(theta)
        derivatives = jax.vmap(
            jax.vmap(jax.jacrev(step, argnums=(0, 1)), (None, 0, 0)), (None, 0, 0)
        )
        by_theta, by_x = derivatives(theta, x, jnp.swapaxes(data.u, 0, 1))

        def advance(s: jax.Array, at: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            both = at[0] @ s + at[1]
            return both[:, :n], both[:, n:]

        s0 = jax.jacfwd(lambda t: shapes.tree(t)["x0"])(theta)
        _, sensitivity = jax.lax.scan(advance, s0, (by_x, by_theta))
        weighted = data.weight[..., None, None] * jnp.swapaxes(sensitivity, 0, 1)
        jacobian = jnp.concatenate([weighted.reshape(-1, theta.size), jnp.diag(data.pull)])
        return errors(theta, y), jacobian

    return levenberg_marquardt(residual, theta0, method, linearised)
