"""Levenberg-Marquardt in NumPy for many problems at once: one row each, the same rule for all.

The caller computes costs and normal equations, in NumPy or by a compiled program, so that no
program holds the iteration.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from asia.data import Array
from asia.models._solvers.least_squares import LevenbergMarquardt

# Dampings tried side by side in one iteration: one Jacobian then nearly always yields a step.
FACTORS = np.array([0.1, 1.0, 10.0, 100.0])
TRIALS = len(FACTORS)
"""Points of a row whose costs are asked for together."""


class NormalEquations(NamedTuple):
    """Of residuals e and their Jacobian J, for R rows of n unknowns."""

    cost: Array
    """e' e (R,)."""
    gram: Array
    """J' J (R, n, n)."""
    gradient: Array
    """J' e (R, n)."""


class Minimum(NamedTuple):
    """What was found, one row each."""

    theta: Array
    """Minimisers (R, n)."""
    cost: Array
    """Sums of squared residuals there (R,)."""
    history: Array
    """Costs after each iteration (R, iterations + 1), constant once a row has stopped."""


Cost: TypeAlias = Callable[[Array], Array]
"""Sums of squared residuals (R, K) at K points a row, theta (R, K, n)."""
Linearise: TypeAlias = Callable[[Array], NormalEquations]
"""The normal equations at theta (R, n)."""


def minimise(
    cost: Cost, linearise: Linearise, theta0: Array, method: LevenbergMarquardt
) -> Minimum:
    """Minimise the sum of squares of each row from theta0 (R, n).

    A step that does not lower a row's cost, or leads to values that are not finite, is refused: no
    cost ever rises. `method.starts` is the caller's affair.
    """
    theta = np.array(theta0, dtype=np.float64)
    damping = np.full(len(theta), method.damping)
    done = np.zeros(len(theta), dtype=bool)
    reached = _finite(cost(theta[:, None])[:, 0]) if not method.iterations else damping
    history = np.tile(reached[:, None], (1, method.iterations + 1))
    each = np.arange(len(theta))
    for iteration in range(method.iterations):
        if done.all():
            break
        at = linearise(theta)
        before = _finite(at.cost)
        if iteration == 0:
            history[:] = before[:, None]
        dampings = damping[:, None] * FACTORS
        points = theta[:, None] + _steps(at, dampings)
        costs = _finite(cost(points))
        best = costs.argmin(axis=1)
        better = (costs[each, best] < before) & ~done
        reached = np.where(better, costs[each, best], before)
        old, new = (np.where(better, costs, 0.0) for costs in (before, reached))
        small = better & (old - new <= method.tolerance * old)
        theta = np.where(better[:, None], points[each, best], theta)
        changed = np.where(better, dampings[each, best] * 0.3, dampings[:, -1] * 10.0)
        damping = np.where(done, damping, np.maximum(changed, 1e-12))
        history[~done, iteration + 1 :] = reached[~done, None]
        done |= small | (damping > 1e12) | (reached == 0.0)
    return Minimum(theta, history[:, -1].copy(), history)


def _finite(costs: Array) -> Array:
    """Infinity for what is not a number."""
    return np.where(np.isfinite(costs), costs, np.inf)


def _steps(at: NormalEquations, dampings: Array) -> Array:
    """Steps (R, trials, n) for dampings (R, trials), with Marquardt's column scaling."""
    # A row whose errors are not finite gets steps that are not, which are refused.
    with np.errstate(all="ignore"):
        scale = np.sqrt(np.diagonal(at.gram, axis1=1, axis2=2))
        scale = np.where(scale > 0, scale, 1.0)
        gram = at.gram / (scale[:, :, None] * scale[:, None, :])
        damped = gram[:, None] + dampings[..., None, None] * np.eye(gram.shape[1])
        gradient = np.broadcast_to((at.gradient / scale)[:, None, :, None], (*damped.shape[:3], 1))
        return -np.linalg.solve(damped, gradient)[..., 0] / scale[:, None]
