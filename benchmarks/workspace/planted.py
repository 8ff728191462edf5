"""Two tanks whose equations know nothing of what is planted: a bent sensor of the level, a pump
that answers late, a slow disturbance of the measured level; each of them or none.

    python planted.py FOLDER [bend] [lag] [drift]     writes a problem directory
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asia import Problem
from asia.data import Signal

Array = NDArray[np.float64]

FULL = 7.0
SETTLE = 100
SAMPLES = 1000
SUBSTEPS = 5
DESCRIPTION = """# Two tanks

A pump fills an upper tank, whose water runs through an opening into a lower one and from there
away. The input is the voltage of the pump, the output the reading of the level sensor of the lower
tank, both sampled every second. The equations are those of Torricelli. Whether the sensor is
linear, whether the pump follows its voltage at once, and whether something else moves the reading,
nobody knows.
"""
PHYSICS = {
    "states": ["x1", "x2"],
    "parameters": {name: {"min": 1e-2, "max": 1.0} for name in ("k1", "k2", "k3", "k4")},
    "dynamics": {"x1": "-k1*sqrt(x1) + k4*pump", "x2": "k2*sqrt(x1) - k3*sqrt(x2)"},
    "observation": {"level": "x2"},
    "bounds": {"x1": {"min": 0.0}, "x2": {"min": 0.0}},
}


@dataclass(frozen=True)
class Planted:
    """Effect that the equations lack."""

    bend: bool = False
    """Whether the sensor reads FULL * (level / FULL) ** 1.5."""
    lag: bool = False
    """Whether the pump follows its voltage with a time constant of 8 s."""
    drift: bool = False
    """Whether a slow disturbance, 8 % of the reading's deviation, is added to it; 40 s."""


def record(planted: Planted, seed: int) -> tuple[Array, Array]:
    """Input (T, 1) and output (T, 1)."""
    random = np.random.default_rng(seed)
    u = _steps(random, SETTLE + SAMPLES)
    level = _levels(u, 8.0 if planted.lag else 0.0, random.uniform(0.25, 0.35, 4))
    reading = FULL * (level / FULL) ** 1.5 if planted.bend else level
    size = reading[SETTLE:].std()
    slow = _wander(random, len(u), 40.0) if planted.drift else 0.0
    reading = reading + size * (0.08 * slow + 0.01 * random.standard_normal(len(u)))
    return u[SETTLE:, None], reading[SETTLE:, None]


def _steps(random: np.random.Generator, length: int) -> Array:
    """Voltages in 0.6 to 3, each held for 8 to 40 s."""
    values: list[float] = []
    while len(values) < length:
        values += [random.uniform(0.6, 3.0)] * int(random.integers(8, 41))
    return np.array(values[:length])


def _levels(u: Array, late: float, k: Array) -> Array:
    """Level of the lower tank at each sample."""
    upper, lower, flow, step = 2.0, 2.0, float(u[0]), 1.0 / SUBSTEPS
    found = np.empty(len(u))
    for i, voltage in enumerate(u):
        found[i] = lower
        for _ in range(SUBSTEPS):
            flow = flow + step * (voltage - flow) / late if late else voltage
            out, away = np.sqrt(upper), np.sqrt(lower)
            upper = max(upper + step * (k[3] * flow - k[0] * out), 0.0)
            lower = max(lower + step * (k[1] * out - k[2] * away), 0.0)
    return found


def _wander(random: np.random.Generator, length: int, time: float) -> Array:
    """Ornstein-Uhlenbeck noise of unit deviation; its time constant in s."""
    keep, values = float(np.exp(-1.0 / time)), random.standard_normal(length)
    for i in range(1, length):
        values[i] = keep * values[i - 1] + (1.0 - keep**2) ** 0.5 * values[i]
    return values


def problem(folder: Path, planted: Planted, seed: int = 1) -> Problem:
    """The problem directory, written."""
    u, y = record(planted, seed)
    return Problem.from_arrays(
        u, y, sampling_time=1.0, directory=folder, description=DESCRIPTION,
        inputs=[Signal("pump", "V")], outputs=[Signal("level", "cm")], physics=PHYSICS,
        baseline=BASELINE, budget={"experiments": 7, "fit_seconds": 120.0},
    )  # fmt: skip


BASELINE = '''"""The equations as they are given."""

from asia.models import greybox
from asia.models.methods import LevenbergMarquardt

CONFIG = greybox.Config()
METHOD = LevenbergMarquardt(iterations=60, starts=4)


def fit(trajectories, context):
    return greybox.train(greybox.build(CONFIG, context), trajectories, context, METHOD)
'''

if __name__ == "__main__":
    problem(Path(sys.argv[1]), Planted(**dict.fromkeys(sys.argv[2:], True)))
