"""Wiener-Hammerstein models with one input and one output: structure, filters, search."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from asia.candidate import Context
from asia.data.trajectory import Array
from asia.models import linear
from asia.models._arrays import namespace
from asia.models._config import Progress
from asia.models._least_squares import LevenbergMarquardt, NormalEquations, minimise
from asia.models._linear.fit import Refinement
from asia.models._linear.system import LinearSystem, unpacked
from asia.models._numerics.training_records import (
    ScaledData,
    ScaledTrajectory,
    holdout_masks,
)
from asia.models._state_space.structure import Coefficients, StateSpaceStructure

# Wiener-Hammerstein structure: linear system, static function, linear system.


@dataclass(frozen=True)
class WienerHammersteinStructure(StateSpaceStructure):
    """Equations x1[k+1] = A1 x1 + B1 u, v = C1 x1 + D1 u, w = v + f(v), x2[k+1] = A2 x2 + B2 w,
    y = C2 x2 + D2 w + offset."""

    first: int = 1  # Number of states of x1; the rest are x2

    def split(self, p: Coefficients, x: Any, v: Any) -> tuple[Any, Any]:
        """Advance states x (..., n) with inputs v (..., nu); return the outputs too."""
        one, two = x[..., : self.first], x[..., self.first :]
        middle = one @ p["c1"] + v @ p["d1"]
        bent = middle + self._net(p["f"], middle)
        state = namespace(x).concatenate(
            [one @ p["a1"] + v @ p["b1"], two @ p["a2"] + bent @ p["b2"]], -1
        )
        return state, two @ p["c2"] + bent @ p["d2"] + p["offset"]


# Distributions of the poles and zeros of a linear system over two filters. Source: Schoukens,
# Pintelon and Rolain, Identification of Wiener-Hammerstein systems by an exhaustive and efficient
# search, Automatica 50(2), 2014.

Roots = NDArray[np.complex128]

_SETTLE = 50
_SLOW, _FREE_ROOT = 0.98, 0.7


class LinearFilter(NamedTuple):
    """Zeros, poles and gain of one of the systems."""

    zeros: Roots  # Zeros
    poles: Roots  # Poles, at least as many
    gain: float  # Factor

    def in_delays(self) -> tuple[Array, Array]:
        """Numerator and denominator in powers of the delay, both as long as the number of poles
        requires."""
        numerator, denominator = signal.zpk2tf(self.zeros, self.poles, self.gain)
        delayed = np.zeros(len(self.poles) - len(self.zeros))
        # A constant polynomial is returned as a number.
        up, down = (np.asarray(c, np.float64).reshape(-1) for c in (numerator, denominator))
        return np.concatenate([delayed, up]), down

    def __call__(self, u: Array) -> Array:
        return np.asarray(signal.lfilter(*self.in_delays(), u, axis=0), np.float64)


def shares(system: LinearSystem) -> list[tuple[LinearFilter, LinearFilter]]:
    """Distribute the poles and zeros of a system with one input and one output over a first and
    a second filter, in at most `_MOST_SPLITS` ways."""
    numerator, denominator, gain = signal.ss2zpk(system.a, system.b, system.c, system.d)
    zeros: Roots = np.array(numerator, complex)
    poles: Roots = np.array(denominator, complex)
    # A zero this far out is the rounding error of a delay.
    far = np.abs(zeros) > 1e3
    gain = float(np.real(gain * np.prod(-zeros[far])))
    zeros = zeros[~far]
    # Remove slow poles that a zero nearly cancels: such a pair fits drift, not dynamics.
    for i in np.flatnonzero((np.abs(poles) > _SLOW) & (np.abs(poles.imag) < 1e-9)):
        near = np.flatnonzero((np.abs(zeros - poles[i]) < 2 * (1 - _SLOW)) & (zeros.imag == 0))
        if len(near):
            zeros[near[0]] += _FREE_ROOT - poles[i]
            poles[i] = _FREE_ROOT
    pole_groups, zero_groups = _groups(poles), _groups(zeros)
    pairs: list[tuple[LinearFilter, LinearFilter]] = []
    for choice in product((True, False), repeat=len(pole_groups) + len(zero_groups)):
        p1, p2 = _parted(pole_groups, choice[: len(pole_groups)])
        z1, z2 = _parted(zero_groups, choice[len(pole_groups) :])
        if len(z1) <= len(p1) and len(z2) <= len(p2):
            pairs.append((LinearFilter(z1, p1, 1.0), LinearFilter(z2, p2, gain)))
    chosen = np.linspace(0, len(pairs) - 1, min(len(pairs), _MOST_SPLITS)).astype(int)
    return [pairs[i] for i in np.unique(chosen)]


def _groups(roots: Roots) -> list[Roots]:
    """Groups of roots: each real root, and each complex root with its conjugate."""
    real = [
        roots[i : i + 1].real.astype(complex) for i in np.flatnonzero(np.abs(roots.imag) < 1e-9)
    ]
    upper = roots[roots.imag >= 1e-9]
    return real + [np.array([r, r.conjugate()]) for r in upper]


def _parted(groups: Sequence[Roots], first: Sequence[bool]) -> tuple[Roots, Roots]:
    empty: list[Roots] = [np.zeros(0, complex)]
    one = [g for g, mine in zip(groups, first, strict=True) if mine]
    two = [g for g, mine in zip(groups, first, strict=True) if not mine]
    return np.concatenate(empty + one), np.concatenate(empty + two)


# Wiener-Hammerstein model with one input and one output as two filters and a static function.
#
# Costs and normal equations of the simulation error. Derivatives with respect to the coefficients
# of a filter are delayed copies of two filtered signals, so that an iteration takes a few dozen
# passes of a recursive filter over the records instead of a recursion over matrices. Records are
# processed in chunks of which only sums are kept: memory does not grow with their length. Source:
# Ljung, System Identification, 2nd ed., section 10.3.

# Samples of a chunk. Derivatives by initial states are computed only in the first one: they have
# decayed after it.
_CHUNK = 8192


class FilterRidge(NamedTuple):
    """Weights, against the mean squared error, of squared distances from the start."""

    linear: float  # Weight for the coefficients of the filters and the offset
    bend: float  # Weight for the static function
    initial: float  # Weight for the initial states


class TwoFilters(NamedTuple):
    """Parameters of two filters and a static function.

    A filter is numerator and denominator in the delay, the denominator without its
    leading one; the static function is w = v + bend' tanh(slope v + shift), linear in its
    fitted part: units that move as well make long narrow valleys.
    """

    numerator1: Array  # (n1 + 1,)
    denominator1: Array  # (n1,)
    slope: Array  # (h,)
    shift: Array  # (h,)
    bend: Array  # (h,)
    numerator2: Array  # (n2 + 1,)
    denominator2: Array  # (n2,)
    offset: Array  # (1,)
    x0: Array  # Initial states of both filters, transposed direct form II (R, n1 + n2)

    def packed(self) -> Array:
        """Pack the fitted parameters into one vector: all but the grid of the tanh units."""
        return np.concatenate([value.ravel() for value in self._fitted()])

    def unpacked(self, theta: Array) -> TwoFilters:
        """Unpack a vector into these shapes, on the same grid."""
        b1, a1, bend, b2, a2, offset, x0 = unpacked(theta, [part.shape for part in self._fitted()])
        return TwoFilters(b1, a1, self.slope, self.shift, bend, b2, a2, offset, x0)

    def pull(self, ridge: FilterRidge) -> Array:
        """Ridge (P,) of each fitted parameter."""
        line, bend = ridge.linear, ridge.bend
        each = (line, line, bend, line, line, line, ridge.initial)
        return np.concatenate(
            [np.full(v.size, r) for r, v in zip(each, self._fitted(), strict=True)]
        )

    def _fitted(self) -> tuple[Array, ...]:
        return (*self[:2], *self[4:])

    def state_space(self) -> tuple[WienerHammersteinStructure, dict[str, Any]]:
        """Convert the model to state space, its initial states unchanged."""
        params: dict[str, Any] = {
            "offset": self.offset,
            "f": {"w1": self.slope[None], "b1": self.shift, "w2": self.bend[:, None]},
        }
        for label, numerator, denominator in (
            ("1", self.numerator1, self.denominator1),
            ("2", self.numerator2, self.denominator2),
        ):
            # Transposed direct form II.
            n = len(denominator)
            a = np.eye(n, k=1)
            a[:, :1] = -denominator[:, None]
            b = (numerator[1:] - denominator * numerator[0])[:, None]
            system = {"a": a, "b": b, "c": np.eye(1, n), "d": numerator[:1, None]}
            params |= {k + label: np.ascontiguousarray(v.T) for k, v in system.items()}
        first, order = len(self.denominator1), len(self.denominator1) + len(self.denominator2)
        return WienerHammersteinStructure(
            order, 1, 1, "state", "tanh", len(self.bend), 2, None, first=first
        ), params


class FilterEquations:
    """Costs and normal equations of a fit, for `minimise`."""

    def __init__(self, shapes: TwoFilters, records: ScaledData, pull: Array, origin: Array) -> None:
        self._shapes, self._records = shapes, records
        self._pull, self._origin = pull, origin
        self._total = max(sum(float((r.weight**2).sum()) for r in records), 1.0)

    def costs(self, theta: Array) -> Array:
        """Costs at theta (1, K, P) -> (1, K)."""
        found = list[float]()
        for one in theta[0]:
            p, away, total = self._shapes.unpacked(one), one - self._origin, 0.0
            with np.errstate(all="ignore"):
                for i, record in enumerate(self._records):
                    error = (simulated(p, record.u[:, 0], i) - record.y[:, 0]) * record.weight[:, 0]
                    total += float(error @ error)
                found.append(total / self._total + float(self._pull @ away**2))
        return np.array([found])

    def normal(self, theta: Array) -> NormalEquations:
        """Normal equations at theta (1, P)."""
        away = theta[0] - self._origin
        cost, gradient = float(self._pull @ away**2), self._pull * away
        gram = np.diag(self._pull)
        p = self._shapes.unpacked(theta[0])
        with np.errstate(all="ignore"):
            for i, record in enumerate(self._records):
                for error, rows in _linearised(p, record, i):
                    cost += float(error @ error) / self._total
                    gram += rows @ rows.T / self._total
                    gradient += rows @ error / self._total
        return NormalEquations(np.array([cost]), gram[None], gradient[None])


def simulated(p: TwoFilters, u: Array, record: int) -> Array:
    """Output (T,) for the input u (T,) from the initial state of a record."""
    first = len(p.denominator1)
    v, _ = _filtered(p.numerator1, p.denominator1, u, p.x0[record, :first])
    w = v
    for slope, shift, bend in zip(p.slope, p.shift, p.bend, strict=True):
        w = w + bend * np.tanh(slope * v + shift)
    y, _ = _filtered(p.numerator2, p.denominator2, w, p.x0[record, first:])
    return y + p.offset[0]


def _filtered(
    numerator: Array, denominator: Array, values: Array, state: Array
) -> tuple[Array, Array]:
    """Filter values (..., T) along the last axis from state (..., n)."""
    full = np.concatenate([[1.0], denominator])
    if len(full) == 1 and len(numerator) == 1:
        return numerator[0] * values, state
    out, last = signal.lfilter(numerator, full, values, axis=-1, zi=state)
    return np.asarray(out, np.float64), np.asarray(last, np.float64)


class _Copies:
    """Signal through 1 / A with its delayed copies, chunk by chunk."""

    def __init__(self, denominator: Array, most: int) -> None:
        self._denominator, self._most = denominator, most
        self._state, self._tail = np.zeros(len(denominator)), np.zeros(most)

    def __call__(self, values: Array, delays: range) -> Array:
        one = np.ones(1)
        out, self._state = _filtered(one, self._denominator, values, self._state)
        known = np.concatenate([self._tail, out])
        start, length = self._most, len(values)
        self._tail = known[len(known) - self._most :]
        return np.array([known[start - d : start - d + length] for d in delays]).reshape(-1, length)


class _FilterDerivatives:
    """Derivatives of a filter's output by numerator, denominator and initial state."""

    def __init__(self, denominator: Array) -> None:
        n = len(denominator)
        self._by_input, self._by_output, self._by_state = (
            _Copies(denominator, n) for _ in range(3)
        )
        self._n = n

    def __call__(self, given: Array, out: Array, first: bool) -> tuple[Array, Array]:
        """Derivatives by the coefficients (2n + 1, c) and, in the first chunk, by the initial
        state (n, c)."""
        n = self._n
        rows = np.concatenate(
            [self._by_input(given, range(n + 1)), self._by_output(-out, range(1, n + 1))]
        )
        if not first:
            return rows, np.zeros((n, len(given)))
        return rows, self._by_state(np.eye(1, len(given))[0], range(n))


