"""Controllers for a linear plant with one input and one output, by optimisation over structures.

A controller of a few parameters is sought that meets all specifications of the unity-feedback loop:
structures from simple to complex, each by differential evolution (Storn and Price, J. Global
Optim. 11, 1997) on the violated specifications. Margins and step response are computed from the
frequency response, poles and residues, without a simulation.

The controller then runs sampled, with limits and anti-windup by back-calculation (Astrom and
Hagglund, Advanced PID Control, section 3.5), in a simulated loop with nonlinear models, and is
printed as code.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from statistics import fmean
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asia._progress import tracked
from asia.data.trajectory import Array
from asia.lowering.linear import LinearModel, discretize, minimal
from asia.lowering.program import LoweredModel

# Order of Pade's approximation of a dead time in the poles of the closed loop.
_PADE = 3
# Points of the frequency response and of the step response, which is computed in blocks.
_GRID, _TIMES, _BLOCK, _SAMPLED_GRID = 400, 600, 25, 200
_BAND = 0.02
_NEAR = np.geomspace(1e-4, 0.3, 12)
# Reserve that the optimisation asks for beyond each specification.
_RESERVE = 0.02
# Smaller reserve that a controller needs to be taken at once.
_EDGE = 0.005
_EXCESS = 3
# Share of the response in slow modes that the optimisation accepts, and what counts as slow: this
# part of the speed of a first-order lag with the same rise.
_TAIL, _CREEP = 0.01, 0.3
# The optimisation prefers a loop at most this much faster than the longest settling time.
_FASTER = 4.0
# Longest settling after a load, in longest settling times of the set point.
_LOAD = 2.0
# A smaller steady-state error asks for an integrator: without one the gain would be very high.
_INTEGRAL = 0.01
# What the optimisation prefers counts less than a specification, and at most this much.
_PREFERRED = 0.5
# Largest crossover frequency in units of the speed that is asked for, or of the unstable pole.
_SPEED = 300.0
# Samples of the step response of a plant by itself.
_LONGEST_OWN = 20_000
# Times that the default sampling time is halved at most.
_FINER = 6
# Generations without a progress of 1 % after which an optimisation ends.
_STALLED = 40
# The last structure, which nothing follows, is searched this much longer.
_LAST = 3


@dataclass(frozen=True)
class Transfer:
    """Rational transfer function and a dead time."""

    num: Array
    """Coefficients, the highest power first."""
    den: Array
    delay: float = 0.0
    """In s."""

    def response(self, w: Array) -> NDArray[np.complex128]:
        """Frequency response at w in rad/s."""
        s = 1j * w
        held = np.polyval(self.num, s) / np.polyval(self.den, s)
        return np.asarray(held * np.exp(-self.delay * s), np.complex128)

    @property
    def own_settling(self) -> float | None:
        """2 % settling time of its own step response in s; None where it does not settle."""
        slow = -float(np.roots(self.den).real.max(initial=-math.inf))
        if not 0.0 < slow < math.inf:
            return None
        rest = _own_settling(sampled_plant(replace(self, delay=0.0), 0.02 / slow))
        return None if rest is None else rest + self.delay

    def rational(self) -> Transfer:
        """The same with Pade's approximation of the dead time."""
        if not self.delay:
            return self
        num, den, factor = [1.0], [1.0], 1.0
        for k in range(1, _PADE + 1):
            factor *= self.delay * (_PADE - k + 1) / (k * (2 * _PADE - k + 1))
            num.insert(0, factor * (-1) ** k)
            den.insert(0, factor)
        num, den = np.polymul(self.num, num), np.polymul(self.den, den)
        return Transfer(num.astype(np.float64), den.astype(np.float64))


@dataclass(frozen=True)
class Specification:
    """Limits of a loop; None where there is none."""

    gain_margin: float | None = None
    """Least gain margin, as a factor."""
    phase_margin: float | None = None
    """Least phase margin in degrees."""
    settling_min: float | None = None
    settling_max: float | None = None
    """Limits of the time in s after which the step response stays within 2 %."""
    overshoot: float | None = None
    """Largest overshoot in %."""
    steady_state: float | None = None
    """Largest steady-state error of a unit step."""


@dataclass(frozen=True)
class LoopFigures:
    """Figures of a unity-feedback loop."""

    stable: bool
    gain_low: float
    """Largest factor below 1 at which the loop becomes unstable; 0 where there is none."""
    gain_high: float
    """Smallest such factor above 1."""
    phase_margin: float
    settling: float
    overshoot: float
    steady_state: float
    delay_margin: float = math.inf
    """Dead time in s that the loop bears in addition."""
    rise: float = 0.0
    """Time in s from 10 to 90 % of the step response."""
    settling_inside: float = 0.0
    """Settling time in s for a band that is a little narrower than 2 %: a response that touches the
    edge has another one."""
    tail: float = 0.0
    """Share of the step response in modes much slower than its rise."""
    load_settling: float = 0.0
    """Time in s after which a load at the input is compensated to 2 %; of LQR and MPC only, whose
    response to the set point does not show it."""

    @property
    def gain_margin(self) -> float:
        """The factor nearest to 1, as python-control and MATLAB give it: below 1 for an unstable
        plant whose gain may rise further than it may fall."""
        if self.gain_low * self.gain_high <= 1.0 or (not self.gain_low):
            return self.gain_high
        return self.gain_low

    def violations(self, wanted: Specification, reserve: float = 0.0) -> list[tuple[str, float]]:
        """Violated specifications with their relative excess."""
        if not self.stable:
            return [("stability", 10.0)]
        found: list[tuple[str, float]] = []
        if wanted.gain_margin is not None:
            # Both ends count: toward one end alone the nearest factor jumps.
            least = wanted.gain_margin * (1.0 + reserve)
            rise = max(math.log(least) - math.log(self.gain_high), 0.0)
            fall = 0.0
            if self.gain_low and math.isinf(self.gain_high):
                fall = 1.0 + max(math.log(least * self.gain_low), 0.0)
            elif self.gain_low:
                fall = max(math.log((1.0 + reserve) * self.gain_high * self.gain_low), 0.0)
            if rise + fall > 0:
                found.append(("gain margin", rise + fall))
        low = (
            ("phase margin", self.phase_margin, wanted.phase_margin),
            ("settling time too short", self.settling, wanted.settling_min),
        )
        longest = wanted.settling_max
        high = (
            ("settling time", max(self.settling, self.settling_inside * (reserve > 0)), longest),
            ("settling after a load", self.load_settling, longest and _LOAD * longest),
            ("overshoot", self.overshoot, wanted.overshoot),
            ("steady-state error", abs(self.steady_state), wanted.steady_state),
        )
        for name, value, limit in low:
            if limit is not None and not value >= limit * (1.0 + reserve):
                found.append((name, math.log(limit * (1.0 + reserve) / max(value, 1e-9 * limit))))
        for name, value, limit in high:
            if limit is not None and not value <= limit * (1.0 - reserve):
                excess = (value - limit * (1.0 - reserve)) / max(limit, 1e-12)
                found.append((name, math.log1p(min(excess, 1e9)) if np.isfinite(value) else 10.0))
        return found


