"""Search for a Wiener-Hammerstein model with one input and one output by many short fits.

The best linear models of several orders are split into two filters in every way; a static function
on a grid is solved by least squares for each way, the most promising are fitted for a few
iterations on parts of the records, and those with the least error on the segments left out go on,
in the end on all records. A linear model's own error is a poor guide to its order where most of it
is distortion, so the order is chosen here. Source: Sjoberg and Schoukens, Initializing
Wiener-Hammerstein models based on partitioning of the best linear approximation, Automatica 48(2),
2012.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from asia.candidate import Context
from asia.data import Array
from asia.models import linear
from asia.models._config import Progress
from asia.models._data.records import ScaledData, ScaledTrajectory, holdout_masks
from asia.models._least_squares import LevenbergMarquardt, minimise
from asia.models._linear.fit import Refinement
from asia.models._linear.system import LinearSystem
from asia.models._state_space.filters import (
    FilterEquations,
    FilterRidge,
    TwoFilters,
    simulated,
)
from asia.models._state_space.wiener_hammerstein_starts import LinearFilter, shares

# Orders of the linear model if none is given, iterations of its fit, and its samples.
_ORDERS = (2, 3, 4, 5, 6, 7, 8)
_LINEAR, _LINEAR_SAMPLES = Refinement(iterations=15), 4000
# Samples of the short fits, share of them left out, and samples for the evaluation of a split.
_SEARCHED_SAMPLES, _LEFT_OUT, _EVALUATION_SAMPLES, _SETTLE = 12_000, 0.3, 3000, 50
# Samples at the start of a record that no fit counts, at most this share of a record. Otherwise the
# filters would compensate for initial states, which the fit finds slowly.
_TRANSIENT, _TRANSIENT_SHARE = 200, 0.1
# Share of the errors that counts: a single extreme value, beyond all that was fitted, carries no
# information on the filters.
_TRIMMED = 0.99
# Splits evaluated for each order, splits fitted, and splits fitted further.
_MOST_SPLITS, _FITTED, _FITTED_ON = 600, 4, 6
_FEW, _MORE = 20, 100
# Range of the static function's grid, in deviations of its argument.
_REACH = 3.5


@dataclass(frozen=True)
class FilterFit:
    """Model found by the search."""

    filters: TwoFilters
    """Parameters of the model."""
    delay: int
    """Delay of the input, in samples."""
    error: float
    """Mean squared error on the segments left out, or on all that was fitted."""
    history: Array
    """Root of the cost by iteration."""


def searched(
    records: ScaledData,
    context: Context,
    choice: linear.Config,
    hidden: int,
    ridge: FilterRidge,
    method: LevenbergMarquardt,
    log: Progress,
) -> FilterFit:
    """Search for the model with the least training error, of `method.starts` that reach the last
    stage.

    Args:
        records: records in z-scores.
        context: context of the fit.
        choice: order and delay, each None where it is open.
        hidden: number of tanh units.
        ridge: ridges.
        method: settings of the last fits.
        log: receives iteration and error.
    """
    part = _shortened(records, _SEARCHED_SAMPLES)
    kept, left = _divided(part)
    settled = [replace(r, weight=r.weight * _behind_start(len(r))) for r in records]
    found = list[FilterFit]()
    few = replace(method, iterations=min(_FEW, method.iterations))
    for delay, system in _linear_models(part, context, choice):
        late = [r.with_delay(delay) for r in kept]
        for start in _split(late, system, hidden):
            one = _fitted(start, delay, kept, ridge, few)
            found.append(replace(one, error=_error(one, left)))
    more = replace(method, iterations=min(_MORE, method.iterations))
    best = sorted(found, key=lambda one: one.error)[:_FITTED_ON]
    further = list[FilterFit]()
    for one in best:
        again = _fitted(one.filters, one.delay, kept, ridge, more)
        further.append(replace(again, error=_error(again, left)))
    further.sort(key=lambda one: one.error)
    fits = list[FilterFit]()
    for i, one in enumerate(further[: method.starts]):
        start = _at_rest(one.filters, len(records))
        fits.append(_fitted(start, one.delay, settled, ridge, method))
        log(float(i), float(np.sqrt(min(fit.error for fit in fits))))
    return min(fits, key=lambda one: one.error)


def _linear_models(
    part: ScaledData, context: Context, choice: linear.Config
) -> list[tuple[int, LinearSystem]]:
    """Linear models of every permitted order, with their delays.

    A delay estimated with few states may replace missing states, so that no such delay competes.
    """
    short = _shortened(part, _LINEAR_SAMPLES)
    orders = _ORDERS if choice.order is None else (choice.order,)
    orders = tuple(o for o in orders if 8 * o <= min(len(r) for r in short)) or orders[:1]
    delays = {choice.delay or 0}
    if choice.delay is None:
        settled = linear.Config(order=orders[0], delay=None)
        delays.add(linear.fit_records(short, context, settled, _LINEAR)[1])
    found = list[tuple[int, LinearSystem]]()
    for delay in sorted(delays):
        for order in orders:
            known = linear.Config(order=order, delay=delay)
            quiet = replace(context, log=lambda step, loss: None)
            fit, _, _ = linear.fit_records(short, quiet, known, _LINEAR)
            found.append((delay, fit.system))
    return found


def _shortened(records: ScaledData, samples: int) -> list[ScaledTrajectory]:
    """Cut the first samples of at most four records, about so many in all."""
    few = sorted(records, key=len, reverse=True)[:4]
    each = samples // len(few)
    return [r.part(0, min(len(r), each)) for r in few]


def _divided(part: ScaledData) -> tuple[list[ScaledTrajectory], list[ScaledTrajectory]]:
    """Copy the records twice: with the weights of the fitted part, and of the part left out."""
    masks = holdout_masks(part, _LEFT_OUT, shortest=_SETTLE)
    pairs = list(zip(part, masks, strict=True))
    kept = [replace(r, weight=r.weight * ~m * _behind_start(len(r))) for r, m in pairs]
    return kept, [replace(r, weight=r.weight * m) for r, m in pairs]


def _split(late: ScaledData, system: LinearSystem, hidden: int) -> list[TwoFilters]:
    """Best splits of a linear model."""
    evaluated = [
        start
        for pair in shares(system, _MOST_SPLITS)
        if (start := _start(late, system, pair, hidden)) is not None
    ]
    evaluated.sort(key=lambda pair: pair[0])
    return [filters for _, filters in evaluated[:_FITTED]]


def _start(
    late: ScaledData, system: LinearSystem, pair: tuple[LinearFilter, LinearFilter], hidden: int
) -> tuple[float, TwoFilters] | None:
    """Solve the static function of a split; return its mean squared error too."""
    one, two = pair
    parts = [r.part(0, _EVALUATION_SAMPLES) for r in late[:2]]
    with np.errstate(all="ignore"):
        middles = [one(r.u)[:, 0] for r in parts]
        size = float(np.concatenate(middles).std())
        if not np.isfinite(size) or size < 1e-12:
            return None
        slope, shift = _grid(hidden)
        rows, targets = list[Array](), list[Array]()
        for r, middle in zip(parts, middles, strict=True):
            v = middle[:, None] / size
            through = two(np.concatenate([v, np.tanh(v * slope + shift)], axis=1))
            skip = min(_SETTLE, len(v) // 4)
            known = np.flatnonzero(r.counts[skip:] > 0) + skip
            rows.append(np.concatenate([through, np.ones((len(v), 1))], axis=1)[known])
            targets.append(r.y[known, 0])
        x, y = np.concatenate(rows), np.concatenate(targets)
    if not np.isfinite(x).all():
        return None
    scale = np.sqrt((x**2).sum(axis=0)) + 1e-12
    gram = (x / scale).T @ (x / scale) + 1e-6 * np.eye(x.shape[1])
    theta = np.linalg.solve(gram, (x / scale).T @ y) / scale
    error = float(((x @ theta - y) ** 2).mean())
    # The function is the identity plus a bend: the slope of the whole goes to the second filter.
    gain = float(theta[0])
    gain = gain if abs(gain) > 1e-2 else float(np.copysign(1e-2, gain))
    b1, a1 = one._replace(gain=one.gain / size).in_delays()
    b2, a2 = two._replace(gain=two.gain * gain).in_delays()
    x0 = np.zeros((1, system.order))
    bend = theta[1:-1] / gain
    return error, TwoFilters(b1, a1[1:], slope, shift, bend, b2, a2[1:], theta[-1:], x0)


def _grid(hidden: int) -> tuple[Array, Array]:
    """Slopes and shifts of tanh units whose centres cover the argument of unit size evenly."""
    centres = np.linspace(-_REACH, _REACH, hidden + 2)[1:-1]
    slope = np.full(hidden, max(1.0, 0.5 * hidden / _REACH))
    return slope, -slope * centres


def _at_rest(filters: TwoFilters, records: int) -> TwoFilters:
    return filters._replace(x0=np.zeros((records, filters.x0.shape[1])))


def _fitted(
    start: TwoFilters,
    delay: int,
    records: ScaledData,
    ridge: FilterRidge,
    method: LevenbergMarquardt,
) -> FilterFit:
    late = [r.with_delay(delay) for r in records]
    if len(start.x0) != len(late):
        start = _at_rest(start, len(late))
    origin = start.packed()
    equations = FilterEquations(start, late, start.pull(ridge), origin)
    found = minimise(equations.costs, equations.normal, origin[None], method)
    filters = start.unpacked(found.theta[0])
    return FilterFit(filters, delay, float(found.cost[0]), np.sqrt(found.history[0]))


def _behind_start(length: int) -> Array:
    """Weights (T,) that are zero at the start of a record."""
    start = min(_TRANSIENT, int(_TRANSIENT_SHARE * length))
    return (np.arange(length) >= start).astype(np.float64)


def _error(one: FilterFit, left: ScaledData) -> float:
    """Mean squared error where the weights of these records are, without its largest values;
    infinite where it diverges."""
    squares = list[Array]()
    with np.errstate(all="ignore"):
        for i, record in enumerate(left):
            late = record.with_delay(one.delay)
            apart = (simulated(one.filters, late.u[:, 0], i) - late.y[:, 0]) * late.weight
            squares.append(apart[late.weight > 0.0] ** 2)
    all_of_them = np.concatenate(squares)
    if not len(all_of_them) or not np.isfinite(all_of_them).all():
        return np.inf
    return float(all_of_them[all_of_them <= np.quantile(all_of_them, _TRIMMED)].mean())
