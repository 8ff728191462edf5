"""Starts of a Wiener-Hammerstein model.

They come from the best linear model of the whole: its poles and zeros are distributed over the
two systems in every way, and each way is evaluated with the static function solved by least
squares.
Source: Schoukens, Pintelon and Rolain, Identification of Wiener-Hammerstein systems by an
exhaustive and efficient search, Automatica 50(2), 2014.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from asia.data import Array
from asia.models._data.records import ScaledData
from asia.models._linear.subspace import spread_poles
from asia.models._linear.system import LinearSystem
from asia.models._state_space.wiener_hammerstein import WienerHammersteinStructure

Roots = NDArray[np.complex128]

# Greatest number of distributions of poles and zeros, and samples for the evaluation of one.
_MOST_SHARES = 200
_EVALUATION_SAMPLES = 4000
_SETTLE = 50
_SLOW, _FREE_ROOT = 0.98, 0.7


class WienerHammersteinStart(NamedTuple):
    """Starting point with its error."""

    structure: WienerHammersteinStructure
    """Sizes of the systems."""
    params: dict[str, Any]
    """Parameters as the structure reads them."""
    error: float
    """Mean squared error, infinite where it was not evaluated."""


class LinearFilter(NamedTuple):
    """Zeros, poles and gain of one of the systems."""

    zeros: Roots
    """Zeros."""
    poles: Roots
    """Poles, at least as many."""
    gain: float
    """Factor."""

    def system(self) -> tuple[Array, Array, Array, Array]:
        """State-space matrices A, B, C and D."""
        numerator, denominator = signal.zpk2tf(self.zeros, self.poles, self.gain)
        if len(self.poles) == 0:
            static = np.array([[self.gain]])
            return np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), static
        a, b, c, d = signal.tf2ss(numerator, denominator)
        return np.asarray(a), np.asarray(b), np.asarray(c), np.asarray(d)

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


def wiener_hammerstein_starts(
    records: ScaledData,
    system: LinearSystem,
    template: WienerHammersteinStructure,
    rng: np.random.Generator,
    most: int,
) -> list[WienerHammersteinStart]:
    """Find the `most` best starts.

    With one input and output all distributions of poles and zeros compete; with more, the linear
    model
    comes before or after the static function, with new modes that do not yet act on the other side.
    """
    if template.nu == template.ny == 1:
        function = template.function(rng, 1)
        found = [
            _shared_start(records, system, pair, template, function) for pair in shares(system)
        ]
        kept = sorted((s for s in found if s is not None), key=lambda s: s.error)
        if kept:
            return kept[:most]
    return _plain_starts(system, template, rng)[:most]


def shares(
    system: LinearSystem, most: int = _MOST_SHARES
) -> list[tuple[LinearFilter, LinearFilter]]:
    """Distribute the poles and zeros of a system with one input and one output over a first and
    a second filter, in at most `most` ways."""
    zeros, poles, gain = signal.ss2zpk(system.a, system.b, system.c, system.d)
    zeros, poles = np.asarray(zeros, complex), np.asarray(poles, complex)
    # A zero this far out is the rounding error of a delay.
    far = np.abs(zeros) > 1e3
    gain = float(np.real(gain * np.prod(-zeros[far])))
    poles, zeros = _settled(poles, zeros[~far])
    pole_groups, zero_groups = _groups(poles), _groups(zeros)
    pairs: list[tuple[LinearFilter, LinearFilter]] = []
    for choice in product((True, False), repeat=len(pole_groups) + len(zero_groups)):
        p1, p2 = _parted(pole_groups, choice[: len(pole_groups)])
        z1, z2 = _parted(zero_groups, choice[len(pole_groups) :])
        if len(z1) <= len(p1) and len(z2) <= len(p2):
            pairs.append((LinearFilter(z1, p1, 1.0), LinearFilter(z2, p2, gain)))
    chosen = np.linspace(0, len(pairs) - 1, min(len(pairs), most)).astype(int)
    return [pairs[i] for i in np.unique(chosen)]


def _settled(poles: Roots, zeros: Roots) -> tuple[Roots, Roots]:
    """Remove slow poles that a zero nearly cancels: such a pair fits drift, not dynamics."""
    poles, zeros = poles.copy(), zeros.copy()
    for i in np.flatnonzero((np.abs(poles) > _SLOW) & (np.abs(poles.imag) < 1e-9)):
        near = np.flatnonzero((np.abs(zeros - poles[i]) < 2 * (1 - _SLOW)) & (zeros.imag == 0))
        if len(near):
            zeros[near[0]] += _FREE_ROOT - poles[i]
            poles[i] = _FREE_ROOT
    return poles, zeros


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


def _shared_start(
    records: ScaledData,
    system: LinearSystem,
    pair: tuple[LinearFilter, LinearFilter],
    template: WienerHammersteinStructure,
    function: dict[str, Any],
) -> WienerHammersteinStart | None:
    one, two = pair
    middles = [one(r.u[:_EVALUATION_SAMPLES]) for r in records]
    size = float(np.concatenate(middles).std())
    if not np.isfinite(size) or size < 1e-12:
        return None
    one = one._replace(gain=one.gain / size)
    rows: list[Array] = []
    targets: list[Array] = []
    for r, middle in zip(records, middles, strict=True):
        v = middle / size
        through = two(np.concatenate([v, template.features(function, v)], axis=1))
        skip = min(_SETTLE, len(v) // 4)
        known = np.flatnonzero(r.counts[skip : len(v)] > 0) + skip
        rows.append(np.concatenate([through, np.ones((len(v), 1))], axis=1)[known])
        targets.append(r.y[known])
    x, y = np.concatenate(rows), np.concatenate(targets)
    if not np.isfinite(x).all():
        return None
    ridge = 1e-6 * np.diag((x**2).sum(axis=0) + 1e-12)
    theta = np.linalg.solve(x.T @ x + ridge, x.T @ y)
    error = float(((x @ theta - y) ** 2).mean())
    # The function is the identity plus a bend: the slope of the whole goes to the second system.
    slope = float(theta[0, 0])
    slope = slope if abs(slope) > 1e-3 else float(np.copysign(1e-3, slope))
    bend = {**function, "w2": theta[1:-1] / slope}
    params = _params(one.system(), two._replace(gain=two.gain * slope).system(), theta[-1], bend)
    return WienerHammersteinStart(_sized(template, len(one.poles), len(two.poles)), params, error)


def _plain_starts(
    system: LinearSystem, template: WienerHammersteinStructure, rng: np.random.Generator
) -> list[WienerHammersteinStart]:
    n, nu, ny = system.order, template.nu, template.ny
    linear = (system.a, system.b, system.c, system.d)
    found: list[WienerHammersteinStart] = []
    for size, linear_first in ((ny, True), (nu, False)):
        a, _ = spread_poles(n, size)
        idle = (a, 0.1 * rng.standard_normal((n, size)), np.zeros((size, n)), np.eye(size))
        pair = (linear, idle) if linear_first else (idle, linear)
        params = _params(*pair, system.offset, template.function(rng, size))
        found.append(WienerHammersteinStart(_sized(template, n, n), params, np.inf))
    return found


def _sized(
    template: WienerHammersteinStructure, first: int, second: int
) -> WienerHammersteinStructure:
    return replace(template, order=first + second, first=first)


def _params(
    one: tuple[Array, Array, Array, Array],
    two: tuple[Array, Array, Array, Array],
    offset: Array,
    function: dict[str, Any],
) -> dict[str, Any]:
    params: dict[str, Any] = {"offset": np.asarray(offset, np.float64), "f": function}
    for label, system in (("1", one), ("2", two)):
        for name, matrix in zip("abcd", system, strict=True):
            params[name + label] = np.ascontiguousarray(matrix.T)
    return params
