"""Wiener-Hammerstein model with one input and one output as two filters and a static function.

Costs and normal equations of the simulation error. Derivatives with respect to the coefficients of
a filter are delayed copies of two filtered signals, so that an iteration takes a few dozen passes
of a recursive filter over the records instead of a recursion over matrices. Records are processed
in
chunks of which only sums are kept: memory does not grow with their length. Source: Ljung,
System Identification, 2nd ed., section 10.3.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy import signal

from asia.data import Array
from asia.models._data.records import ScaledData, ScaledTrajectory
from asia.models._least_squares import NormalEquations
from asia.models._state_space.wiener_hammerstein import WienerHammersteinStructure

# Samples of a chunk. Derivatives by initial states are computed only in the first one: they have
# decayed after it.
_CHUNK = 8192


class FilterRidge(NamedTuple):
    """Weights, against the mean squared error, of squared distances from the start."""

    linear: float
    """Weight for the coefficients of the filters and the offset."""
    bend: float
    """Weight for the static function."""
    initial: float
    """Weight for the initial states."""


class TwoFilters(NamedTuple):
    """Parameters of two filters and a static function.

    A filter is numerator and denominator in the delay, the denominator without its
    leading one; the static function is w = v + bend' tanh(slope v + shift), linear in its
    fitted part: units that move as well make long narrow valleys.
    """

    numerator1: Array
    """(n1 + 1,)."""
    denominator1: Array
    """(n1,)."""
    slope: Array
    """(h,)."""
    shift: Array
    """(h,)."""
    bend: Array
    """(h,)."""
    numerator2: Array
    """(n2 + 1,)."""
    denominator2: Array
    """(n2,)."""
    offset: Array
    """(1,)."""
    x0: Array
    """Initial states of both filters, transposed direct form II (R, n1 + n2)."""

    def packed(self) -> Array:
        """Pack the fitted parameters into one vector: all but the grid of the tanh units."""
        return np.concatenate([value.ravel() for value in self._fitted()])

    def unpacked(self, theta: Array) -> TwoFilters:
        """Unpack a vector into these shapes, on the same grid."""
        shapes = self._fitted()
        parts = np.split(theta, np.cumsum([value.size for value in shapes])[:-1])
        b1, a1, bend, b2, a2, offset, x0 = (
            p.reshape(v.shape) for p, v in zip(parts, shapes, strict=True)
        )
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

    def state_space(
        self, template: WienerHammersteinStructure
    ) -> tuple[WienerHammersteinStructure, dict[str, Any]]:
        """Convert the model to state space, its initial states unchanged."""
        first, second = len(self.denominator1), len(self.denominator2)
        structure = _with_sizes(template, first, second, len(self.bend))
        function = {
            "w1": self.slope[None],
            "b1": self.shift,
            "w2": self.bend[:, None],
        }
        params: dict[str, Any] = {"offset": self.offset, "f": function}
        pairs = (self.numerator1, self.denominator1), (self.numerator2, self.denominator2)
        for label, pair in zip("12", pairs, strict=True):
            for name, matrix in zip("abcd", _realised(*pair), strict=True):
                params[name + label] = np.ascontiguousarray(matrix.T)
        return structure, params


def _with_sizes(
    template: WienerHammersteinStructure, first: int, second: int, hidden: int
) -> WienerHammersteinStructure:
    return replace(template, order=first + second, first=first, hidden=hidden)


def _realised(numerator: Array, denominator: Array) -> tuple[Array, Array, Array, Array]:
    """Realise a filter in transposed direct form II."""
    n = len(denominator)
    a = np.eye(n, k=1)
    a[:, :1] = -denominator[:, None]
    b = (numerator[1:] - denominator * numerator[0])[:, None]
    return a, b, np.eye(1, n), numerator[:1, None]


class FilterEquations:
    """Costs and normal equations of a fit, for `minimise`."""

    def __init__(self, shapes: TwoFilters, records: ScaledData, pull: Array, origin: Array) -> None:
        self._shapes, self._records = shapes, records
        self._pull, self._origin = pull, origin
        self._total = max(sum(float((r.weight**2).sum()) for r in records), 1.0)

    def costs(self, theta: Array) -> Array:
        """Costs at theta (1, K, P) -> (1, K)."""
        return np.array([[self._cost(one) for one in theta[0]]])

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

    def _cost(self, theta: Array) -> float:
        p, away = self._shapes.unpacked(theta), theta - self._origin
        total = 0.0
        with np.errstate(all="ignore"):
            for i, record in enumerate(self._records):
                error = (simulated(p, record.u[:, 0], i) - record.y[:, 0]) * record.weight
                total += float(error @ error)
        return total / self._total + float(self._pull @ away**2)


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
        self._n = n
        self._by_input = _Copies(denominator, n)
        self._by_output = _Copies(denominator, n)
        self._by_state = _Copies(denominator, n)

    def __call__(self, given: Array, out: Array, first: bool) -> tuple[Array, Array]:
        """Derivatives by the coefficients (2n + 1, c) and, in the first chunk, by the initial
        state (n, c)."""
        n = self._n
        rows = np.concatenate(
            [self._by_input(given, range(n + 1)), self._by_output(-out, range(1, n + 1))]
        )
        if not first:
            return rows, np.zeros((n, len(given)))
        impulse = np.zeros(len(given))
        impulse[0] = 1.0
        return rows, self._by_state(impulse, range(n))


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
        u, weight = record.u[part, 0], record.weight[part]
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
