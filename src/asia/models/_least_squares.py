"""Levenberg-Marquardt for every family: the settings, the damping schedules and the one loop.

The caller computes costs and normal equations, of many rows (starting points, windows) at once.
The loop runs in NumPy around compiled programs and NumPy code alike, so that no program holds it
while a model is trained; given JAX arrays it is traced, for a step that `asia export` reads.
Source: Marquardt, SIAM J. Appl. Math. 11 (1963).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from asia.data.trajectory import Array
from asia.models._arrays import AnyArray, namespace
from asia.models._config import check_at_least, demand
from asia.models._noise.model import NoiseKind, check_noise


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Training method: damped Gauss-Newton on the simulation error.

    Source: Marquardt, SIAM J. Appl. Math. 11 (1963).
    """

    iterations: int = 50
    """Greatest number of Jacobians."""
    starts: int = 1
    """Starting points, in families that can be started from several."""
    damping: float = 1e-2
    """First damping, relative to the scaled normal matrix."""
    tolerance: float = 1e-9
    """Relative decrease of the cost below which it stops."""
    stop: Literal["validation"] | None = None
    """"validation" keeps the parameters with the least `context.validation_score`, asked for after
    every iteration, in families that can (physics_net); without such a score, or elsewhere, the
    last ones are kept."""
    noise_model: NoiseKind = "white"
    """Model of the residual of a simulation: "white", or "slow" for a slow disturbance
    (Ornstein-Uhlenbeck) plus white noise. The sizes of both are estimated from the residuals of the
    fit by least squares, and generalised least squares goes on from there, in turn until they
    settle. Changes how a model is trained, not how it simulates."""
    huber: float | None = None
    """Threshold, in deviations of the innovations, beyond which their cost grows in proportion to
    them; None is least squares."""

    def __post_init__(self) -> None:
        check_at_least(0, self, "iterations", "tolerance")
        check_at_least(1, self, "starts")
        check_noise(self)
        demand(self, "damping", self.damping > 0, "a positive number")
        demand(self, "stop", self.stop in (None, "validation"), "None or 'validation'")


@dataclass(frozen=True)
class DampingSchedule:
    """Rule that changes the damping by the success of the steps."""

    factors: tuple[float, ...]
    """Dampings tried side by side, relative to the present one, in ascending order."""
    success: float  # Factor on the damping whose step was taken
    failure: float  # Factor on the largest damping tried where no step lowered the cost
    least: float  # Smallest damping
    greatest: float  # Damping beyond which a row stops
    retries: bool  # Larger dampings are tried on the same Jacobian until one lowers the cost


SIDE_BY_SIDE = DampingSchedule((0.1, 1.0, 10.0, 100.0), 0.3, 10.0, 1e-12, 1e12, retries=False)
"""Schedule for many rows, and costs that one program computes together: one Jacobian nearly
always yields a step."""
SEQUENTIAL = DampingSchedule((1.0,), 0.2, 8.0, 1e-9, 1e8, retries=True)
"""Schedule for one row and costs much cheaper than a Jacobian."""
TRIALS = len(SIDE_BY_SIDE.factors)
"""Number of points of a row whose costs `SIDE_BY_SIDE` evaluates together."""


class NormalEquations(NamedTuple):
    """Normal equations of residuals e and their Jacobian J, for R rows of n unknowns."""

    cost: AnyArray  # e' e (R,)
    gram: AnyArray  # J' J (R, n, n)
    gradient: AnyArray  # J' e (R, n)


class Minimum(NamedTuple):
    """Result of a minimisation, one row a start."""

    theta: Array  # Minimisers (R, n)
    cost: Array  # Sums of squared residuals there (R,)
    history: Array
    """Costs after each iteration (R, iterations + 1), constant once a row has stopped."""


Cost: TypeAlias = Callable[[Any], Any]
"""Sums of squared residuals (R, K) at K points a row, theta (R, K, n)."""
Linearise: TypeAlias = Callable[[Any], NormalEquations]
"""The normal equations at theta (R, n)."""


class _RowStates(NamedTuple):
    """State of the rows between two iterations."""

    theta: AnyArray  # (R, n)
    damping: AnyArray  # (R,)
    slow: AnyArray  # Iterations in a row that gained too little (R,)
    done: AnyArray  # Rows that have stopped (R,)


