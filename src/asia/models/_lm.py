"""Levenberg-Marquardt for models with few parameters, in JAX float64."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

Residual = Callable[[jax.Array], jax.Array]
Linearised = Callable[[jax.Array], tuple[jax.Array, jax.Array]]

# Dampings tried side by side in one iteration: one Jacobian then nearly always yields a step.
_TRIALS = (0.1, 1.0, 10.0, 100.0)


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Training method: damped Gauss-Newton on the simulation error.

    iterations: greatest number of Jacobians; starts: number of starting points of a family that
    can be started from several; damping: first damping, relative to the scaled normal matrix;
    tolerance: relative decrease of the cost below which it stops.
    Source: Marquardt, SIAM J. Appl. Math. 11 (1963).
    """

    iterations: int = 50
    starts: int = 1
    damping: float = 1e-2
    tolerance: float = 1e-9

    def __post_init__(self) -> None:
        if self.iterations < 0 or self.starts < 1:
            raise ValueError("LevenbergMarquardt: iterations must be >= 0 and starts >= 1")
        if self.damping <= 0 or self.tolerance < 0:
            raise ValueError("LevenbergMarquardt: damping must be > 0 and tolerance >= 0")


class LMResult(NamedTuple):
    """Minimiser theta (n,), its cost (sum of squared residuals), the iterations done and the
    cost after each of them, history (iterations + 1,), held constant once it has stopped."""

    theta: jax.Array
    cost: jax.Array
    iterations: jax.Array
    history: jax.Array


class _State(NamedTuple):
    theta: jax.Array
    cost: jax.Array
    damping: jax.Array
    iteration: jax.Array
    done: jax.Array
    history: jax.Array


def _cost(residual: jax.Array) -> jax.Array:
    cost = jnp.sum(residual**2)
    return jnp.where(jnp.isfinite(cost), cost, jnp.inf)


def _steps(jacobian: jax.Array, residual: jax.Array, dampings: jax.Array) -> jax.Array:
    """Steps (trials, n) for several dampings, with Marquardt's column scaling."""
    scale = jnp.sqrt(jnp.sum(jacobian**2, axis=0))
    scale = jnp.where(scale > 0, scale, 1.0)
    scaled = jacobian / scale
    normal = scaled.T @ scaled
    gradient = scaled.T @ residual
    identity = jnp.eye(normal.shape[0], dtype=normal.dtype)

    def step(damping: jax.Array) -> jax.Array:
        factor = jax.scipy.linalg.cho_factor(normal + damping * identity, lower=True)
        return -jax.scipy.linalg.cho_solve(factor, gradient) / scale

    return jax.vmap(step)(dampings)


def levenberg_marquardt(
    residual: Residual,
    theta0: jax.Array,
    method: LevenbergMarquardt,
    linearised: Linearised | None = None,
) -> LMResult:
    """Minimise the sum of squares of `residual(theta)` from theta0 (n,).

    Can be traced, so it runs under `jax.jit` and under `jax.vmap` over starting points; it
    computes in float64 whatever the caller's default. `linearised(theta)` may give the residuals
    and their Jacobian (m, n) when its structure makes them cheaper than forward differentiation.
    A step that does not lower the cost, or leads to values that are not finite, is refused: the
    cost never rises. `method.starts` is the caller's affair.
    """

    def forward(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
        def both(t: jax.Array) -> tuple[jax.Array, jax.Array]:
            value = residual(t)
            return value, value

        jacobian, value = jax.jacfwd(both, has_aux=True)(theta)
        return value, jacobian

    with jax.enable_x64(True):
        start = jnp.asarray(theta0, dtype=jnp.float64)
        return _minimise(residual, linearised or forward, start, method)


def _minimise(
    residual: Residual, linearised: Linearised, theta0: jax.Array, method: LevenbergMarquardt
) -> LMResult:
    trials = jnp.asarray(_TRIALS)

    def unfinished(state: _State) -> jax.Array:
        return (state.iteration < method.iterations) & ~state.done

    def iterate(state: _State) -> _State:
        value, jacobian = linearised(state.theta)
        before = _cost(value)
        history = jnp.where(state.iteration == 0, before, state.history)
        dampings = state.damping * trials
        candidates = state.theta + _steps(jacobian, value, dampings)
        costs = jax.vmap(lambda theta: _cost(residual(theta)))(candidates)
        best = jnp.argmin(costs)
        better = costs[best] < before
        cost = jnp.where(better, costs[best], before)
        damping = jnp.where(better, dampings[best] * 0.3, dampings[-1] * 10.0)
        small = better & (before - cost <= method.tolerance * before)
        iteration = state.iteration + 1
        return _State(
            theta=jnp.where(better, candidates[best], state.theta),
            cost=cost,
            damping=jnp.maximum(damping, 1e-12),
            iteration=iteration,
            done=small | (damping > 1e12) | (cost == 0.0),
            history=jnp.where(jnp.arange(method.iterations + 1) >= iteration, cost, history),
        )

    # The first linearisation gives the first cost: compiling the residual once more is dear.
    unknown = jnp.asarray(jnp.inf) if method.iterations else _cost(residual(theta0))
    state = jax.lax.while_loop(
        unfinished,
        iterate,
        _State(
            theta=theta0,
            cost=unknown,
            damping=jnp.asarray(method.damping),
            iteration=jnp.asarray(0),
            done=jnp.asarray(False),
            history=jnp.full(method.iterations + 1, unknown),
        ),
    )
    return LMResult(state.theta, state.cost, state.iteration, state.history)
