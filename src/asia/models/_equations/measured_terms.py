"""Levenberg-Marquardt on windows for equations whose states are all measured, in rounds that
leave only the linear terms the data ask for.

After each round a term's ridge becomes inversely proportional to its squared size, which drives
terms of little use to zero (automatic relevance determination by reweighted ridge; Wipf and
Nagarajan, NeurIPS 2007).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from typing import Any

import jax
import numpy as np

from asia.data.trajectory import Array
from asia.models._arrays import Packing, packed
from asia.models._config import Progress
from asia.models._equations.measured import MeasuredCell
from asia.models._least_squares import SEQUENTIAL, LevenbergMarquardt, NormalEquations, minimise
from asia.models._networks.structure import Params, rollout
from asia.models._numerics.training_records import SegmentBatch

Judge = Callable[[Params], float]

_ROUNDS = 3
_SCHEDULE = replace(SEQUENTIAL, success=1.0 / 3.0, failure=4.0)
# Number of windows from which the first round, far from the optimum, uses only a quarter.
_MANY = 400
_SMALL = 1e-3
_EVERY = 5
# Iterations in a row with less than this relative gain that end a round.
_PATIENCE, _LEAST_GAIN = 2, 2e-3
# Learned terms, in effects of the size of the signals they act on.
_LEARNED = ("linear", "offset")
# Parameters that Levenberg-Marquardt does not fit.
_HELD = ("fixed", "net", "out_w", "out_b")


@dataclass(frozen=True)
class TermPenalties:
    """Loss and penalties of the fit of the equations."""

    robust: float | None
    """Error at which the loss changes from square to linear, in standard deviations; None: never.
    """
    ridge: float  # Weight of squared learned effects in the first round
    sparsity: float  # Weight of squared learned effects in the later rounds


def fit_equations(
    cell: MeasuredCell,
    params: Params,
    windows: SegmentBatch,
    settings: TermPenalties,
    method: LevenbergMarquardt,
    log: Progress,
    judge: Judge | None = None,
) -> Params:
    """Fit all parameters but `fixed` and the network's on training windows.

    The log receives iteration and loss. The judge scores parameters after every iteration; the best
    ones are returned.
    """
    kept = {k: v for k, v in params.items() if k in _HELD}
    free = {k: v for k, v in params.items() if k not in kept}
    packing, theta0 = Packing.of(free), packed(free, np.float64)
    learned = packed({k: np.full(np.shape(v), k in _LEARNED) for k, v in free.items()}, bool)
    rounds = _ROUNDS if settings.sparsity > 0 and cell.linear else 1
    every = _WindowErrors(cell, kept, packing, windows, settings)
    few = every
    if rounds > 1 and len(windows.u) >= _MANY:
        quarter = SegmentBatch(*(a[::4] for a in windows[:4]))
        few = _WindowErrors(cell, kept, packing, quarter, settings)
    theta, best, best_score = theta0, theta0, float("inf")
    method = replace(method, tolerance=_LEAST_GAIN)
    steps, ridge = count(1), np.where(learned, settings.ridge, _SMALL * settings.ridge + 1e-6)

    def after(theta: Array, cost: Array) -> None:
        nonlocal best, best_score
        log(float(next(steps)), float(np.sqrt(max(cost[0], 0.0))))
        score = float("inf") if judge is None else judge(every.params(theta[0]))
        if score < best_score:
            best, best_score = theta[0], score

    for number in range(rounds):
        errors = few if number == 0 else every
        if number > 0:
            sparse = settings.sparsity / ((theta - theta0) ** 2 + _SMALL)
            ridge = np.where(learned, sparse, ridge)
        theta = minimise(
            partial(errors.cost, theta0, ridge),
            partial(errors.normal, theta0, ridge),
            theta[None],
            method,
            _SCHEDULE,
            patience=_PATIENCE,
            after=after,
        ).theta[0]
    return {**params, **packing.unpack(theta if best_score == float("inf") else best)}


class _WindowErrors:
    """Errors on windows, simulated in float32: it costs half as much, and its rounding is far below
    the noise of measured states. Their squares are summed in float64."""

    def __init__(
        self,
        cell: MeasuredCell,
        kept: Params,
        packing: Packing,
        windows: SegmentBatch,
        settings: TermPenalties,
    ) -> None:
        self._kept, self._packing, self._threshold = dict(kept), packing, settings.robust
        windows = SegmentBatch(*(np.asarray(a, np.float32) for a in windows[:4]))
        fixed = {"fixed": kept["fixed"]}
        self._program = partial(_errors, cell, packing, fixed, windows)
        self._linearised = partial(_derivatives, cell, packing, fixed, windows)

    def params(self, theta: Array) -> Params:
        """All parameters."""
        return {**self._kept, **self._packing.unpack(theta)}

    def cost(self, theta0: Array, ridge: Array, points: Array) -> Array:
        """Penalised loss (1, 1) at points (1, 1, n)."""
        theta, t = points[0, 0], self._threshold
        e = _double(self._program(theta.astype(np.float32)))
        with np.errstate(all="ignore"):
            loss = e**2 if t is None else 2.0 * t**2 * (np.sqrt(1.0 + (e / t) ** 2) - 1.0)
            return np.array([[loss.mean() + (ridge * (theta - theta0) ** 2).sum()]])

    def normal(self, theta0: Array, ridge: Array, thetas: Array) -> NormalEquations:
        """Normal equations of the penalised loss at (1, n)."""
        theta = thetas[0]
        e, jacobian = (_double(a) for a in self._linearised(theta.astype(np.float32)))
        weighted = jacobian
        if self._threshold is not None:
            weighted = jacobian / np.sqrt(1.0 + (e / self._threshold) ** 2)
        gram = weighted @ jacobian.T / e.size + np.diag(ridge)
        gradient = weighted @ e / e.size + ridge * (theta - theta0)
        return NormalEquations(
            self.cost(theta0, ridge, thetas[:, None])[:, 0], gram[None], gradient[None]
        )


def _double(values: jax.Array) -> Array:
    return np.asarray(values, np.float64)


@partial(jax.jit, static_argnums=(0, 1))
def _errors(
    cell: MeasuredCell, packing: Packing, fixed: Any, windows: SegmentBatch, theta: jax.Array
) -> jax.Array:
    """Errors (N,) at parameters theta (n,)."""
    y = rollout(cell, {**fixed, **packing.unpack(theta)}, windows.window, windows.u)
    error = windows.weight * (y - windows.y)
    return error[:, _EVERY - 1 :: _EVERY].ravel()


@partial(jax.jit, static_argnums=(0, 1))
def _derivatives(
    cell: MeasuredCell, packing: Packing, fixed: Any, windows: SegmentBatch, theta: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Errors (N,) and their derivatives (n, N)."""

    def along(direction: jax.Array) -> tuple[jax.Array, jax.Array]:
        run = partial(_errors, cell, packing, fixed, windows)
        return jax.jvp(run, (theta,), (direction,))

    basis = jax.numpy.eye(len(theta), dtype=theta.dtype)
    return jax.vmap(along, out_axes=(None, 0))(basis)