def minimise(
    cost: Cost,
    linearise: Linearise,
    theta0: Array,
    method: LevenbergMarquardt,
    schedule: DampingSchedule = SIDE_BY_SIDE,
    *,
    patience: int = 1,
    race: Sequence[tuple[int, float]] = (),
    after: Callable[[Array, Array], None] | None = None,
) -> Minimum:
    """Minimise the sum of squares of each row from theta0 (R, n).

    A step that does not lower a row's cost, or leads to values that are not finite, is refused: no
    cost ever rises. A row stops when its cost fell by less than `method.tolerance` in `patience`
    iterations in a row, when its damping has grown beyond the schedule, or at zero. `method.starts`
    is left to the caller.

    Args:
        cost: sums of squares at points.
        linearise: normal equations, called once an iteration, at points whose cost is known.
        theta0: starting points (R, n).
        method: settings.
        schedule: rule for the damping.
        patience: iterations in a row with little gain before a row stops.
        race: pairs of an iteration and a ratio of costs; from that iteration on a row stops whose
            cost is more than so many times the least one.
        after: called as after(theta, cost) after each iteration.
    """
    theta = np.array(theta0, dtype=np.float64)
    rows = len(theta)
    search = _RowStates(theta, np.full(rows, method.damping), np.zeros(rows), np.zeros(rows, bool))
    history = np.empty((rows, method.iterations + 1))
    if not method.iterations:
        history[:] = _finite(cost(theta[:, None])[:, 0])[:, None]
    for iteration in range(method.iterations):
        if search.done.all():
            break
        open_rows = ~search.done
        search, before, reached = _iterate(
            cost, linearise, search, schedule, method.tolerance, patience
        )
        if iteration == 0:
            history[:] = before[:, None]
        history[open_rows, iteration + 1 :] = reached[open_rows, None]
        for ratio in (ratio for begin, ratio in race if iteration + 1 >= begin):
            behind = history[:, -1] > ratio * history[:, -1].min()
            search = search._replace(done=search.done | behind)
        if after is not None:
            after(search.theta, history[:, -1])
    return Minimum(search.theta, history[:, -1].copy(), history)


def traced_minimum(
    cost: Cost,
    linearise: Linearise,
    theta0: AnyArray,
    method: LevenbergMarquardt,
    schedule: DampingSchedule = SIDE_BY_SIDE,
) -> AnyArray:
    """Minimise JAX arrays by the operations that a lowered program has: all iterations of
    `minimise` run, without retries, and a row that has stopped stays."""
    import jax
    import jax.numpy as jnp

    rows = len(theta0)
    damping = jnp.full(rows, method.damping)
    search = _RowStates(theta0, damping, jnp.zeros(rows), jnp.zeros(rows, bool))

    def advance(search: _RowStates, _: None) -> tuple[_RowStates, None]:
        return _iterate(cost, linearise, search, schedule, method.tolerance, 1)[0], None

    return jax.lax.scan(advance, search, None, method.iterations)[0].theta