# Name of a specification: figure of a loop, limit, "least" or "most", unit.
_LIMITS = {
    "gain margin": ("gain_margin", "gain_margin", "least", ""),
    "phase margin": ("phase_margin", "phase_margin", "least", " degrees"),
    "settling time too short": ("settling", "settling_min", "least", " s"),
    "settling time": ("settling", "settling_max", "most", " s"),
    "settling after a load": ("load_settling", "settling_max", "most", " s"),
    "overshoot": ("overshoot", "overshoot", "most", " %"),
    "steady-state error": ("steady_state", "steady_state", "most", ""),
}


def shortfalls(figures: Sequence[LoopFigures], wanted: Specification) -> list[str]:
    """Describe each specification that a loop does not meet, with the figure reached, on the worst
    of the loops."""
    worst: dict[str, tuple[float, LoopFigures]] = {}
    for one in figures:
        for name, excess in one.violations(wanted):
            if name not in worst or excess > worst[name][0]:
                worst[name] = excess, one
    found: list[str] = []
    for name, (_, one) in worst.items():
        if name not in _LIMITS:
            found.append("no stable loop")
            continue
        reached, limit, end, unit = _LIMITS[name]
        bound = getattr(wanted, limit) * (_LOAD if reached == "load_settling" else 1.0)
        word = name.removesuffix(" too short")
        value = abs(getattr(one, reached))
        found.append(f"{word} {value:.3g}{unit} of at {end} {bound:.3g}{unit}")
    return found


def loop_figures(plant: Transfer, controller: Transfer) -> LoopFigures:
    """Compute margins of L = C G and the step response of L / (1 + L)."""
    return _figures(controller.num[None], controller.den[None], plant)[0][0]


def _figures(num: Array, den: Array, plant: Transfer) -> tuple[list[LoopFigures], Array]:
    """Figures of the loops of many controllers.

    Args:
        num: numerators of the controllers (S, n), the highest power first
        den: denominators (S, m)

    Returns:
        The figures, and the largest real part of the poles of each loop (S,).
    """
    rational = plant.rational()
    above, below = _times(num, rational.num), _times(den, rational.den)
    width = max(above.shape[1], below.shape[1])
    characteristic = sum(
        np.pad(part, ((0, 0), (width - part.shape[1], 0))) for part in (above, below)
    )
    assert isinstance(characteristic, np.ndarray)
    sound = np.isfinite(characteristic).all(axis=1) & (np.abs(characteristic[:, 0]) > 1e-300)
    right = np.full(len(num), math.inf)
    figures = [LoopFigures(False, 1.0, 1.0, 0.0, math.inf, math.inf, math.inf)] * len(num)
    rows = np.flatnonzero(sound)
    poles = _roots(characteristic[rows])
    if not poles.size:
        return figures, right
    right[rows] = poles.real.max(axis=1)
    stable = right[rows] < 0
    rows, poles = rows[stable], poles[stable]
    above, below, characteristic = above[rows], below[rows], characteristic[rows]
    # Step response by residues of T(s) / s.
    powers = np.arange(width - 1, 0, -1)
    with np.errstate(all="ignore"):
        slopes = _polynomials(characteristic[:, :-1] * powers, poles) * poles
        residues = _polynomials(above, poles) / slopes
        final = above[:, -1] / characteristic[:, -1]
    sound = np.isfinite(residues).all(axis=1) & (np.abs(final) >= 1e-12)
    right[rows[~sound]] = math.inf
    rows, poles, residues, final = rows[sound], poles[sound], residues[sound], final[sound]
    above, below = above[sound], below[sound]
    if not len(rows):
        return figures, right
    response = _loop_response(num[rows], den[rows], plant)
    static = np.divide(above[:, -1], below[:, -1], where=below[:, -1] != 0,
                       out=np.full(len(rows), math.inf))  # fmt: skip
    low, high, phase, late = _margins(_frequencies(above, below), response, static[:, None])
    settling, inside, overshoot, rise, tail = _step_figures(poles, residues, final)
    for k, row in enumerate(rows):
        figures[row] = LoopFigures(
            True, float(low[k]), float(high[k]), float(phase[k]), float(settling[k]),
            float(overshoot[k]), 1.0 - float(final[k]), float(late[k]), float(rise[k]),
            float(inside[k]), float(tail[k]),
        )  # fmt: skip
    return figures, right


