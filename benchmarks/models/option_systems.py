"""Systems with one effect each that an option of the library is for, and without it.

Two tanks one above the other, whose equations (`TANKS`) know nothing of the effect, and two plants
with symmetries and without equations. Numbers, inputs and noise follow from a seed; the noise-free
outputs are known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.problem import Bounds, Correction, ParameterRange, Physics, Prior

Array = NDArray[np.float64]
Slope = Callable[[Array, Array], Array]
"""State (n,) and held input (nu,) -> rate (n,)."""

SETTLE = 100
FULL = 7.0

TANKS = Physics(
    states=("x1", "x2"),
    parameters={name: ParameterRange(1e-2, 1.0) for name in ("k1", "k2", "k3", "k4")},
    dynamics={"x1": "-k1*sqrt(x1) + k4*u", "x2": "k2*sqrt(x1) - k3*sqrt(x2)"},
    observation={"y": "x2"},
    bounds={"x1": Bounds(0.0), "x2": Bounds(0.0)},
)
"""Equations of the tanks as the user knows them."""
ALIKE = replace(
    TANKS,
    priors={
        "k2/k1": Prior(1.0, 0.1, "what leaves the upper tank enters the lower one, of its size"),
        "k3/k1": Prior(1.0, 0.1, "alike outlets"),
    },
)
"""Equations of the tanks, with the prior knowledge that the tanks are alike."""
UNLIKE = replace(
    TANKS, priors={"k2/k1": Prior(1.5, 0.1, "a mistake"), "k3/k1": Prior(0.7, 0.1, "a mistake")}
)
"""Equations of the tanks, with priors that are wrong."""
LEVELS = replace(TANKS, observation={"upper": "x1", "lower": "x2"})
"""Equations of the tanks, both levels measured."""

PLANAR = Physics(
    states=("v", "roll", "w"),
    parameters={"gain": ParameterRange(0.5, 20.0)},
    corrections={"force": Correction(1.0), "torque": Correction(5.0)},
    definitions={"difference": "left**2 - right**2"},
    dynamics={"v": "-9.81*roll + force", "roll": "w", "w": "gain*difference + torque"},
)
"""Equations of a planar vehicle as the user knows them."""


@dataclass(frozen=True)
class System:
    """Records of a system, with the context of a fit."""

    training: list[Trajectory]
    """Measured."""
    fresh: Trajectory
    """Measured, never trained on."""
    truth: Array
    """Noise-free outputs of the fresh record (T, ny)."""
    context: Context
    """Context that a candidate receives."""


@dataclass(frozen=True)
class TankEffects:
    """Effects that the equations of the tanks do not contain; the defaults are without effect."""

    sensor: float = 1.0
    """Exponent of the sensor's curve."""
    drift: float = 0.0
    """Standard deviation of a slow (Ornstein-Uhlenbeck) disturbance of the output, relative to
    that of the output."""
    drift_time: float = 40.0
    """Time constant of the disturbance, in s."""
    pipe: float = 0.0
    """Time constant of the flow between the tanks, in s."""
    rim: float = np.inf
    """Level of the upper tank from which water runs over its rim, the faster the higher."""
    bumps: float = 0.0
    """Relative change of the lower outlet's flow with the level, to and fro."""
    threshold: float = 0.0
    """Voltage below which the pump delivers nothing."""
    slowness: float = 1.0
    """Factor on all time constants."""
    noise: float = 0.01
    """Standard deviation of white noise, relative to that of the output."""
    samples: int = 500
    """Number of samples of the training record."""
    past: int = 10
    """Samples of a past window."""


