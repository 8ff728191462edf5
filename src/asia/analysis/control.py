"""Controllers for a linear plant with one input and one output, by optimisation over structures.

A controller of a few parameters is sought that meets all specifications of the unity-feedback loop:
structures from simple to complex, each by differential evolution (Storn and Price, J. Global
Optim. 11, 1997) on the violated specifications. Margins and step response are computed from the
frequency response, poles and residues, without a simulation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from asia.data.trajectory import Array

# Order of Pade's approximation of a dead time in the poles of the closed loop.
_PADE = 3
_GRID, _TIMES = 400, 600
_BAND = 0.02
_NEAR = np.geomspace(1e-4, 0.3, 12)
# Reserve that the optimisation asks for beyond each specification.
_RESERVE = 0.02


def product(*factors: Sequence[float] | Array) -> Array:
    """Product of polynomials."""
    found = np.ones(1)
    for factor in factors:
        found = np.asarray(np.polymul(found, factor), np.float64)
    return found


@dataclass(frozen=True)
class Transfer:
    """Rational transfer function and a dead time."""

    num: Array
    """Coefficients, the highest power first."""
    den: Array
    delay: float = 0.0
    """In s."""

    def times(self, other: Transfer) -> Transfer:
        """The series connection."""
        return Transfer(
            product(self.num, other.num), product(self.den, other.den),
            self.delay + other.delay,
        )  # fmt: skip

    def response(self, w: Array) -> NDArray[np.complex128]:
        """Frequency response at w in rad/s."""
        s = 1j * w
        held = np.polyval(self.num, s) / np.polyval(self.den, s)
        return np.asarray(held * np.exp(-self.delay * s), np.complex128)

    def rational(self) -> Transfer:
        """The same with Pade's approximation of the dead time."""
        if not self.delay:
            return self
        num, den, factor = [1.0], [1.0], 1.0
        for k in range(1, _PADE + 1):
            factor *= self.delay * (_PADE - k + 1) / (k * (2 * _PADE - k + 1))
            num.insert(0, factor * (-1) ** k)
            den.insert(0, factor)
        return Transfer(product(self.num, num), product(self.den, den))


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
        high = (
            ("settling time", self.settling, wanted.settling_max),
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


def loop_figures(plant: Transfer, controller: Transfer) -> LoopFigures:
    """Compute margins of L = C G and the step response of L / (1 + L)."""
    loop = controller.times(plant)
    rational = loop.rational()
    characteristic = np.polyadd(rational.den, rational.num)
    nothing = LoopFigures(False, 1.0, 1.0, 0.0, math.inf, math.inf, math.inf)
    if not np.isfinite(characteristic).all() or abs(characteristic[0]) < 1e-300:
        return nothing
    poles = np.roots(characteristic)
    if not len(poles) or poles.real.max() >= 0:
        return nothing
    gain_low, gain_high, phase = _margins(loop, rational)
    # Step response by residues of T(s) / s.
    slopes = np.polyval(np.polyder(characteristic), poles) * poles
    with np.errstate(all="ignore"):
        residues = np.polyval(rational.num, poles) / slopes
    final = float(rational.num[-1] / characteristic[-1]) if len(rational.num) else 0.0
    if not np.isfinite(residues).all() or abs(final) < 1e-12:
        return nothing
    weight = np.abs(residues) > 1e-3 * abs(final)
    slow = np.abs(poles.real[weight]).min() if weight.any() else np.abs(poles.real).min()
    span = min(max(8.0 / slow, 1e-9), 1e9)
    t = np.concatenate([np.geomspace(1e-4 * span, 0.02 * span, 60)[:-1],
                        np.linspace(0.02 * span, span, _TIMES)])  # fmt: skip
    y = final + np.real(np.exp(np.outer(t, poles)) @ residues)
    outside = np.flatnonzero(np.abs(y - final) > _BAND * abs(final))
    settling = 0.0
    if len(outside):
        k = int(outside[-1])
        if k + 1 >= len(t):
            settling = math.inf
        else:
            edge = np.abs(y[[k, k + 1]] - final) - _BAND * abs(final)
            settling = float(t[k] + (t[k + 1] - t[k]) * edge[0] / max(edge[0] - edge[1], 1e-300))
    overshoot = 100.0 * max(float((y / final).max()) - 1.0, 0.0)
    return LoopFigures(True, gain_low, gain_high, phase, settling, overshoot, 1.0 - final)


def _margins(loop: Transfer, rational: Transfer) -> tuple[float, float, float]:
    """Gain margins below and above 1, as factors, and smallest phase margin in degrees."""
    corners = np.abs(np.concatenate([np.roots(rational.num), np.roots(rational.den)]))
    corners = corners[corners > 0]
    low, high = (corners.min(), corners.max()) if len(corners) else (1.0, 1.0)
    # A narrow resonance lies between the points of a grid, so its neighbourhood is added.
    near = np.outer(corners, np.concatenate([1.0 - _NEAR, [1.0], 1.0 + _NEAR])).reshape(-1)
    w = np.unique(np.concatenate([np.geomspace(1e-3 * low, 1e3 * high, _GRID), near]))
    held = loop.response(w)
    size = np.abs(held)
    crossing = np.flatnonzero((size[:-1] - 1.0) * (size[1:] - 1.0) < 0)
    phases: list[float] = []
    for k in crossing:
        share = math.log(size[k]) / (math.log(size[k]) - math.log(size[k + 1]))
        at = w[k] * (w[k + 1] / w[k]) ** share
        angle = math.degrees(np.angle(loop.response(np.array([at]))[0]))
        phases.append((angle + 180.0) % 360.0)
    phases = [one if one <= 180.0 else one - 360.0 for one in phases]
    gains: list[float] = []
    if rational.den[-1] and rational.num[-1] / rational.den[-1] < 0:
        gains.append(abs(float(rational.den[-1] / rational.num[-1])))
    imaginary = held.imag
    for k in np.flatnonzero(imaginary[:-1] * imaginary[1:] < 0):
        share = imaginary[k] / (imaginary[k] - imaginary[k + 1])
        real = held.real[k] + share * (held.real[k + 1] - held.real[k])
        if real < -1e-12:
            at = w[k] * (w[k + 1] / w[k]) ** share
            gains.append(1.0 / max(abs(loop.response(np.array([at]))[0].real), 1e-300))
    phase = min(phases, key=abs, default=math.inf)
    low = max((one for one in gains if one < 1.0), default=0.0)
    return low, min((one for one in gains if one >= 1.0), default=math.inf), phase


# Structures, from simple to complex. Parameters are logarithms, in units of the plant's own time.


@dataclass(frozen=True)
class Structure:
    """Family of controllers."""

    name: str
    parameters: int
    make: Callable[[Array], tuple[Array, Array]]
    """Parameters, positive, to numerator and denominator."""


STRUCTURES = (
    Structure("P", 1, lambda p: (np.array([p[0]]), np.ones(1))),
    Structure("I", 1, lambda p: (np.array([p[0]]), np.array([1.0, 0.0]))),
    Structure("PI", 2, lambda p: (p[0] * np.array([1.0, p[1]]), np.array([1.0, 0.0]))),
    Structure(
        "lead-lag", 3, lambda p: (p[0] * np.array([1.0, p[1]]), np.array([1.0, p[2]]))
    ),
    Structure(
        "PID with filter", 4,
        lambda p: (p[0] * np.array([1.0, p[1], p[1] * p[2]]), product([1.0, 0.0], [1.0, p[3]])),
    ),
    Structure(
        "PI with lag", 3,
        lambda p: (p[0] * np.array([1.0, p[1]]), product([1.0, 0.0], [1.0, p[2]])),
    ),
    Structure(
        "PI with two lags", 4,
        lambda p: (p[0] * np.array([1.0, p[1]]), product([1.0, 0.0], [1.0, p[2]], [1.0, p[3]])),
    ),
    Structure(
        "two lead-lags", 5,
        lambda p: (
            p[0] * np.array([1.0, p[1], p[1] * p[2]]),
            product([1.0, p[3]], [1.0, p[4]]),
        ),
    ),
    Structure(
        "PID with two filters", 5,
        lambda p: (
            p[0] * np.array([1.0, p[1], p[1] * p[2]]),
            product([1.0, 0.0], [1.0, p[3]], [1.0, p[4]]),
        ),
    ),
    Structure(
        "PID with lead-lag", 6,
        lambda p: (
            p[0] * product([1.0, p[1], p[1] * p[2]], [1.0, p[3]]),
            product([1.0, 0.0], [1.0, p[4]], [1.0, p[5]]),
        ),
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Design:
    """Controller and the figures of its loop."""

    structure: str
    controller: Transfer
    figures: LoopFigures
    violated: tuple[str, ...]
    """Specifications that the best controller found does not meet."""


def design(
    plants: Sequence[Transfer], wanted: Specification, *, seed: int = 0, effort: int = 80
) -> Design:
    """Design a controller that meets the specifications for every plant; the first one that does,
    from simple to complex structures.

    Args:
        plants: the plant, then others such as fold models; the worst one counts
        effort: generations of the optimisation of a structure
    """
    from scipy.optimize import differential_evolution

    plant = plants[0]
    corners = np.abs(np.roots(plant.den))
    corners = corners[corners > 0]
    pace = float(np.exp(np.log(corners).mean())) if len(corners) else 1.0
    if wanted.settling_max is not None:
        pace = max(4.0 / wanted.settling_max, 1e-12)
    size = float(np.abs(plant.response(np.array([pace])))[0]) or 1.0
    # All parameters are positive: a plant that falls with its input gets a negative controller.
    size = math.copysign(size, float(plant.num[np.flatnonzero(plant.num)[0]] / plant.den[0]))
    best: tuple[tuple[bool, float], Design] | None = None

    def loss(z: Array, structure: Structure, reserve: float) -> float:
        num, den = structure.make(np.exp(z))
        controller = Transfer(num / size, den)
        total = 0.0
        for one in plants:
            scaled = Transfer(*_paced(one, pace), one.delay * pace)
            figures = loop_figures(scaled, controller)
            total = max(
                total, sum(v for _, v in figures.violations(_scaled(wanted, pace), reserve))
            )
            if not figures.stable:
                rational = controller.times(scaled).rational()
                poles = np.roots(np.polyadd(rational.den, rational.num))
                total = max(total, 10.0 + float(np.arctan(poles.real.max())) if len(poles) else 20)
        return total

    for structure in STRUCTURES:
        bounds = [(-9.0, 9.0)] + [(-7.0, 9.0)] * (structure.parameters - 1)
        sought = differential_evolution(
            loss, bounds, args=(structure, _RESERVE), maxiter=effort, popsize=12, tol=1e-4,
            rng=np.random.default_rng(seed), polish=False, init="sobol",
            callback=lambda intermediate_result: intermediate_result.fun <= 0,
        )  # fmt: skip
        num, den = structure.make(np.exp(sought.x))
        # Back from the plant's own time: s is s / pace.
        controller = Transfer(*_unpaced(num / size, den, pace))
        figures = loop_figures(plant, controller)
        missed = {
            name for one in plants for name, _ in loop_figures(one, controller).violations(wanted)
        }
        candidate = Design(structure.name, controller, figures, tuple(sorted(missed)))
        rank = bool(missed), float(sought.fun)
        if best is None or rank < best[0]:
            best = rank, candidate
        if not missed:
            return candidate
    assert best is not None
    return best[1]


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