def _linearised(
    p: TwoFilters, record: ScaledTrajectory, index: int
) -> Iterator[tuple[Array, Array]]:
    """Weighted errors (c,) and their derivatives (P, c), chunk by chunk."""
    n1, n2, h = len(p.denominator1), len(p.denominator2), len(p.bend)
    x1, x2 = p.x0[index, :n1], p.x0[index, n1:]
    first, second = _FilterDerivatives(p.denominator1), _FilterDerivatives(p.denominator2)
    shared = 2 * n1 + 1 + h
    carried = np.zeros((shared + n1, n2))
    for start in range(0, len(record), _CHUNK):
        part = slice(start, start + _CHUNK)
        u, weight = record.u[part, 0], record.weight[part, 0]
        v, x1 = _filtered(p.numerator1, p.denominator1, u, x1)
        by_first, by_x1 = first(u, v, start == 0)
        t = np.tanh(p.slope[:, None] * v + p.shift[:, None])
        w = v + p.bend @ t
        gain = 1.0 + (p.slope * p.bend) @ (1.0 - t**2)
        inner = np.concatenate([gain * by_first, t, gain * by_x1])
        passed, carried = _filtered(p.numerator2, p.denominator2, inner, carried)
        y, x2 = _filtered(p.numerator2, p.denominator2, w, x2)
        by_second, by_x2 = second(w, y, start == 0)
        by_x0 = np.zeros((len(p.x0), n1 + n2, len(u)))
        by_x0[index] = np.concatenate([passed[shared:], by_x2])
        one = np.ones((1, len(u)))
        rows = np.concatenate([passed[:shared], by_second, one, by_x0.reshape(-1, len(u))])
        error = (y + p.offset[0] - record.y[part, 0]) * weight
        yield error, rows * weight


