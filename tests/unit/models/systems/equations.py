"""Simulated truths for the grey-box tests, integrated with SciPy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.problem import Bounds, ParameterRange, Physics

Rate = Callable[[Array, Array], Array]

DUFFING = Physics(
    states=("position", "velocity"),
    parameters={
        "c": ParameterRange(0.05, 5.0),
        "k": ParameterRange(0.1, 20.0),
        "a": ParameterRange(-5.0, 5.0),
        "b": ParameterRange(0.1, 10.0),
    },
    dynamics={
        "position": "velocity",
        "velocity": "-c*velocity - k*position - a*position**3 + b*force",
    },
    observation={"y": "position"},
)
DUFFING_TRUTH = {"c": 0.6, "k": 4.0, "a": 1.5, "b": 2.0}

TANKS = Physics(
    states=("x1", "x2"),
    parameters={f"k{i}": ParameterRange(0.02, 1.0) for i in (1, 2, 3)},
    dynamics={"x1": "-k1*sqrt(x1) + k3*pump", "x2": "k1*sqrt(x1) - k2*sqrt(x2)"},
    observation={"level": "x2"},
    bounds={"x1": Bounds(min=0.0), "x2": Bounds(min=0.0)},
)


def duffing_rate(x: Array, u: Array) -> Array:
    c, k, a, b = DUFFING_TRUTH.values()
    return np.array([x[1], -c * x[1] - k * x[0] - a * x[0] ** 3 + b * u[0]])


def held_steps(samples: int, seed: int, low: float, high: float, hold: int = 8) -> Array:
    """A random staircase (samples, 1)."""
    levels = np.random.default_rng(seed).uniform(low, high, samples // hold + 1)
    return np.repeat(levels, hold)[:samples, None]


def simulated(rate: Rate, u: Array, x0: Array, sampling_time: float) -> Array:
    """States (T, nx) at the samples, the input held between them."""
    states = [np.asarray(x0, dtype=float)]
    for k in range(len(u) - 1):
        answer = solve_ivp(
            lambda _, x, now=u[k]: rate(x, now),
            (0, sampling_time),
            states[-1],
            rtol=1e-8,
            atol=1e-9,
        )
        states.append(answer.y[:, -1])
    return np.array(states)


def duffing_record(samples: int, seed: int, noise: float = 0.0, sampling_time: float = 0.15):
    """A record from a start that is not at rest."""
    rng = np.random.default_rng(seed + 100)
    u = held_steps(samples, seed, -3.0, 3.0)
    x = simulated(duffing_rate, u, rng.normal(size=2), sampling_time)
    y = x[:, :1] + noise * rng.normal(size=(samples, 1))
    return Trajectory(u, y, sampling_time, f"duffing {seed}")


def inverted(length: int, seed: int) -> Trajectory:
    """An unstable pendulum, both states measured."""
    u = held_steps(length, seed, -0.4, 0.4, hold=3)
    x = simulated(lambda x, u: np.array([x[1], 2.0 * x[0] + 3.0 * u[0]]), u, np.zeros(2), 0.05)
    return Trajectory(u, x, 0.05, f"run{seed}")


def context_for(physics: Physics | None, inputs: str, outputs: str, sampling_time: float, **more):
    """A context with space-separated signal names and past windows of 5 samples."""
    settings = {"n_past_u": 5, "n_past_y": 5} | more
    return Context(
        tuple(Signal(name) for name in inputs.split()),
        tuple(Signal(name) for name in outputs.split()),
        sampling_time,
        physics=physics,
        **settings,
    )