def _step_figures(
    poles: NDArray[np.complex128], residues: NDArray[np.complex128], final: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Settling time, that of a narrower band, overshoot in %, rise time and share of slow modes
    (S,) of step responses, from poles and residues (S, n) and final values (S,)."""
    size = np.abs(final)[:, None]
    weight = np.abs(residues) > 1e-3 * size
    weight |= ~weight.any(axis=1, keepdims=True)
    slow = np.where(weight, np.abs(poles.real), math.inf).min(axis=1)
    fast = np.where(weight, np.abs(poles), 0.0).max(axis=1)
    span = 8.0 / np.maximum(slow, 1e-12 * fast)
    # Fast modes end long before the slow ones, so the first part is logarithmic. The second one is
    # uniform: a product of a coarse and a fine part.
    first = np.clip(0.05 / fast, 1e-7 * span, 1e-3 * span)
    begin = np.geomspace(first, 0.02 * span, 150, axis=1)[:, :-1]
    step = 0.98 * span / (_TIMES - 1)
    fine = step[:, None] * np.arange(_BLOCK)
    coarse = 0.02 * span[:, None] + step[:, None] * np.arange(0, _TIMES, _BLOCK)
    t = np.concatenate([begin, (coarse[:, :, None] + fine[:, None, :]).reshape(len(span), -1)], 1)
    modes = [np.exp(part[:, :, None] * poles[:, None, :]) for part in (begin, coarse, fine)]
    early = np.real(modes[0] @ residues[:, :, None])[:, :, 0]
    later = np.real((modes[1] * residues[:, None, :]) @ modes[2].swapaxes(1, 2))
    y = final[:, None] + np.concatenate([early, later.reshape(len(span), -1)], axis=1)
    error, count, every = np.abs(y - final[:, None]), t.shape[1], np.arange(len(span))

    def settled(band: float) -> Array:
        away = error - band * size
        outside = away > 0
        last = count - 1 - np.argmax(outside[:, ::-1], axis=1)
        k = np.minimum(last, count - 2)
        before, after = away[every, k], away[every, k + 1]
        share = before / np.maximum(before - after, 1e-300)
        found = t[every, k] + (t[every, k + 1] - t[every, k]) * share
        found = np.where(last >= count - 1, math.inf, found)
        return np.where(outside.any(axis=1), found, 0.0)

    way = y / final[:, None]
    overshoot = 100.0 * np.maximum(way.max(axis=1) - 1.0, 0.0)
    rise = t[every, np.argmax(way >= 0.9, axis=1)] - t[every, np.argmax(way >= 0.1, axis=1)]
    creeping = np.abs(poles.real) * rise[:, None] < 2.2 * _CREEP
    tail = np.where(creeping, np.abs(residues), 0.0).sum(axis=1) / size[:, 0]
    inside = settled((1.0 - _RESERVE) * _BAND)
    return settled(_BAND), inside, overshoot, rise, tail


def _times(left: Array, right: Array) -> Array:
    """Products (S, n + m - 1) of polynomials (S, n) and of one (m,) or as many (S, m)."""
    right = np.atleast_2d(right)
    found = np.zeros((len(left), left.shape[1] + right.shape[1] - 1))
    for k in range(right.shape[1]):
        found[:, k : k + left.shape[1]] += left * right[:, k : k + 1]
    return found


def _polynomials(coefficients: Array, s: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Values (S, N) of polynomials (S, n), the highest power first, at s (S, N)."""
    found = np.broadcast_to(coefficients[:, :1], s.shape).astype(np.complex128)
    for k in range(1, coefficients.shape[1]):
        found = found * s + coefficients[:, k : k + 1]
    return found


def _roots(polynomials: Array) -> NDArray[np.complex128]:
    """Roots (S, n - 1) of polynomials (S, n) with coefficients of the highest power that are not
    0."""
    count, n = polynomials.shape[0], polynomials.shape[1] - 1
    companion = np.zeros((count, n, n))
    if n:
        companion[:, 0] = -polynomials[:, 1:] / polynomials[:, :1]
        companion[:, range(1, n), range(n - 1)] = 1.0
    return np.asarray(np.linalg.eigvals(companion), np.complex128)


def _frequencies(above: Array, below: Array) -> Array:
    """Frequencies (S, N) in rad/s around the corners of loops with numerators and denominators
    (S, n). A narrow resonance lies between the points of a grid, so its neighbourhood is added."""
    parts = [one[:, np.flatnonzero(one.any(axis=0))[0] :] for one in (above, below)]
    corners = np.abs(np.concatenate([_roots(one) for one in parts], axis=1))
    real = corners > 0
    low = np.where(real, corners, math.inf).min(axis=1, initial=math.inf)
    high = np.where(real, corners, 0.0).max(axis=1, initial=0.0)
    none = ~real.any(axis=1)
    low, high = np.where(none, 1.0, low), np.where(none, 1.0, high)
    factors = np.concatenate([1.0 - _NEAR, [1.0], 1.0 + _NEAR])
    near = np.where(real, corners, low[:, None])[:, :, None] * factors
    grid = np.geomspace(1e-3 * low, 1e3 * high, _GRID, axis=1)
    return np.sort(np.concatenate([grid, near.reshape(len(low), -1)], axis=1), axis=1)


# Frequency response of the loops `rows` (K,) at frequencies (K, N) or (K,) in rad/s.
_Response: TypeAlias = Callable[[NDArray[np.intp], Array], NDArray[np.complex128]]


def _loop_response(num: Array, den: Array, plant: Transfer) -> _Response:
    def response(rows: NDArray[np.intp], w: Array) -> NDArray[np.complex128]:
        at = w.reshape(len(rows), -1)
        s = np.asarray(1j * at, np.complex128)
        held = _polynomials(num[rows], s) / _polynomials(den[rows], s)
        return np.asarray(held * plant.response(at), np.complex128).reshape(w.shape)

    return response


def margins(
    w: Array, response: Callable[[Array], NDArray[np.complex128]], ends: Sequence[float] = ()
) -> tuple[float, float, float, float]:
    """Compute the margins of a loop from its frequency response.

    Args:
        w: frequencies in rad/s, rising
        response: frequency response of the loop at such frequencies
        ends: real values of the loop at frequency 0 and at the Nyquist frequency

    Returns:
        gain margins below and above 1, as factors, smallest phase margin in degrees and delay
        margin in s
    """
    found = _margins(
        w[None], lambda _, at: response(at.reshape(-1)).reshape(at.shape), np.array([ends])
    )
    low, high, phase, late = (float(one[0]) for one in found)
    return low, high, phase, late


def _margins(w: Array, response: _Response, ends: Array) -> tuple[Array, Array, Array, Array]:
    """Margins (S,) of many loops; w (S, N), ends (S, E) or (S, 0)."""
    count = len(w)
    held = response(np.arange(count), w)
    size = np.abs(held)
    low, high = np.zeros(count), np.full(count, math.inf)
    phase, late = np.full(count, math.inf), np.full(count, math.inf)
    rows, k = np.nonzero((size[:, :-1] > 1.0) != (size[:, 1:] > 1.0))
    if len(rows):
        before, after = np.log(size[rows, k]), np.log(size[rows, k + 1])
        at = w[rows, k] * (w[rows, k + 1] / w[rows, k]) ** (before / (before - after))
        angle = (np.degrees(np.angle(response(rows, at))) + 180.0) % 360.0
        np.minimum.at(late, rows, np.radians(angle) / at)
        angle = np.where(angle <= 180.0, angle, angle - 360.0)
        # The smallest one in size, with its sign.
        order = np.argsort(-np.abs(angle), kind="stable")
        phase[rows[order]] = angle[order]
    imaginary = held.imag
    rows, k = np.nonzero((imaginary[:, :-1] > 0) != (imaginary[:, 1:] > 0))
    before, after = imaginary[rows, k], imaginary[rows, k + 1]
    share = before / (before - after)
    real = held.real[rows, k] + share * (held.real[rows, k + 1] - held.real[rows, k])
    rows, k, share = rows[real < -1e-12], k[real < -1e-12], share[real < -1e-12]
    if len(rows):
        at = w[rows, k] * (w[rows, k + 1] / w[rows, k]) ** share
        gains = 1.0 / np.maximum(np.abs(response(rows, at).real), 1e-300)
    else:
        gains = np.zeros(0)
    places, e = (
        np.nonzero((ends < -1e-12) & np.isfinite(ends)) if ends.size else (rows[:0], rows[:0])
    )
    rows = np.concatenate([rows, places])
    gains = np.concatenate([gains, -1.0 / ends[places, e] if ends.size else np.zeros(0)])
    below = gains < 1.0
    np.maximum.at(low, rows[below], gains[below])
    np.minimum.at(high, rows[~below], gains[~below])
    return low, high, phase, late


# Structures, from simple to complex.


@dataclass(frozen=True)
class Structure:
    """Family of controllers with a gain of 1 at the frequency 1."""

    name: str
    integrates: bool = False
    """Whether there is a pole at 0."""
    pair: bool = False
    """Whether there is a pair of zeros, which may be complex."""
    zeros: int = 0
    poles: int = 0

    @property
    def parameters(self) -> int:
        """Number of corner frequencies."""
        return 2 * self.pair + self.zeros + self.poles

    @property
    def excess(self) -> int:
        """Poles more than zeros."""
        return self.integrates + self.poles - 2 * self.pair - self.zeros

    def make(self, corners: Array) -> tuple[Array, Array]:
        """Numerators (S, n) and denominators (S, m) from corner frequencies (S, parameters)."""
        ones = np.ones((len(corners), 1))
        num, den, k = ones, ones, 0
        if self.pair:
            k = 2
            num = np.hstack([ones, corners[:, :1], corners[:, :1] * corners[:, 1:2]])
        for place in range(k, k + self.zeros):
            num = _times(num, np.hstack([ones, corners[:, place : place + 1]]))
        if self.integrates:
            den = np.hstack([ones, 0.0 * ones])
        for place in range(k + self.zeros, self.parameters):
            den = _times(den, np.hstack([ones, corners[:, place : place + 1]]))
        at = np.full((len(corners), 1), 1j)
        gain = np.abs(_polynomials(num, at) / _polynomials(den, at))
        return num / gain, den


STRUCTURES = (
    Structure("P"),
    Structure("I", integrates=True),
    Structure("PI", integrates=True, zeros=1),
    Structure("lead-lag", zeros=1, poles=1),
    Structure("PID with filter", integrates=True, pair=True, poles=1),
    Structure("PI with lag", integrates=True, zeros=1, poles=1),
    Structure("PI with two lags", integrates=True, zeros=1, poles=2),
    Structure("two lead-lags", pair=True, poles=2),
    Structure("PID with two filters", integrates=True, pair=True, poles=2),
    Structure("PID with lead-lag", integrates=True, pair=True, zeros=1, poles=2),
    Structure("PID with lead-lag and filter", integrates=True, pair=True, zeros=1, poles=3),
)


@dataclass(frozen=True)
class Design:
    """Controller and the figures of its loop."""

    structure: str
    controller: Transfer | None
    """None for a controller by LQR or MPC, which treats the set point and the output apart."""
    figures: LoopFigures
    violated: tuple[str, ...]
    """Specifications that the best controller found does not meet."""
    weights: tuple[float, float] | None = None
    """Weights of squared errors and inputs, of LQR and MPC."""


def design(
    plants: Sequence[Transfer],
    wanted: Specification,
    *,
    seed: int = 0,
    effort: int = 80,
    report: Callable[[str], None] = lambda _: None,
) -> Design:
    """Design a controller that meets the specifications for every plant; the first one that does,
    from simple to complex structures.

    Args:
        plants: the plant, then others such as fold models; the worst one counts
        effort: generations of the optimisation of a structure, fewer where it makes no progress
        report: called with a sentence on each structure that misses a specification
    """
    from scipy.optimize import differential_evolution

    plant = plants[0]
    corners = np.abs(np.roots(plant.den))
    corners = corners[corners > 0]
    pace = float(np.exp(np.log(corners).mean())) if len(corners) else 1.0
    if wanted.settling_max is not None:
        pace = 4.0 / wanted.settling_max
    unstable = np.roots(plant.den).real.max(initial=-1.0) > 0
    # All parameters are positive: a plant that falls with its input gets a negative controller. A
    # stable one may begin in the other direction.
    end = 0 if unstable else -1
    ends = (float(part[np.flatnonzero(part)[end]]) for part in (plant.num, plant.den))
    sign = math.copysign(1.0, next(ends) / next(ends))
    # The gain of a loop around an unstable plant has a least value. A largest one beyond it, which
    # the nearest gain margin asks for, takes three poles more than zeros or a dead time.
    rolled = unstable and not plant.delay and wanted.gain_margin is not None
    excess = len(plant.den) - len(np.trim_zeros(plant.num, "f"))
    exact = plant.den[-1] != 0 and (wanted.steady_state or 1.0) < _INTEGRAL
    tried = [
        one
        for one in STRUCTURES
        if not (rolled and excess + one.excess < _EXCESS) and not (exact and not one.integrates)
    ]
    best: tuple[tuple[bool, float], Design] | None = None
    scaled = [Transfer(*_paced(one, pace), one.delay * pace) for one in plants]
    asked = _scaled(wanted, pace)
    fastest = max(float(np.roots(scaled[0].den).real.max(initial=0.0)), 1.0)

    def controllers(z: Array, structure: Structure) -> tuple[Array, Array]:
        """Controllers in the plant's own time from parameters (S, n). The first one is the
        frequency at which the loop has the gain 1, and the corners are in its unit: margins then
        depend little on how fast the loop is."""
        at = np.exp(z[:, :1])
        num, den = structure.make(np.exp(z[:, 1:]))
        size = np.maximum(np.abs(scaled[0].response(at)), 1e-300)
        num = num * at ** -np.arange(num.shape[1] - 1, -1, -1.0) * (sign / size)
        return num, den * at ** -np.arange(den.shape[1] - 1, -1, -1.0)

    def losses(z: Array, structure: Structure, reserve: float) -> Array:
        num, den = controllers(z.T, structure)
        total = np.zeros(len(num))
        for one in scaled:
            figures, right = _figures(num, den, one)
            each = [loss(figure, reserve) for figure in figures]
            total = np.maximum(total, each + np.arctan(right) * [not f.stable for f in figures])
        return total

    def loss(figures: LoopFigures, reserve: float) -> float:
        found = sum(value for _, value in figures.violations(asked, reserve))
        if found > 0:
            return _PREFERRED + found
        # Avoided where possible: a slow tail after a fast rise, and a loop much faster than asked,
        # which spends the input.
        slow = figures.tail / _TAIL - 1.0
        fast = 0.0 if unstable else math.log(4.0 / _FASTER / max(figures.settling, 1e-300))
        return min(max(0.1 * slow, 0.1 * fast, 0.0), _PREFERRED)

    for structure in tracked(tried, "structure"):
        bounds = [(-3.0, math.log(_SPEED * fastest))] + [(-8.0, 8.0)] * structure.parameters
        sought = differential_evolution(
            losses, bounds, args=(structure, _RESERVE),
            maxiter=_LAST * effort if structure is tried[-1] else effort, popsize=12, tol=1e-4,
            rng=np.random.default_rng(seed), polish=False, init="sobol", vectorized=True,
            updating="deferred", callback=_Progress().is_over,
        )  # fmt: skip
        # Back from the plant's own time: s is s / pace.
        num, den = (part[0] for part in controllers(sought.x[None], structure))
        controller = Transfer(*_unpaced(num, den, pace))
        each = [loop_figures(one, controller) for one in plants]
        missed = {name for one in each for name, _ in one.violations(wanted)}
        candidate = Design(structure.name, controller, each[0], tuple(sorted(missed)))
        rank = bool(missed), float(sought.fun)
        if best is None or rank < best[0]:
            best = rank, candidate
        # On the edge of a specification the next structure may do better.
        if not any(one.violations(wanted, _EDGE) for one in each):
            return candidate
        report(f"{structure.name}: {', '.join(shortfalls(each, wanted)) or 'only just enough'}")
    assert best is not None
    return best[1]


class _Progress:
    """Ends an optimisation that meets everything, or that gets no better for long."""

    def __init__(self) -> None:
        self.best, self.generations = math.inf, 0

    def is_over(self, intermediate_result: Any) -> bool:
        """Callback after a generation."""
        value = float(intermediate_result.fun)
        self.generations += 1
        if value < 0.99 * self.best:
            self.best, self.generations = value, 0
        return value <= 0 or self.generations >= _STALLED


def _paced(one: Transfer, pace: float) -> tuple[Array, Array]:
    """Coefficients for s in units of pace."""
    return _unpaced(one.num, one.den, 1.0 / pace)


def _unpaced(num: Array, den: Array, pace: float) -> tuple[Array, Array]:
    powers = [pace ** -np.arange(len(part) - 1, -1, -1.0) for part in (num, den)]
    num, den = num * powers[0], den * powers[1]
    return num / den[np.flatnonzero(den)[0]], den / den[np.flatnonzero(den)[0]]


def _scaled(wanted: Specification, pace: float) -> Specification:
    def times(value: float | None) -> float | None:
        return None if value is None else value * pace

    return replace(
        wanted, settling_min=times(wanted.settling_min), settling_max=times(wanted.settling_max)
    )


# The sampled controller.

# One sample of the simulated plant: state (n,) and input to output and next state.
PlantStep: TypeAlias = Callable[[Array, float], tuple[float, Array]]
Language: TypeAlias = Literal["python", "c", "st"]


@dataclass(frozen=True)
class SampledController:
    """v = C x + D (r, y), u is v within the limits, x[k+1] = A x + B (r, y, u), all in deviations
    from an operating point. B's column of u is the anti-windup."""

    a: Array
    b: Array
    c: Array
    d: Array
    sampling_time: float
    u0: float = 0.0
    y0: float = 0.0
    low: float = -math.inf
    high: float = math.inf
    rate: float = math.inf
    """Largest change of u in 1/s."""

    def started(self, u: float | None = None) -> Any:
        """The exported Python class, started from an input; None for that of the operating point.
        Its `step(r, y)` is what every simulation calls."""
        names: dict[str, Any] = {}
        exec(self.code("python"), names)
        return names["Controller"]() if u is None else names["Controller"](u)

    @property
    def about(self) -> str:
        """How the code is used."""
        return (
            f"Call once every {self.sampling_time:.12g} s: set point r and output y, read before "
            "the input changes, to the input u that is then held."
        )

    @property
    def rest(self) -> Array:
        """States (n,) at rest at the operating output, for an input 1 above u0; without an
        integral action the input has no such states, and they are 0."""
        n = len(self.c)
        left = np.eye(n) - self.a
        if not n or np.abs(np.linalg.eigvals(left)).min() < 1e-9:
            return np.zeros(n)
        x = np.linalg.solve(left, self.b[:, 2])
        holds = abs(float(self.c @ x) - 1.0) < 1e-6
        return np.array([float(f"{v:.12g}") for v in x]) if holds else np.zeros(n)

    def code(self, language: Language) -> str:
        """Source of one step function: a Python class, C99, or a function block in Structured Text
        (IEC 61131-3). The Python class and the C code start from an input: with r = y they hold
        it."""
        n, rest = len(self.c), self.rest
        state = {"python": "self.", "c": "s->", "st": ""}[language]
        least, most = {"python": ("min", "max"), "c": ("fmin", "fmax"), "st": ("MIN", "MAX")}[
            language
        ]

        def number(value: float) -> str:
            text = repr(float(value))
            return text if "e" not in text else f"{value:.17e}"

        u0 = number(self.u0)

        def total(values: Array, names: Sequence[str]) -> str:
            terms = [f"{number(v)} * {x}" for v, x in zip(values, names, strict=True) if v]
            return " + ".join(terms).replace("+ -", "- ") or "0.0"

        xs = [f"{state}x{i}" for i in range(n)]
        # Without an integral action the input at the start is the bias.
        bias = f"{state}bias" if not rest.any() else u0
        begin = [f"{number(v)} * (u - {u0})" if v else "0.0" for v in rest]
        last = f"{state}last"
        limited = "v"
        if math.isfinite(self.low):
            limited = f"{most}({limited}, {number(self.low)})"
        if math.isfinite(self.high):
            limited = f"{least}({limited}, {number(self.high)})"
        body = [
            ("dr", f"r - {number(self.y0)}".replace("- -", "+ ")),
            ("dy", f"y - {number(self.y0)}".replace("- -", "+ ")),
            (
                "v",
                f"{bias} + {total(np.concatenate([self.c, self.d]), [*xs, 'dr', 'dy'])}",
            ),
            ("u", limited),
        ]
        if math.isfinite(self.rate):
            change = number(self.rate * self.sampling_time)
            body.append(("u", f"{least}({most}(u, {last} - {change}), {last} + {change})"))
        if self.b[:, 2].any():
            body.append(("du", f"u - {number(self.u0)}".replace("- -", "+ ")))
        inputs = [*xs, "dr", "dy", "du"]
        body += [(f"n{i}", total(np.concatenate([self.a[i], self.b[i]]), inputs)) for i in range(n)]
        body += [*((f"{state}x{i}", f"n{i}") for i in range(n)), (last, "u")]
        about = self.about
        starts = [*zip(xs, begin, strict=True), *[(bias, "u")] * (not rest.any())]
        if language == "python":
            lines = "\n".join(f"        {name} = {value}" for name, value in body)
            zero = "".join(f"        {name} = {value}\n" for name, value in starts)
            return (
                f'class Controller:\n    """{about}"""\n\n    def __init__(self, u={u0}):\n'
                f"        self.last = u\n{zero}\n    def step(self, r, y):\n{lines}\n"
                "        return u\n"
            )
        if language == "c":
            known: set[str] = set()
            lines = ""
            for name, value in body:
                kind = "" if "->" in name or name in known else "double "
                known.add(name)
                lines += f"    {kind}{name} = {value};\n"
            fields = "".join(f" double {name.removeprefix(state)};" for name, _ in starts)
            return (
                f"/* {about} */\n#include <math.h>\n\n"
                f"typedef struct {{ double last;{fields} }} controller;\n\n"
                f"void controller_reset(controller *s, double u)\n{{\n    s->last = u;\n"
                + "".join(f"    {name} = {value};\n" for name, value in starts)
                + "}\n\ndouble controller_step(controller *s, double r, double y)\n{\n"
                + f"{lines}    return u;\n}}\n"
            )
        names = ", ".join(
            name for name in dict(body) if name not in {"u", "last", *(f"x{i}" for i in range(n))}
        )
        lines = "".join(f"    {name} := {value};\n" for name, value in body)
        held = "".join(
            f"    {name} : LREAL := {u0 if name == bias else '0.0'};\n" for name, _ in starts
        )
        return (
            f"(* {about} *)\nFUNCTION_BLOCK Controller\nVAR_INPUT\n    r : LREAL;\n"
            "    y : LREAL;\nEND_VAR\nVAR_OUTPUT\n    u : LREAL;\nEND_VAR\nVAR\n"
            f"    last : LREAL := {u0};\n{held}    {names} : LREAL;\nEND_VAR\n"
            f"{lines}END_FUNCTION_BLOCK\n"
        )


def sampled(
    controller: Transfer, sampling_time: float, *, u0: float = 0.0, y0: float = 0.0,
    limits: tuple[float, float] = (-math.inf, math.inf), rate: float = math.inf,
) -> SampledController:  # fmt: skip
    """Sample C(s) = ki / s + R(s): both parts by the trapezoidal rule, R by backward differences
    where a lag is shorter than a sample. The integral follows what the limits let through."""
    from scipy.signal import cont2discrete, tf2ss

    num, den, ki = controller.num, controller.den, 0.0
    if len(den) > 1 and den[-1] == 0:
        ki = float(num[-1] / den[-2])
        num, den = np.polysub(num, ki * den[:-1])[:-1], den[:-1]
        num = np.atleast_1d(num if len(num) else np.zeros(1))
    static = float(num[-1] / den[-1])
    fast = len(den) > 1 and float(np.abs(np.roots(den)).max()) * sampling_time > 1.0
    method = "backward_diff" if fast else "bilinear"
    system: Any = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[static]])
    if len(den) > 1:
        num = np.where(np.abs(num) > 1e-14 * np.abs(num).max(), num, 0.0)
        discrete: Any = cont2discrete(tf2ss(np.trim_zeros(num, "f"), den), sampling_time, method)
        system = discrete[:4]
    a, b, c, d = (np.asarray(part, np.float64) for part in system)
    gain = float(d[0, 0])
    row = c.reshape(-1)
    inputs = np.hstack([b, -b, np.zeros((len(a), 1))])
    if ki:
        gain += 0.5 * ki * sampling_time
        row = np.append(1.0, row)
        # The tracking time is the integral time, and at least a sample.
        track = sampling_time / max(abs(static / ki), sampling_time)
        above = np.append(1.0, np.zeros(len(a))) - track * row
        a = np.vstack([above, np.hstack([np.zeros((len(a), 1)), a])])
        push = ki * sampling_time - track * gain
        inputs = np.vstack([[push, -push, track], inputs])
    return SampledController(
        np.asarray(a, np.float64), inputs, row, np.array([gain, -gain]), sampling_time, u0, y0,
        *limits, rate,
    )  # fmt: skip