# Search for a Wiener-Hammerstein model with one input and one output by many short fits.
#
# The best linear models of several orders are split into two filters in every way; a static
# function on a grid is solved by least squares for each way, the most promising are fitted for a
# few iterations on parts of the records, and those with the least error on the segments left out
# go on, in the end on all records. A linear model's own error is a poor guide to its order where
# most of it is distortion, so the order is chosen here. Source: Sjoberg and Schoukens,
# Initializing Wiener-Hammerstein models based on partitioning of the best linear approximation,
# Automatica 48(2), 2012.

# Orders of the linear model if none is given, iterations of its fit, and its samples.
_ORDERS = (2, 3, 4, 5, 6, 7, 8)
_LINEAR, _LINEAR_SAMPLES = Refinement(iterations=15), 4000
# Samples of the short fits, share of them left out, and samples for the evaluation of a split.
_SEARCHED_SAMPLES, _LEFT_OUT, _SPLIT_SAMPLES = 12_000, 0.3, 3000
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

    filters: TwoFilters  # Parameters of the model
    delay: int  # Delay of the input, in samples
    error: float  # Mean squared error on the segments left out, or on all that was fitted
    history: Array  # Root of the cost by iteration


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
    # The short records twice: with the weights of the fitted part, and of the part left out.
    masks = holdout_masks(part, _LEFT_OUT, shortest=_SETTLE)
    pairs = list(zip(part, masks, strict=True))
    kept = [replace(r, weight=r.weight * ~m * _behind_start(len(r))) for r, m in pairs]
    left = [replace(r, weight=r.weight * m) for r, m in pairs]

    def fitted(filters: TwoFilters, delay: int, iterations: int) -> FilterFit:
        limited = replace(method, iterations=min(iterations, method.iterations))
        one = _fitted(filters, delay, kept, ridge, limited)
        return replace(one, error=_error(one, left))

    found = list[FilterFit]()
    for delay, system in _linear_models(part, context, choice):
        late = [r.with_delay(delay) for r in kept]
        evaluated = [_start(late, system, pair, hidden) for pair in shares(system)]
        splits = sorted((s for s in evaluated if s is not None), key=lambda s: s[0])
        found += [fitted(filters, delay, _FEW) for _, filters in splits[:_FITTED]]
    best = sorted(found, key=lambda one: one.error)[:_FITTED_ON]
    further = [fitted(one.filters, one.delay, _MORE) for one in best]
    further.sort(key=lambda one: one.error)
    settled = [replace(r, weight=r.weight * _behind_start(len(r))) for r in records]
    fits = list[FilterFit]()
    for i, one in enumerate(further[: method.starts]):
        start = one.filters._replace(x0=np.zeros((len(records), one.filters.x0.shape[1])))
        fits.append(_fitted(start, one.delay, settled, ridge, method))
        log(float(i), float(np.sqrt(min(fit.error for fit in fits))))
    return min(fits, key=lambda one: one.error)