def tanks(effects: TankEffects, seed: int, physics: Physics = TANKS) -> System:
    """Two alike tanks: every flow constant is within some percent of the others."""
    rng = np.random.default_rng([seed, 1])
    k1 = rng.uniform(0.25, 0.35) / effects.slowness
    k2, k3, k4 = k1 * (1.0 + 0.05 * rng.standard_normal(3))
    e = effects

    def slope(x: Array, u: Array) -> Array:
        upper, lower, flow = x
        out1, out2 = k1 * max(upper, 0.0) ** 0.5, k3 * max(lower, 0.0) ** 0.5
        out2 *= 1.0 + e.bumps * np.sin(2.0 * np.pi * lower / 4.0)
        over = 0.1 * max(upper - e.rim, 0.0) ** 1.5
        between = k2 * max(upper, 0.0) ** 0.5
        entering = between if e.pipe == 0.0 else flow
        late = 0.0 if e.pipe == 0.0 else (between - flow) / e.pipe
        pump = k4 * max(u[0] - e.threshold, 0.0)
        return np.array([pump - out1 - over, entering - out2, late])

    outputs = [Signal(name) for name in physics.observation]

    def respond(u: Array) -> Array:
        levels = integrated(slope, np.array([2.0, 2.0, k2 * 2.0**0.5]), u, 1.0)[:, :2]
        levels = levels[:, 2 - len(outputs) :]
        return FULL * (np.maximum(levels, 0.0) / FULL) ** e.sensor

    def excite(numbers: np.random.Generator, length: int) -> Array:
        return 1.8 + 1.2 * steps(numbers, length, 8, round(40 * e.slowness))

    signals = (Signal("u"),), tuple(outputs)
    context = Context(*signals, 1.0, e.past, e.past, physics=physics, seed=seed)
    return recorded(respond, excite, effects, context, rng)


def duffing(seed: int, bias: float = 0.0, samples: int = 300) -> System:
    """A mass on a spring that stiffens, pushed to both sides; `bias`: a force that always acts,
    with which up and down are not alike."""
    rng = np.random.default_rng([seed, 2])
    damping, stiffness, cubic = rng.uniform([0.2, 0.8, 0.5], [0.4, 1.2, 1.0])

    def slope(x: Array, u: Array) -> Array:
        q, v = x
        return np.array([v, u[0] + bias - damping * v - stiffness * q - cubic * q**3])

    def respond(u: Array) -> Array:
        return integrated(slope, np.zeros(2), u, 0.2)[:, :1]

    def excite(numbers: np.random.Generator, length: int) -> Array:
        return 1.2 * steps(numbers, length, 3, 25)

    symmetry = {"odd": {"u": "-u", "y": "-y"}}
    context = Context((Signal("u"),), (Signal("y"),), 0.2, 10, 10, symmetry=symmetry, seed=seed)
    return recorded(respond, excite, TankEffects(samples=samples), context, rng)


def vehicle(seed: int, uneven: float = 0.0, samples: int = 300) -> System:
    """A planar vehicle with two rotors: rates of roll and climb. `uneven`: how much weaker one
    rotor is, relative."""
    rng = np.random.default_rng([seed, 3])
    turn, drag, climb = rng.uniform([3.0, 0.8, 0.4], [5.0, 1.2, 0.8])

    def slope(x: Array, u: Array) -> Array:
        w, v = x
        left, right = u[0] ** 2, (1.0 - uneven) * u[1] ** 2
        roll = turn * (left - right) - 2.0 * w - drag * w * abs(w)
        return np.array([roll, left + right - 2.0 - climb * v * abs(v) - 0.5 * v - 0.2 * w**2])

    def respond(u: Array) -> Array:
        return integrated(slope, np.zeros(2), u, 0.1)

    def excite(numbers: np.random.Generator, length: int) -> Array:
        return 1.0 + 0.4 * np.hstack([steps(numbers, length, 3, 20) for _ in range(2)])

    mirror = {"mirror": {"left": "right", "right": "left", "w": "-w"}}
    signals = (Signal("left"), Signal("right")), (Signal("w"), Signal("v"))
    context = Context(*signals, 0.1, 10, 10, symmetry=mirror, seed=seed)
    return recorded(respond, excite, TankEffects(samples=samples), context, rng)