# The simulated loop.

# Distance from the operating point, in steps of the set point, from which a response diverges.
_DIVERGED = 1e12


@dataclass(frozen=True)
class SimulatedPlant:
    """One or several models, whose mean is the output."""

    name: str
    steps: Sequence[PlantStep]
    starts: Sequence[Array]
    lowered: Sequence[LoweredModel] = ()
    """The models of `steps`, where they are lowered."""


def zero_order_hold(plant: Transfer, sampling_time: float) -> SimulatedPlant:
    """The exact sampled plant between constant inputs, from rest; the dead time need not be a
    whole number of samples."""
    from scipy.signal import tf2ss

    system: Any = tf2ss(plant.num, plant.den)
    a, b, c, d = (np.atleast_2d(np.asarray(part, np.float64)) for part in system)
    n = len(a) if a.size else 0
    whole = int(plant.delay / sampling_time + 1e-9)
    part = max(plant.delay - whole * sampling_time, 0.0)
    times = (sampling_time, sampling_time - part, part)
    (move, _), (rest, new), (_, old) = (discretize(a[:n, :n], b[:n, :1], time) for time in times)
    new, old = new[:, 0], (rest @ old)[:, 0]

    def step(state: Array, u: float) -> tuple[float, Array]:
        x, inputs = state[:n], np.append(u, state[n:])
        seen = inputs[whole + 1] if part > 1e-9 * sampling_time else inputs[whole]
        after = move @ x + new * inputs[whole] + old * inputs[whole + 1]
        return float(c[0, :n] @ x + d[0, 0] * seen), np.concatenate([after, inputs[:-1]])

    return SimulatedPlant("plant", [step], [np.zeros(n + whole + 1)])


