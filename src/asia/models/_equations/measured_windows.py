"""Grey-box fits whose initial states are measured: no state is estimated, so many short windows
cost no more unknowns than one."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.simulate import Scales, prior_residuals, simulate_states
from asia.models._equations.starts import RecordPieces, Starts
from asia.models._solvers.levenberg_marquardt import (
    LevenbergMarquardt,
    LMResult,
    Normal,
    advance,
    finite_cost,
    initial_state,
    normal_from_sums,
    value_and_jacobian,
)

# Numbers in the derivatives of one chunk of segments.
_CHUNK_VALUES = 1_000_000


@lru_cache(maxsize=64)
def measured_fitter(structure: GreyBoxStructure, method: LevenbergMarquardt, residual: Any) -> Any:
    """Compiled fit from `Starts.x_guess`: (starts, segments, active) -> LMResult, one row a start.

    residual(structure, start, segments, theta, i): errors of segment i (T ny,), theta (size + nx,)
    ending in the shift of its initial state.
    """
    nx = structure.nx

    def one(start: Starts, segments: RecordPieces, active: jax.Array) -> LMResult:
        # JAX keeps the shapes of a traced array.
        values = segments.y.shape[1] * structure.ny * max(structure.layout.size, 1)
        count = segments.y.shape[0]
        size = int(np.clip(_CHUNK_VALUES // values, 1, count))
        order = jnp.arange(-(-count // size) * size).reshape(-1, size)

        def errors(z: jax.Array, rows: jax.Array) -> jax.Array:
            own = jnp.concatenate([z, jnp.zeros(nx)])
            many = jax.vmap(lambda i: residual(structure, start, segments, own, i))
            return (many(rows % count) * (rows < count)[:, None]).ravel()

        def prior(z: jax.Array) -> jax.Array:
            return active * prior_residuals(structure, z)

        def cost(z: jax.Array) -> jax.Array:
            parts = jax.lax.map(lambda rows: jnp.sum(errors(z, rows) ** 2), order)
            return finite_cost(jnp.sum(parts) + jnp.sum(prior(z) ** 2))

        def normal(z: jax.Array) -> Normal:
            def sums(function: Any) -> Any:
                e, jacobian = value_and_jacobian(function, z)
                jacobian = jacobian * active
                return e @ e, jacobian.T @ jacobian, jacobian.T @ e

            def add(total: Any, rows: jax.Array) -> Any:
                return jax.tree.map(jnp.add, total, sums(lambda z: errors(z, rows))), None

            total, _ = jax.lax.scan(add, sums(prior), order)
            return normal_from_sums(*total)

        z0 = jnp.asarray(start.z)
        known = None if method.iterations else cost(z0)
        found = advance(cost, normal, initial_state(z0, method, known), method).result
        return found._replace(theta=jnp.concatenate([found.theta, start.shift.ravel()]))

    return jax.jit(jax.vmap(one, in_axes=(0, None, None)))


@lru_cache(maxsize=64)
def measured_simulator(structure: GreyBoxStructure) -> Any:
    """Compiled simulate: (z, scales, past_u, past_y, u), batch first -> y_hat, from the state that
    the last past outputs are. Without past inputs the first future one is held back."""

    def one(
        z: jax.Array, scales: Scales, past_u: jax.Array, past_y: jax.Array, u: jax.Array
    ) -> jax.Array:
        output = structure.measured_states
        x0 = jnp.stack([past_y[-1, output[i]] for i in range(structure.nx)])
        before = past_u[-1:] if structure.n_past_u else u[:1]
        y, _ = simulate_states(structure, scales, z, x0, jnp.concatenate([before, u]))
        return y[1:]

    return jax.jit(jax.vmap(one, in_axes=(None, None, 0, 0, 0)))