def _linear_models(
    part: ScaledData, context: Context, choice: linear.Config
) -> list[tuple[int, LinearSystem]]:
    """Linear models of every permitted order, with their delays. A delay estimated with few states
    may replace missing states, so that no such delay competes."""
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


def _start(
    late: ScaledData, system: LinearSystem, pair: tuple[LinearFilter, LinearFilter], hidden: int
) -> tuple[float, TwoFilters] | None:
    """Solve the static function of a split; return its mean squared error too."""
    one, two = pair
    parts = [r.part(0, _SPLIT_SAMPLES) for r in late[:2]]
    with np.errstate(all="ignore"):
        middles = [one(r.u)[:, 0] for r in parts]
        size = float(np.concatenate(middles).std())
        if not np.isfinite(size) or size < 1e-12:
            return None
        # Tanh units whose centres cover the argument of unit size evenly.
        slope = np.full(hidden, max(1.0, 0.5 * hidden / _REACH))
        shift = -slope * np.linspace(-_REACH, _REACH, hidden + 2)[1:-1]
        rows, responses = list[Array](), list[Array]()
        for r, middle in zip(parts, middles, strict=True):
            v = middle[:, None] / size
            through = two(np.concatenate([v, np.tanh(v * slope + shift)], axis=1))
            skip = min(_SETTLE, len(v) // 4)
            known = np.flatnonzero(r.counts[skip:, 0] > 0) + skip
            rows.append(np.concatenate([through, np.ones((len(v), 1))], axis=1)[known])
            responses.append(r.y[known, 0])
        x, y = np.concatenate(rows), np.concatenate(responses)
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


def _fitted(
    start: TwoFilters,
    delay: int,
    records: ScaledData,
    ridge: FilterRidge,
    method: LevenbergMarquardt,
) -> FilterFit:
    late = [r.with_delay(delay) for r in records]
    if len(start.x0) != len(late):
        start = start._replace(x0=np.zeros((len(late), start.x0.shape[1])))
    origin = start.packed()
    equations = FilterEquations(start, late, start.pull(ridge), origin)
    found = minimise(equations.costs, equations.normal, origin[None], method)
    filters = start.unpacked(found.theta[0])
    return FilterFit(filters, delay, float(found.cost[0]), np.sqrt(found.history[0]))


def _behind_start(length: int) -> Array:
    """Weights (T, 1) that are zero at the start of a record."""
    start = min(_TRANSIENT, int(_TRANSIENT_SHARE * length))
    return (np.arange(length) >= start).astype(np.float64)[:, None]


def _error(one: FilterFit, left: ScaledData) -> float:
    """Mean squared error where the weights of these records are, without its largest values;
    infinite where it diverges."""
    squares = list[Array]()
    with np.errstate(all="ignore"):
        for i, record in enumerate(left):
            late = record.with_delay(one.delay)
            apart = (simulated(one.filters, late.u[:, 0], i) - late.y[:, 0]) * late.weight[:, 0]
            squares.append(apart[late.weight[:, 0] > 0.0] ** 2)
    all_of_them = np.concatenate(squares)
    if not len(all_of_them) or not np.isfinite(all_of_them).all():
        return np.inf
    return float(all_of_them[all_of_them <= np.quantile(all_of_them, _TRIMMED)].mean())