def sampled_plant(plant: Transfer, sampling_time: float) -> LinearModel:
    """Linear model of a plant between constant inputs."""
    held = zero_order_hold(plant, sampling_time)
    n, step = len(held.starts[0]), held.steps[0]
    each = [step(one[:n], float(one[n])) for one in np.eye(n + 1)]
    whole = np.stack([np.append(y, after) for y, after in each], axis=1)
    return LinearModel(
        whole[1:, :n], whole[1:, n:], whole[:1, :n], whole[:1, n:], sampling_time, np.zeros(1),
        np.zeros(1),
    )  # fmt: skip


def _own_settling(model: LinearModel) -> float | None:
    """2 % settling time in s of the step response of a sampled model; None where it does not
    settle, or settles to 0."""
    slow = spectral_radius(model.a)
    if not slow < 1.0 - 1e-6:
        return None
    # Each of equal lags in a row adds less than three time constants.
    lags = -1.0 / math.log(slow) if slow > 1e-6 else 1.0
    y = model.step_response(int(min((4 + 3 * model.order) * lags, _LONGEST_OWN)) + 20)[:, 0, 0]
    final = float(model.gain[0, 0])
    if abs(final) <= 1e-9 * np.abs(y).max():
        return None
    outside = np.flatnonzero(np.abs(y - final) > _BAND * abs(final))
    return model.sampling_time * (1 + int(outside[-1]) if len(outside) else 1)


