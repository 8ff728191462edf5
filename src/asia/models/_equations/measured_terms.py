"""Levenberg-Marquardt on windows for equations whose states are all measured, in rounds that
leave only the linear terms the data ask for.

After each round a term's ridge becomes inversely proportional to its squared size, which drives
terms of little use to zero (automatic relevance determination by reweighted ridge; Wipf and
Nagarajan, NeurIPS 2007).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from asia.models._data.windows import HorizonWindows
from asia.models._equations.measured_cell import MeasuredCell
from asia.models._networks.structure import Params, rollout
from asia.models._solvers.least_squares import LevenbergMarquardt
from asia.models._solvers.progress import Progress

Judge = Callable[[Params], float]

_ROUNDS = 3
_TRIES = 8
# Of so many windows the first round, which is far from the end, takes a quarter.
_MANY = 400
_SMALL = 1e-3
_EVERY = 5
_LEAST_GAIN = 2e-3
# Of learned terms, in effects of the size of the signals they act on.
_LEARNED = ("linear", "offset")
# Not fitted by Levenberg-Marquardt.
_HELD = ("fixed", "net", "out_w", "out_b")


@dataclass(frozen=True)
class TermPenalties:
    """What holds the fit of the equations."""

    robust: float | None
    """Where the loss turns from square to linear, in standard deviations; None: never."""
    ridge: float
    """Weight of squared learned effects in the first round."""
    sparsity: float
    """The same in the later ones."""


@dataclass
class _EquationSearch:
    """Where the search stands, and the best parameters by the judge."""

    theta: jax.Array
    cost: float
    damping: float
    best: jax.Array | None = None
    best_score: float = float("inf")


def fit_equations(
    cell: MeasuredCell,
    params: Params,
    windows: HorizonWindows,
    settings: TermPenalties,
    method: LevenbergMarquardt,
    log: Progress,
    judge: Judge | None = None,
) -> Params:
    """The parameters but `fixed` and the network's, fitted; the best by `judge`, asked after every
    iteration, where there is one."""
    with jax.enable_x64(True):
        kept = {k: v for k, v in params.items() if k in _HELD}
        free = {k: jnp.asarray(v, jnp.float64) for k, v in params.items() if k not in kept}
        theta0, unravel = ravel_pytree(free)
        learned, _ = ravel_pytree({k: jnp.full_like(v, k in _LEARNED) for k, v in free.items()})
        rounds = _ROUNDS if settings.sparsity > 0 and cell.linear else 1
        every = _Program(cell, kept, unravel, _single(windows), settings)
        few = every
        if rounds > 1 and len(windows.u) >= _MANY:
            quarter = HorizonWindows(*(_single(a[::4]) for a in windows))
            few = _Program(cell, kept, unravel, quarter, settings)
        state = _EquationSearch(theta0, float("inf"), method.damping)
        first = jnp.where(learned > 0, settings.ridge, _SMALL * settings.ridge + 1e-6)
        ridge = first.astype(theta0.dtype)
        step = 0
        for number in range(rounds):
            program = few if number == 0 else every
            if number > 0:
                sparse = settings.sparsity / ((state.theta - theta0) ** 2 + _SMALL)
                ridge = jnp.where(learned > 0, sparse, ridge)
            state.cost, state.damping = program.cost(state.theta, theta0, ridge), method.damping
            slow = 0
            for _ in range(method.iterations):
                slow = slow + 1 if _iterate(program, state, theta0, ridge) < _LEAST_GAIN else 0
                step += 1
                log(float(step), float(np.sqrt(max(state.cost, 0.0))))
                if judge is not None:
                    _ask(judge, program, state)
                if slow == 2:
                    break
        theta = state.theta if state.best is None else state.best
        return {**params, **jax.tree.map(np.asarray, unravel(theta))}


def _iterate(
    program: _Program, state: _EquationSearch, theta0: jax.Array, ridge: jax.Array
) -> float:
    """One accepted step; its relative gain, 0 when no damping gives one."""
    gram, gradient = program.normal(state.theta, theta0, ridge)
    size = jnp.diag(jnp.diag(gram) + 1e-12)
    for _ in range(_TRIES):
        moved = state.theta - jnp.linalg.solve(gram + state.damping * size, gradient)
        cost = program.cost(moved, theta0, ridge)
        if np.isfinite(cost) and cost < state.cost:
            gained = (state.cost - cost) / state.cost if np.isfinite(state.cost) else 1.0
            state.theta, state.cost, state.damping = moved, cost, max(state.damping / 3, 1e-9)
            return gained
        state.damping *= 4.0
    return 0.0


def _ask(judge: Judge, program: _Program, state: _EquationSearch) -> None:
    score = judge(jax.tree.map(np.asarray, {**program.kept, **program.unravel(state.theta)}))
    if score < state.best_score:
        state.best, state.best_score = state.theta, score


def _single(tree: Any) -> Any:
    """In float32: the simulation costs half as much, and its rounding is far below the noise of
    measured states."""
    return jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), tree)


class _Program:
    """Compiled cost and normal equations: simulated in float32, summed in float64."""

    def __init__(
        self,
        cell: MeasuredCell,
        kept: Params,
        unravel: Callable[[jax.Array], Params],
        windows: HorizonWindows,
        settings: TermPenalties,
    ) -> None:
        self.kept, self.unravel = dict(kept), unravel
        threshold = settings.robust

        def residual(theta: jax.Array) -> jax.Array:
            params = _single({**self.kept, **unravel(theta)})
            y = rollout(cell, params, windows.features, windows.u)
            return (y - windows.y)[:, _EVERY - 1 :: _EVERY].ravel().astype(theta.dtype)

        def weights(e: jax.Array) -> jax.Array:
            if threshold is None:
                return jnp.ones_like(e)
            return 1.0 / jnp.sqrt(1.0 + (e / threshold) ** 2)

        def twice(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
            e = residual(theta)
            return e, e

        def loss(e: jax.Array) -> jax.Array:
            if threshold is None:
                return jnp.mean(e**2)
            return jnp.mean(2.0 * threshold**2 * (jnp.sqrt(1.0 + (e / threshold) ** 2) - 1.0))

        def cost(theta: jax.Array, theta0: jax.Array, ridge: jax.Array) -> jax.Array:
            return loss(residual(theta)) + jnp.sum(ridge * (theta - theta0) ** 2)

        def normal(
            theta: jax.Array, theta0: jax.Array, ridge: jax.Array
        ) -> tuple[jax.Array, jax.Array]:
            jacobian, e = jax.jacfwd(twice, has_aux=True)(theta)
            weighted = jacobian * weights(e)[:, None]
            gram = weighted.T @ jacobian / e.size + jnp.diag(ridge)
            return gram, weighted.T @ e / e.size + ridge * (theta - theta0)

        self._cost, self.normal = jax.jit(cost), jax.jit(normal)

    def cost(self, theta: jax.Array, theta0: jax.Array, ridge: jax.Array) -> float:
        """The penalised loss."""
        return float(self._cost(theta, theta0, ridge))