def _iterate(
    cost: Cost,
    linearise: Linearise,
    search: _RowStates,
    schedule: DampingSchedule,
    tolerance: float,
    patience: int,
) -> tuple[_RowStates, AnyArray, AnyArray]:
    """Run one iteration with one Jacobian; return the costs before and after it too. NumPy or
    JAX."""
    theta, damping, slow, done = search
    xp, n, seeking = namespace(theta), theta.shape[1], ~done
    at = linearise(theta)
    before = reached = _finite(at.cost)
    # Errors that are not finite give steps that are not finite, which are refused.
    with np.errstate(all="ignore"):
        scale = xp.sqrt(xp.diagonal(at.gram, axis1=1, axis2=2))
        scale = xp.where(scale > 0, scale, 1.0)
        gram = at.gram / (scale[:, :, None] * scale[:, None, :])
        gradient = (at.gradient / scale)[:, None, :]
    while True:
        dampings = damping[:, None] * np.array(schedule.factors)
        with np.errstate(all="ignore"):
            damped = gram[:, None] + dampings[..., None, None] * np.eye(n)
            points = search.theta[:, None] - solve(damped, gradient) / scale[:, None]
            points = xp.where(done[:, None, None], search.theta[:, None], points)
        costs = _finite(cost(points))
        point, least, chosen = points[:, 0], costs[:, 0], dampings[:, 0]
        for k in range(1, len(schedule.factors)):
            less = costs[:, k] < least
            point = xp.where(less[:, None], points[:, k], point)
            least = xp.where(less, costs[:, k], least)
            chosen = xp.where(less, dampings[:, k], chosen)
        better = (least < before) & seeking
        theta = xp.where(better[:, None], point, theta)
        reached = xp.where(better, least, reached)
        changed = xp.where(better, chosen * schedule.success, dampings[:, -1] * schedule.failure)
        damping = xp.where(seeking, xp.maximum(changed, schedule.least), damping)
        seeking = seeking & ~better & (damping <= schedule.greatest)
        if not (schedule.retries and seeking.any()):
            break
    lower = reached < before
    known = lower & xp.isfinite(before)
    old, new = xp.where(known, before, 0.0), xp.where(known, reached, 0.0)
    small = known & (old - new <= tolerance * old)
    slow = xp.where(small, slow + 1.0, xp.where(lower, 0.0, slow))
    done = done | (slow >= patience) | (damping > schedule.greatest) | (reached == 0.0)
    return _RowStates(theta, damping, slow, done), before, reached


def _finite(costs: AnyArray) -> AnyArray:
    """Replace costs that are no number by infinity."""
    xp = namespace(costs)
    return xp.where(xp.isfinite(costs), costs, np.inf)


def damped_step(gram: Array, gradient: Array, damping: float) -> Array:
    """Step (n,) against a gradient (n,), with Marquardt's column scaling of gram (n, n)."""
    scale = np.sqrt(np.diagonal(gram))
    scale = np.where(scale > 0, scale, 1.0)
    damped = gram / (scale[:, None] * scale) + damping * np.eye(len(gram))
    return -solve_or_fit(damped, gradient / scale) / scale


def solve_or_fit(matrix: Array, right: Array) -> Array:
    """Solve matrix (n, n) x = right (n,) or (n, m); the least-squares solution where it is
    singular, so that a fit goes on."""
    try:
        return np.asarray(np.linalg.solve(matrix, right), np.float64)
    except np.linalg.LinAlgError:
        if not (np.isfinite(matrix).all() and np.isfinite(right).all()):
            return np.full_like(right, np.nan)
        return np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0], np.float64)


def solve(matrix: AnyArray, right: AnyArray) -> AnyArray:
    """Solve matrix x = right for symmetric positive definite matrices (..., n, n) and right (...,
    n); in NumPy as `solve_or_fit` where one is singular.

    In JAX Cholesky's decomposition is written out, so that every export target can compute it.
    """
    if namespace(matrix) is np:
        wide = np.broadcast_to(right, matrix.shape[:-1])
        try:
            return np.linalg.solve(matrix, wide[..., None])[..., 0]
        except np.linalg.LinAlgError:
            found = np.empty(wide.shape)
            for place in np.ndindex(wide.shape[:-1]):
                found[place] = solve_or_fit(matrix[place], wide[place])
            return found
    import jax.numpy as jnp

    n = right.shape[-1]
    lower: list[list[AnyArray]] = []
    for i in range(n):
        row: list[AnyArray] = []
        for j in range(i + 1):
            rest = matrix[..., i, j]
            for k in range(j):
                rest = rest - (row[k] * lower[j][k] if j < i else row[k] * row[k])
            row.append(jnp.sqrt(rest) if i == j else rest / lower[j][j])
        lower.append(row)
    down: list[AnyArray] = []
    for i in range(n):
        rest = right[..., i]
        for k in range(i):
            rest = rest - lower[i][k] * down[k]
        down.append(rest / lower[i][i])
    up: list[AnyArray] = [None] * n
    for i in range(n - 1, -1, -1):
        rest = down[i]
        for k in range(i + 1, n):
            rest = rest - lower[k][i] * up[k]
        up[i] = rest / lower[i][i]
    return jnp.stack(up, axis=-1)