def simulate_loop(
    controller: SampledController, plant: SimulatedPlant, r: Array, noise: Array | None = None
) -> tuple[Array, Array]:
    """Simulate a loop from its operating point with the exported controller.

    In each sample the controller reads the output, while the plant still has the input of the last
    sample, and sets the next input.

    Args:
        r: set points (T,)
        noise: measurement noise (T,)

    Returns:
        outputs and inputs (T,), NaN from where a model is not finite
    """
    y, u = np.full(len(r), math.nan), np.full(len(r), math.nan)
    states, last, code = list(plant.starts), controller.u0, controller.started()
    most = _DIVERGED * float(np.abs(r - controller.y0).max()) or math.inf
    for k, target in enumerate(r):
        seen = fmean(one(s, last)[0] for one, s in zip(plant.steps, states, strict=True))
        last = float(code.step(float(target), seen + (0.0 if noise is None else float(noise[k]))))
        found = [one(s, last) for one, s in zip(plant.steps, states, strict=True)]
        after, states = fmean(one[0] for one in found), [one[1] for one in found]
        if not (np.isfinite(after) and np.isfinite(last) and abs(after - controller.y0) < most):
            break
        y[k], u[k] = after, last
    return y, u


@dataclass(frozen=True)
class ResponseFigures:
    """Figures of the response to a step of the set point."""

    rise: float
    """Time in s from 10 to 90 % of the step; infinite where it does not get there."""
    settling: float
    """Time in s after which the output stays within 2 % of the step around the set point."""
    overshoot: float
    """In % of the step."""
    error: float
    """Error at the end, as a share of the step."""
    iae: float
    """Integrals of |e|, e^2 and t |e|."""
    ise: float
    itae: float
    effort: float
    """Sum of all changes of the input."""
    limited: float
    """Share of samples with the input at a limit."""