def body(seed: int, uneven: float = 0.0) -> System:
    """A planar vehicle under its parachute, every state measured, in windows; the equations know
    its rotors and gravity alone. `uneven`: a torque that always acts, rad/s^2."""
    rng = np.random.default_rng([seed, 4])
    gain, swing, drag = rng.uniform([4.0, 5.0, 0.3], [6.0, 8.0, 0.6])

    def slope(x: Array, u: Array) -> Array:
        v, roll, w = x
        across = -9.81 * np.sin(roll) - drag * v - 0.2 * v * abs(v)
        turn = gain * (u[0] ** 2 - u[1] ** 2) - 2.0 * w - w * abs(w) - swing * np.sin(roll)
        return np.array([across, w, turn + uneven])

    def respond(u: Array) -> Array:
        return integrated(slope, np.zeros(3), u, 0.05)

    def excite(numbers: np.random.Generator, length: int) -> Array:
        return 1.0 + 0.5 * np.hstack([steps(numbers, length, 3, 20) for _ in range(2)])

    mirror = {name: f"-{name}" for name in ("v", "roll", "w", "force", "torque", "difference")}
    outputs = Signal("v"), Signal("roll"), Signal("w")
    context = Context(
        (Signal("left"), Signal("right")), outputs, 0.05, 0, 1, 25,
        physics=PLANAR, symmetry={"mirror": mirror}, seed=seed,
    )  # fmt: skip
    return recorded(respond, excite, TankEffects(samples=300), context, rng)


def recorded(
    respond: Callable[[Array], Array],
    excite: Callable[[np.random.Generator, int], Array],
    effects: TankEffects,
    context: Context,
    rng: np.random.Generator,
) -> System:
    """Two measured records of a system, the second, of 500 samples or more, with its truth."""
    found: list[Trajectory] = []
    clean: Array = np.zeros((0, context.ny))
    for name, length in (("train", effects.samples), ("fresh", max(effects.samples, 500))):
        u = excite(rng, length + SETTLE)
        clean, u = respond(u)[SETTLE:], u[SETTLE:]
        size, dt = clean.std(axis=0), context.sampling_time
        drift = effects.drift * wander(rng, clean.shape, effects.drift_time / dt)
        noise = effects.noise * rng.standard_normal(clean.shape)
        found.append(Trajectory(u, clean + size * (drift + noise), dt, name))
    return System(found[:1], found[1], clean, context)


def wander(rng: np.random.Generator, shape: tuple[int, ...], time: float) -> Array:
    """Ornstein-Uhlenbeck noise of unit deviation; its time constant in samples."""
    keep = float(np.exp(-1.0 / time))
    values = rng.standard_normal(shape)
    for k in range(1, len(values)):
        values[k] = keep * values[k - 1] + (1.0 - keep**2) ** 0.5 * values[k]
    return values


def steps(rng: np.random.Generator, length: int, shortest: int, longest: int) -> Array:
    """Levels in -1 to 1, each held for a random time (T, 1)."""
    values: list[float] = []
    while len(values) < length:
        values += [rng.uniform(-1.0, 1.0)] * int(rng.integers(shortest, longest + 1))
    return np.array(values[:length])[:, None]


def integrated(slope: Slope, start: Array, u: Array, step: float, substeps: int = 4) -> Array:
    """States (T, n) at each sample; Runge-Kutta of order four with the input held."""
    h, x = step / substeps, start
    states = np.empty((len(u), len(start)))
    for k, now in enumerate(u):
        states[k] = x
        for _ in range(substeps):
            a = slope(x, now)
            b = slope(x + h / 2 * a, now)
            c = slope(x + h / 2 * b, now)
            x = x + h / 6 * (a + 2 * b + 2 * c + slope(x + h * c, now))
    return states
