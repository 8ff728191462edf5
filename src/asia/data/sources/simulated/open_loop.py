"""Open-loop records of the plants of the built-in control problems: random steps of all inputs."""

from functools import cache
from typing import Any

import numpy as np

from asia._files import PACKAGE
from asia.data.sources.simulated import Simulation
from asia.data.sources.source import Subset
from asia.data.trajectory import Array

_SAMPLES, _DECIMALS = 800, 6


@cache
def _plant(problem: str) -> Any:
    source = (PACKAGE / "problems" / problem / "plant.py").read_text("utf-8")
    found: dict[str, Any] = {"__name__": "plant"}
    exec(compile(source, "plant.py", "exec"), found)
    return found["step"]


def _record(
    problem: str, seed: int, number: int, sampling_time: float, parameters: dict[str, float],
    ranges: Array, start: Array, hold: int, noise: Array,
) -> Simulation:  # fmt: skip
    """A record of 800 samples: inputs (T, nu) hold for half to one and a half of `hold` samples,
    each by itself, and disturbances are 0."""
    random = np.random.default_rng([seed, number])
    u = np.empty((_SAMPLES, len(ranges)))
    for column, (low, high) in enumerate(ranges):
        k, value = 0, start[column]
        while k < _SAMPLES:
            length = max(round(hold * random.uniform(0.5, 1.5)), 1)
            u[k : k + length, column] = value
            k, value = k + length, random.uniform(low, high)
    u = np.round(u, _DECIMALS)
    step = _plant(problem)
    x, y = step(None, np.append(u[0], 0.0), parameters, sampling_time)
    truth = np.empty((_SAMPLES, len(noise)))
    for k in range(_SAMPLES):
        # The output of a sample is the one before its input acts.
        truth[k] = y
        x, y = step(x, np.append(u[k], 0.0), parameters, sampling_time)
    truth = np.round(truth, _DECIMALS)
    y = np.round(truth + noise * random.standard_normal(truth.shape), _DECIMALS)
    return Simulation(u, y, truth)


def _records(problem: str, seed: int, subset: Subset, **known: Any) -> dict[str, Simulation]:
    numbers = {"train": (0,), "test": (1,), "guard": ()}[subset]
    name = problem.removesuffix("_control")
    return {f"{name}_{subset}": _record(problem, seed, k, **known) for k in numbers}


def quadruple_tank_records(seed: int, subset: Subset, guard: int) -> dict[str, Simulation]:
    """Pumps between 2 and 4 V."""
    del guard
    return _records(
        "quadruple_tank_control", seed, subset, sampling_time=QUADRUPLE_TANK_TIME,
        parameters={"gamma1": 0.70, "gamma2": 0.60, "k1": 3.33, "k2": 3.35},
        ranges=np.array([[2.0, 4.0], [2.0, 4.0]]), start=np.array([3.0, 3.0]), hold=25,
        noise=np.array([0.02, 0.02]),
    )  # fmt: skip


def cstr_records(seed: int, subset: Subset, guard: int) -> dict[str, Simulation]:
    """Flow between 8 and 22 1/h, cooling between 2500 and 0 kJ/h."""
    del guard
    return _records(
        "cstr_control", seed, subset, sampling_time=CSTR_TIME,
        parameters={"activity": 1.0, "fouling": 0.95, "feed": 5.1},
        ranges=np.array([[8.0, 22.0], [-2500.0, 0.0]]), start=np.array([14.19, -1113.5]), hold=25,
        noise=np.array([0.003, 0.1]),
    )  # fmt: skip


QUADRUPLE_TANK_TIME, CSTR_TIME = 5.0, 20.0
"""Sampling times in s."""