def response_figures(
    y: Array, u: Array, controller: SampledController, setpoint: float
) -> ResponseFigures:
    """Compute the figures of a response from the operating point to a set point."""
    step, time = setpoint - controller.y0, controller.sampling_time
    if not np.isfinite(y).all():
        none = math.inf
        return ResponseFigures(none, none, none, none, none, none, none, none, 1.0)
    error = setpoint - y
    way = 1.0 - error / step
    reached = [np.flatnonzero(way >= share) for share in (0.1, 0.9)]
    rise = time * float(reached[1][0] - reached[0][0]) if len(reached[1]) else math.inf
    outside = np.flatnonzero(np.abs(way - 1.0) > _BAND)
    settled = 0 if not len(outside) else int(outside[-1]) + 1
    at = np.minimum(u - controller.low, controller.high - u) <= 1e-9 * np.ptp(u)
    size, t = np.abs(error), time * np.arange(len(y))
    return ResponseFigures(
        rise, time * settled if settled < len(y) else math.inf,
        100.0 * max(float(way.max()) - 1.0, 0.0), float(abs(error[-1] / step)),
        time * float(size.sum()), time * float((error**2).sum()), time * float((t * size).sum()),
        float(np.abs(np.diff(u, prepend=controller.u0)).sum()), float(at.mean()),
    )  # fmt: skip


# The sampled loop of a linear plant, without limits.


@dataclass(frozen=True)
class ControlledPlant:
    """Linear plant with the state that the controller sees: x[k+1] = A x[k] + B u[k]. It sees C x,
    where the input is still the last one; the output of the sample is E x + F u."""

    a: Array
    b: Array
    c: Array
    e: Array
    f: float

    @classmethod
    def of(cls, model: LinearModel) -> ControlledPlant:
        """Plant of a sampled linear model with one input and one output; its last input is a state
        where it acts on the output at once."""
        direct = float(model.d[0, 0])
        if not direct:
            return cls(model.a, model.b, model.c, model.c, 0.0)
        n = model.order
        a = np.block([[model.a, np.zeros((n, 1))], [np.zeros((1, n + 1))]])
        seen, own = (np.append(model.c[0], value)[None] for value in (direct, 0.0))
        return cls(a, np.vstack([model.b, np.ones((1, 1))]), seen, own, direct)


def spectral_radius(a: Array) -> float:
    """Size of the largest eigenvalue."""
    return float(np.abs(np.linalg.eigvals(a)).max(initial=0.0))


def sampled_loop_figures(
    plant: ControlledPlant, controller: SampledController, load: float | None = None
) -> LoopFigures:
    """Compute margins at the input of the plant, and the responses to steps of the set point and of
    a load at the input of this size, of a sampled loop without limits."""
    n, c, d = len(plant.a), controller.c[None], controller.d
    inner = controller.a + controller.b[:, 2:] @ c
    into = controller.b[:, :2] + controller.b[:, 2:] * d
    a = np.block([
        [plant.a + d[1] * plant.b @ plant.c, plant.b @ c],
        [into[:, 1:] @ plant.c, inner],
    ])  # fmt: skip
    radius = spectral_radius(a)
    if not radius < 1.0 - 1e-9:
        return LoopFigures(False, 1.0, 1.0, 0.0, math.inf, math.inf, math.inf)
    time = controller.sampling_time

    def response(w: Array) -> NDArray[np.complex128]:
        z = np.exp(1j * w * time)[:, None, None]
        there = plant.c @ np.linalg.solve(z * np.eye(n) - plant.a, plant.b + 0j)
        back = c @ np.linalg.solve(z * np.eye(len(inner)) - inner, into[:, 1:] + 0j) + d[1]
        return np.asarray(-(there * back)[:, 0, 0], np.complex128)

    nyquist = math.pi / time
    w = np.geomspace(1e-5 * nyquist, nyquist, _SAMPLED_GRID)
    for matrix in (plant.a, inner):
        poles = np.linalg.eigvals(matrix)
        corners = np.abs(np.log(poles[np.abs(poles) > 1e-6] + 0j)) / time
        w = np.append(w, np.outer(corners, (0.97, 0.99, 1.0, 1.01, 1.03)).reshape(-1))
    w = np.unique(w[(w >= 1e-5 * nyquist) & (w <= nyquist)])
    last = float(response(np.array([nyquist]))[0].real)
    low, high, phase, late = margins(w, response, (last,))
    samples = int(min(max(math.log(1e-4) / math.log(max(radius, 1e-3)), 50), _LONGEST))
    push = np.stack([
        np.concatenate([plant.b[:, 0] * d[0], into[:, 0]]),
        np.concatenate([plant.b[:, 0] * (load or 0.0), np.zeros(len(inner))]),
    ], axis=1)  # fmt: skip
    row = np.concatenate([plant.e + plant.f * d[1] * plant.c, plant.f * c], axis=1)[0]
    direct = plant.f * np.array([d[0], load or 0.0])
    x, y = np.zeros((len(a), 2)), np.empty((samples, 2))
    for k in range(samples):
        y[k] = row @ x + direct
        x = a @ x + push
    one, other = (
        response_figures(part, np.zeros(samples), replace(controller, u0=0.0, y0=0.0), 1.0)
        for part in (y[:, 0], 1.0 + y[:, 1])
    )
    final = float(row @ np.linalg.solve(np.eye(len(a)) - a, push[:, 0]) + direct[0])
    return LoopFigures(
        True, low, high, phase, one.settling, one.overshoot, 1.0 - final, late, one.rise,
        load_settling=0.0 if load is None else other.settling,
    )  # fmt: skip


# A design that also meets its specifications in the simulated loop.

# Samples of a simulation, and designs of which each asks for more than the last one.
_SHORTEST, _LONGEST, _TRIES = 100, 3_000, 4


@dataclass(frozen=True)
class Loop:
    """Plants of a design, and the step of the set point that is simulated."""

    name: str
    labels: tuple[str, ...]
    """`loop` for the model to use, then those of the other models."""
    plants: list[Transfer]
    simulated: list[SimulatedPlant]
    """The same, nonlinear where they come from a run; then the mean of the fold models."""
    sampling_time: float
    """In s; 0 for a 200th of the settling time."""
    u0: float = 0.0
    y0: float = 0.0
    setpoint: float = 1.0
    noise: float = 0.0
    """Standard deviation of the measurement noise of y."""
    error: float = 0.0
    """RMSE of the model of y on held-out data; 0 where it is not known."""
    u_range: tuple[float, float] = (-math.inf, math.inf)
    """Smallest and largest input of the training records."""
    u: str = "u"
    y: str = "y"
    models: list[LinearModel] = field(default_factory=list[LinearModel])
    """Sampled linear models of the plants, for LQR and MPC."""

    @property
    def unmodelled(self) -> float:
        """Share of the step that all models miss: the part of their error on held-out data that is
        no measurement noise."""
        missing = math.sqrt(max(self.error**2 - self.noise**2, 0.0))
        return missing / abs(self.setpoint - self.y0)

    def sampled(self) -> Loop:
        """Loop with the sampled linear models and the simulated plant of transfer functions, exact
        for held inputs."""
        if self.models:
            return self
        models = [minimal(sampled_plant(one, self.sampling_time)) for one in self.plants]
        held = zero_order_hold(self.plants[0], self.sampling_time)
        return replace(self, models=models, simulated=[replace(held, name="loop")])

    @property
    def own_settling(self) -> float | None:
        """2 % settling time of the first plant in s; None where it does not settle."""
        return self.plants[0].own_settling if self.plants else _own_settling(self.models[0])


