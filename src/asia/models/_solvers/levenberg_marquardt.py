"""Levenberg-Marquardt for models with few parameters, in JAX float64."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from asia.data import Array
from asia.models._arrays import AnyArray, namespace
from asia.models._solvers.least_squares import LevenbergMarquardt

Residual = Callable[[jax.Array], jax.Array]
Linearised = Callable[[jax.Array], tuple[jax.Array, jax.Array]]
CostFunction = Callable[[jax.Array], jax.Array]

# Dampings tried side by side in one iteration: one Jacobian then nearly always yields a step.
_TRIALS = (0.1, 1.0, 10.0, 100.0)


class LMLimits(NamedTuple):
    """When a minimisation ends, as numbers that may be traced: one program then serves all."""

    iterations: int | jax.Array
    """Greatest number of Jacobians."""
    tolerance: float | jax.Array
    """Relative decrease of the cost below which it stops."""


class LMResult(NamedTuple):
    """What a minimisation found."""

    theta: jax.Array
    """Minimiser (n,)."""
    cost: jax.Array
    """Sum of squared residuals there."""
    iterations: jax.Array
    """Those done."""
    history: jax.Array
    """Cost after each iteration (iterations + 1,), held constant once it has stopped."""


class Normal(NamedTuple):
    """Cost (sum of squared residuals e), and J' J (n, n) and J' e (n,) for the parameters
    multiplied by `scale` (n,), the norms of the Jacobian's columns."""

    cost: jax.Array
    scale: jax.Array
    gram: jax.Array
    gradient: jax.Array


class LMState(NamedTuple):
    """Where a minimisation stands; `history` as in `LMResult`."""

    theta: AnyArray
    cost: AnyArray
    damping: AnyArray
    iteration: AnyArray
    done: AnyArray
    history: AnyArray

    @property
    def result(self) -> LMResult:
        """What it has found so far."""
        return LMResult(self.theta, self.cost, self.iteration, self.history)


def finite_cost(cost: jax.Array) -> jax.Array:
    """Infinity for what is not a number."""
    return jnp.where(jnp.isfinite(cost), cost, jnp.inf)


def normal_of(residual: jax.Array, jacobian: jax.Array) -> Normal:
    """From residuals (m,) and Jacobian (m, n)."""
    scale = jnp.sqrt(jnp.sum(jacobian**2, axis=0))
    scale = jnp.where(scale > 0, scale, 1.0)
    scaled = jacobian / scale
    cost = finite_cost(jnp.sum(residual**2))
    return Normal(cost, scale, scaled.T @ scaled, scaled.T @ residual)


def normal_from_sums(cost: jax.Array, gram: jax.Array, gradient: jax.Array) -> Normal:
    """From J' J (n, n) and J' e (n,) summed in parts, where the Jacobian is too large to hold."""
    scale = jnp.sqrt(jnp.diag(gram))
    scale = jnp.where(scale > 0, scale, 1.0)
    return Normal(finite_cost(cost), scale, gram / jnp.outer(scale, scale), gradient / scale)


def value_and_jacobian(function: Residual, theta: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Value (m,) and Jacobian (m, n) at theta (n,), in one forward pass."""

    def both(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
        value = function(theta)
        return value, value

    jacobian, value = jax.jacfwd(both, has_aux=True)(theta)
    return value, jacobian


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

    def cost(theta: jax.Array) -> jax.Array:
        return finite_cost(jnp.sum(residual(theta) ** 2))

    def normal(theta: jax.Array) -> Normal:
        return normal_of(*(linearised or partial(value_and_jacobian, residual))(theta))

    with jax.enable_x64(True):
        theta = jnp.asarray(theta0, dtype=jnp.float64)
        # The first linearisation gives the first cost: compiling the residual once more is dear.
        known = None if method.iterations else cost(theta)
        state = advance(cost, normal, initial_state(theta, method, known), method)
        return state.result


def initial_state(
    theta0: jax.Array | Array, method: LevenbergMarquardt, cost: jax.Array | None = None
) -> LMState:
    """Before the first iteration, at theta0 (n,) float64."""
    # NumPy numbers have the types of what comes out of an iteration: a state that goes in and out
    # of a compiled program must not make JAX compile it once more for its second round.
    unknown = np.float64(np.inf) if cost is None else cost
    return LMState(
        theta=theta0,
        cost=unknown,
        damping=np.float64(method.damping),
        iteration=np.int64(0),
        done=np.bool_(False),
        history=namespace(unknown).full(method.iterations + 1, unknown),
    )


def advance(
    cost: CostFunction,
    normal: Callable[[jax.Array], Normal],
    state: LMState,
    limits: LevenbergMarquardt | LMLimits,
    until: jax.Array | None = None,
) -> LMState:
    """Iterate to the end, or to iteration `until`, so that a long fit can be watched. Traced, in
    float64."""
    trials = jnp.asarray(_TRIALS)
    last = limits.iterations if until is None else jnp.minimum(until, limits.iterations)

    def unfinished(state: LMState) -> jax.Array:
        return (state.iteration < last) & ~state.done

    def iterate(state: LMState) -> LMState:
        at = normal(state.theta)
        history = jnp.where(state.iteration == 0, at.cost, state.history)
        dampings = state.damping * trials
        candidates = state.theta + _steps(at, dampings)
        costs = jax.vmap(cost)(candidates)
        best = jnp.argmin(costs)
        better = costs[best] < at.cost
        reached = jnp.where(better, costs[best], at.cost)
        damping = jnp.where(better, dampings[best] * 0.3, dampings[-1] * 10.0)
        small = better & (at.cost - reached <= limits.tolerance * at.cost)
        iteration = state.iteration + 1
        return LMState(
            theta=jnp.where(better, candidates[best], state.theta),
            cost=reached,
            damping=jnp.maximum(damping, 1e-12),
            iteration=iteration,
            done=small | (damping > 1e12) | (reached == 0.0),
            history=jnp.where(jnp.arange(len(history)) >= iteration, reached, history),
        )

    return jax.lax.while_loop(unfinished, iterate, state)


def _steps(at: Normal, dampings: jax.Array) -> jax.Array:
    """Steps (trials, n) for several dampings, with Marquardt's column scaling."""
    identity = jnp.eye(at.gram.shape[0], dtype=at.gram.dtype)

    def step(damping: jax.Array) -> jax.Array:
        factor = jax.scipy.linalg.cho_factor(at.gram + damping * identity, lower=True)
        return -jax.scipy.linalg.cho_solve(factor, at.gradient) / at.scale

    return jax.vmap(step)(dampings)
