"""Simulated systems with dry friction, hysteresis and play, by small steps of Runge and Kutta."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from asia.data import Array, Trajectory
from asia.problem import ParameterRange, Physics
from tests.unit.models.systems.equations import held_steps

Slope = Callable[[Array, float], Array]

DRIVE = Physics(
    ("q", "v"),
    {"q": "v", "v": "b*u - c*v - k*q"},
    {
        "b": ParameterRange(0.1, 10.0),
        "c": ParameterRange(0.01, 5.0),
        "k": ParameterRange(0.1, 20.0),
    },
    observation={"y": "q"},
)
"""A mass on a spring, without friction."""
MASS = Physics(
    ("v",),
    {"v": "b*u - c*v"},
    {"b": ParameterRange(0.1, 10.0), "c": ParameterRange(0.01, 5.0)},
    observation={"y": "v"},
)
"""A mass of which the velocity is measured."""


def stepped(slope: Slope, u: Array, states: int, time: float, substeps: int = 60) -> Array:
    """States (T, n) from rest, the input (T, 1) held between samples."""
    x, found, h = np.zeros(states), np.empty((len(u), states)), time / substeps
    for k, now in enumerate(u[:, 0]):
        found[k] = x
        for _ in range(substeps):
            k1 = slope(x, now)
            k2 = slope(x + 0.5 * h * k1, now)
            k3 = slope(x + 0.5 * h * k2, now)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + h * k3, now))
    return found


def sliding(x: Array, u: float) -> Array:
    """A mass on a spring that sticks: more friction in one direction, Stribeck effect."""
    q, v = x
    level = 1.0 if v > 0 else 0.7
    dry = level * (1.0 + 0.4 * np.exp(-((v / 0.1) ** 2))) * np.tanh(v / 0.005)
    return np.array([v, 2.0 * u - 0.3 * v - 2.0 * q - dry])


def sticking(x: Array, u: float) -> Array:
    """A mass against dry and viscous friction."""
    (v,) = x
    dry = (0.5 + 0.2 * np.exp(-((v / 0.1) ** 2))) * np.tanh(v / 0.01)
    return np.array([u - dry - 0.4 * v])


def bristle(x: Array, u: float) -> Array:
    """LuGre friction with a breakaway displacement of 0.05."""
    q, v, z = x
    stiffness, level = 20.0, 1.0
    slip = v - stiffness * abs(v) / level * z
    return np.array([v, 2.0 * u - 0.3 * v - 2.0 * q - stiffness * z - 1.0 * slip, slip])


def yielding(x: Array, u: float) -> Array:
    """A Bouc-Wen oscillator."""
    q, v, z = x
    rate = 4.0 * v - 3.0 * (0.8 * abs(v) * z + 0.2 * v * abs(z))
    return np.array([v, 2.0 * u - 0.3 * v - 1.0 * q - z, rate])


def record(
    slope: Slope, states: int, seed: int, shown: int = 0, noise: float = 0.003, samples: int = 500
) -> Trajectory:
    """Held steps into a system, one of its states with noise, sampled at 0.1 s."""
    u = held_steps(samples, seed, -2.0, 2.0, hold=12)
    x = stepped(slope, u, states, 0.1)[:, shown : shown + 1]
    y = x + noise * x.std() * np.random.default_rng(seed).normal(size=x.shape)
    return Trajectory(u, y, 0.1, f"run{seed}")


def backlash(seed: int, samples: int = 500) -> Trajectory:
    """A first-order lag behind a play of half width 0.5."""
    u = held_steps(samples, seed, -2.0, 2.0, hold=6)
    u = u + 0.5 * np.sin(np.arange(samples) / 9.0)[:, None]
    p, x, found = 0.0, 0.0, np.empty((samples, 1))
    for k, now in enumerate(u[:, 0]):
        found[k] = x
        p = min(max(p, now - 0.5), now + 0.5)
        x = x + 0.2 * (p - x)
    noise = 0.003 * found.std() * np.random.default_rng(seed).normal(size=found.shape)
    return Trajectory(u, found + noise, 0.1, f"run{seed}")