@dataclass(frozen=True)
class SimulatedDesign:
    """Controller of a loop with its figures."""

    loop: Loop
    design: Design
    figures: list[LoopFigures]
    """Those of the linear plants."""
    controller: SampledController
    target: Array
    """Set points (T,) of the simulation."""
    responses: list[tuple[Array, Array]]
    """Outputs and inputs (T,) of each simulated plant."""
    judged: list[ResponseFigures]
    missed: list[str]
    """Sentences on specifications that the simulation does not meet."""

    @property
    def shortfalls(self) -> tuple[str, ...]:
        """Everything that is missed, by the linear plants and in simulation."""
        return *self.design.violated, *self.missed


@dataclass(frozen=True)
class Limits:
    """Limits of the input."""

    low: float = -math.inf
    high: float = math.inf
    rate: float = math.inf
    """Largest change in 1/s."""


# Loop and specifications to the loop with its sampling time and simulated plants, the design, its
# figures on each linear plant, and the sampled controller.
Designer: TypeAlias = Callable[
    [Loop, Specification], tuple[Loop, Design, list[LoopFigures], SampledController]
]


def pid_designer(
    limits: Limits, seed: int = 0, report: Callable[[str], None] = lambda _: None
) -> Designer:
    """Designer of P to PID with lead-lag by `design`, which calls `report`."""

    def designed(
        loop: Loop, wanted: Specification
    ) -> tuple[Loop, Design, list[LoopFigures], SampledController]:
        # A sampled controller acts half a sample late, and the plants do not have that.
        wait = 0.5 * loop.sampling_time
        plants = [replace(one, delay=one.delay + wait) for one in loop.plants]
        found = design(plants, wanted, seed=seed, report=report)
        assert found.controller is not None
        each = [loop_figures(one, found.controller) for one in plants]
        slow = max((one.settling for one in each if math.isfinite(one.settling)), default=1.0)
        time, known = loop.sampling_time, bool(loop.sampling_time)
        if not known:
            time = float(f"{(slow or 1.0) / 200.0:.1g}")
        of, controller, each = sampled_design(loop, found.controller, time)
        # Shorter samples where the sampled loop misses what the continuous one has.
        for k in range(1, 0 if known else _FINER):
            if {n for one in each for n, _ in one.violations(wanted)} <= set(found.violated):
                break
            of, controller, each = sampled_design(
                loop, found.controller, float(f"{time / 2**k:.1g}")
            )
        return of, found, each, controller

    def sampled_design(
        loop: Loop, continuous: Transfer, time: float
    ) -> tuple[Loop, SampledController, list[LoopFigures]]:
        of = replace(loop, sampling_time=time).sampled()
        made = sampled(continuous, time, u0=loop.u0, y0=loop.y0,
                       limits=(limits.low, limits.high), rate=limits.rate)  # fmt: skip
        each = [sampled_loop_figures(ControlledPlant.of(one), made) for one in of.models]
        return of, made, each

    return designed


def design_in_simulation(loop: Loop, wanted: Specification, designer: Designer) -> SimulatedDesign:
    """Design a controller for all plants of a loop, and simulate it. Where the sampled loop or the
    simulation misses what the designer meets, it is asked for more by the same share, a few
    times."""
    parts = designer(loop, wanted)
    asked, made = wanted, _simulated(*parts, wanted)
    for _ in tracked(range(_TRIES - 1), "try"):
        longest = max(one.settling for one in [*made.judged, *made.figures])
        if parts[1].violated or not made.shortfalls or not math.isfinite(longest):
            break
        asked = _tightened(asked, wanted, made, longest)
        again = _simulated(*designer(made.loop, asked), wanted)
        # A faster loop at its limits may not settle at all.
        settles = all(math.isfinite(one.settling) for one in again.judged)
        if not settles or len(again.shortfalls) > len(made.shortfalls):
            break
        made = again
    return made


def _tightened(
    asked: Specification, wanted: Specification, made: SimulatedDesign, longest: float
) -> Specification:
    """Ask for more of each specification that a design misses, by the share that it misses."""
    most = max(one.overshoot for one in [*made.judged, *made.figures])
    if asked.settling_max is not None and wanted.settling_max is not None:
        # Less than what the linear plants reached, which may be faster than asked.
        share = min(0.97 * wanted.settling_max / longest, 1.0)
        linear = max(one.settling for one in made.figures) if share < 1.0 else math.inf
        asked = replace(asked, settling_max=min(asked.settling_max, linear) * share)
    if asked.overshoot is not None and wanted.overshoot is not None:
        share = min(0.97 * wanted.overshoot / max(most, 1e-9), 1.0)
        asked = replace(asked, overshoot=asked.overshoot * share)
    if asked.gain_margin is not None and wanted.gain_margin is not None:
        least = min(one.gain_high for one in made.figures)
        if least < wanted.gain_margin:
            asked = replace(
                asked, gain_margin=1.03 * asked.gain_margin * wanted.gain_margin / least
            )
    if asked.phase_margin is not None and wanted.phase_margin is not None:
        less = wanted.phase_margin - min(one.phase_margin for one in made.figures)
        if less > 0:
            asked = replace(asked, phase_margin=asked.phase_margin + less + 1.0)
    return asked


def _simulated(
    loop: Loop, found: Design, each: list[LoopFigures], controller: SampledController,
    wanted: Specification,
) -> SimulatedDesign:  # fmt: skip
    slow = max((one.settling for one in each if math.isfinite(one.settling)), default=0.0)
    samples = int(min(max(6.0 * slow / loop.sampling_time, _SHORTEST), _LONGEST))
    target = np.full(samples, loop.setpoint)
    responses = [simulate_loop(controller, one, target) for one in loop.simulated]
    judged = [response_figures(y, u, controller, loop.setpoint) for y, u in responses]
    violated = {name for one in each for name, _ in one.violations(wanted)}
    found = replace(found, figures=each[0], violated=tuple(sorted(violated)))
    missed = _missed(loop, judged, wanted)
    return SimulatedDesign(loop, found, each, controller, target, responses, judged, missed)


def _missed(loop: Loop, judged: Sequence[ResponseFigures], wanted: Specification) -> list[str]:
    """Sentences on the specifications that responses do not meet, on the worst model of each."""
    found: list[str] = []
    rows = list(zip(loop.simulated, judged, strict=True))
    far, most = max(rows, key=lambda row: row[1].error), max(rows, key=lambda row: row[1].overshoot)
    slow = max(rows, key=lambda row: row[1].settling)
    if not far[1].error <= 0.02:
        reason = (
            "it diverges" if math.isinf(far[1].error) else f"it is {100 * far[1].error:.3g} % off"
        )
        held = ", with the input at a limit" if far[1].limited > 0.5 else ""
        return [f"in simulation {far[0].name} does not reach the set point: {reason}{held}"]
    if wanted.overshoot is not None and most[1].overshoot > wanted.overshoot:
        found.append(f"in simulation the overshoot of {most[0].name} is {most[1].overshoot:.3g} %")
    longest = wanted.settling_max
    if longest is not None and slow[1].settling > longest + loop.sampling_time:
        found.append(f"in simulation {slow[0].name} settles in {slow[1].settling:.4g} s")
    return found
