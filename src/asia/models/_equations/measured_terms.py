"""Levenberg-Marquardt on windows for equations whose states are all measured, in rounds that
leave only the linear terms the data ask for.

After each round a term's ridge becomes inversely proportional to its squared size, which drives
terms of little use to zero (automatic relevance determination by reweighted ridge; Wipf and
Nagarajan, NeurIPS 2007).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np

from asia.data import Array
from asia.models._data.windows import HorizonWindows
from asia.models._equations.measured_cell import MeasuredCell
from asia.models._networks.structure import Params, rollout
from asia.models._solvers.least_squares import LevenbergMarquardt
from asia.models._solvers.packing import Packing, packed
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

    theta: Array
    cost: float
    damping: float
    best: Array | None = None
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
    kept = {k: v for k, v in params.items() if k in _HELD}
    free = {k: v for k, v in params.items() if k not in kept}
    packing, theta0 = Packing.of(free), packed(free, np.float64)
    learned = packed({k: np.full(np.shape(v), k in _LEARNED) for k, v in free.items()}, bool)
    rounds = _ROUNDS if settings.sparsity > 0 and cell.linear else 1
    every = _WindowErrors(cell, kept, packing, windows, settings)
    few = every
    if rounds > 1 and len(windows.u) >= _MANY:
        quarter = windows.each(lambda a: a[::4])
        few = _WindowErrors(cell, kept, packing, quarter, settings)
    state = _EquationSearch(theta0, float("inf"), method.damping)
    ridge = np.where(learned, settings.ridge, _SMALL * settings.ridge + 1e-6)
    step = 0
    for number in range(rounds):
        errors = few if number == 0 else every
        if number > 0:
            sparse = settings.sparsity / ((state.theta - theta0) ** 2 + _SMALL)
            ridge = np.where(learned, sparse, ridge)
        state.cost, state.damping = errors.cost(state.theta, theta0, ridge), method.damping
        slow = 0
        for _ in range(method.iterations):
            slow = slow + 1 if _iterate(errors, state, theta0, ridge) < _LEAST_GAIN else 0
            step += 1
            log(float(step), float(np.sqrt(max(state.cost, 0.0))))
            if judge is not None:
                _ask(judge, errors, state)
            if slow == 2:
                break
    theta = state.theta if state.best is None else state.best
    return {**params, **packing.unpack(theta)}


def _iterate(errors: _WindowErrors, state: _EquationSearch, theta0: Array, ridge: Array) -> float:
    """One accepted step; its relative gain, 0 when no damping gives one."""
    gram, gradient = errors.normal(state.theta, theta0, ridge)
    size = np.diag(np.diag(gram) + 1e-12)
    for _ in range(_TRIES):
        moved = state.theta - np.linalg.solve(gram + state.damping * size, gradient)
        cost = errors.cost(moved, theta0, ridge)
        if np.isfinite(cost) and cost < state.cost:
            gained = (state.cost - cost) / state.cost if np.isfinite(state.cost) else 1.0
            state.theta, state.cost, state.damping = moved, cost, max(state.damping / 3, 1e-9)
            return gained
        state.damping *= 4.0
    return 0.0


def _ask(judge: Judge, errors: _WindowErrors, state: _EquationSearch) -> None:
    score = judge(errors.params(state.theta))
    if score < state.best_score:
        state.best, state.best_score = state.theta, score


class _WindowErrors:
    """Errors on windows, simulated in float32: it costs half as much, and its rounding is far below
    the noise of measured states. Their squares are summed in float64."""

    def __init__(
        self,
        cell: MeasuredCell,
        kept: Params,
        packing: Packing,
        windows: HorizonWindows,
        settings: TermPenalties,
    ) -> None:
        self._kept, self._packing, self._threshold = dict(kept), packing, settings.robust
        windows = windows.each(lambda a: np.asarray(a, np.float32))
        fixed = {"fixed": kept["fixed"]}
        self._program = partial(_errors, cell, packing, fixed, windows)
        self._linearised = partial(_derivatives, cell, packing, fixed, windows)

    def params(self, theta: Array) -> Params:
        """All parameters."""
        return {**self._kept, **self._packing.unpack(theta)}

    def cost(self, theta: Array, theta0: Array, ridge: Array) -> float:
        """The penalised loss."""
        e, t = _double(self._program(theta.astype(np.float32))), self._threshold
        with np.errstate(all="ignore"):
            loss = e**2 if t is None else 2.0 * t**2 * (np.sqrt(1.0 + (e / t) ** 2) - 1.0)
            return float(loss.mean() + (ridge * (theta - theta0) ** 2).sum())

    def normal(self, theta: Array, theta0: Array, ridge: Array) -> tuple[Array, Array]:
        """Half its Hessian (n, n), after Gauss and Newton, and half its gradient (n,)."""
        e, jacobian = (_double(a) for a in self._linearised(theta.astype(np.float32)))
        weighted = jacobian
        if self._threshold is not None:
            weighted = jacobian / np.sqrt(1.0 + (e / self._threshold) ** 2)
        gram = weighted @ jacobian.T / e.size + np.diag(ridge)
        return gram, weighted @ e / e.size + ridge * (theta - theta0)


def _double(values: jax.Array) -> Array:
    return np.asarray(values, np.float64)


@partial(jax.jit, static_argnums=(0, 1))
def _errors(
    cell: MeasuredCell, packing: Packing, fixed: Any, windows: HorizonWindows, theta: jax.Array
) -> jax.Array:
    """(N,) for parameters theta (n,)."""
    y = rollout(cell, {**fixed, **packing.unpack(theta)}, windows.features, windows.u)
    error = y - windows.y
    if windows.weight is not None:
        error = windows.weight[..., None] * error
    return error[:, _EVERY - 1 :: _EVERY].ravel()


@partial(jax.jit, static_argnums=(0, 1))
def _derivatives(
    cell: MeasuredCell, packing: Packing, fixed: Any, windows: HorizonWindows, theta: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Errors (N,) and their derivatives (n, N)."""

    def along(direction: jax.Array) -> tuple[jax.Array, jax.Array]:
        run = partial(_errors, cell, packing, fixed, windows)
        return jax.jvp(run, (theta,), (direction,))

    basis = jax.numpy.eye(len(theta), dtype=theta.dtype)
    return jax.vmap(along, out_axes=(None, 0))(basis)
