"""Generalised least squares under slow disturbances, against plain least squares.

    python benchmarks/models/noise.py [--seeds 0 1 2] [--families greybox,linear]

A mass on a spring, linear for the linear model and hardening for the others; the equations of the
hybrid lack the hardening, the neural state-space model has none. The output carries white noise
and, but for the row "none", an Ornstein-Uhlenbeck disturbance with the given time constant. Each
cell is the deviation of the simulation error on a fresh record against the noise-free truth, in
percent of that of the truth, the first samples left out: median over the seeds. The mean error is
no part of it: the level of a disturbance about as slow as the record is long cannot be told from
that of the model. The ratio is the median over the seeds
of the error with `noise_model="slow"` over that without; under white noise alone it should be 1.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.models import greybox, hybrid, linear, neural_ss
from asia.models._least_squares import LevenbergMarquardt
from asia.problem import ParameterRange, Physics

Array = NDArray[np.float64]

DT, SAMPLES, PAST, SKIP = 0.2, 800, 10, 100
DAMPING, SPRING, HARDENING, GAIN = 0.6, 2.0, 1.0, 2.0
# Of the output's deviation.
SLOW, WHITE = 0.3, 0.03
# In s; the spring swings back and forth in 4 s.
TIMES = (4.0, 20.0, 100.0)


def equations(hardening: bool) -> Physics:
    """Equations of the mass, parameters unknown."""
    cube = " - hardening*position**3" if hardening else ""
    names = ("damping", "spring", "gain", *(("hardening",) if hardening else ()))
    return Physics(
        states=("position", "velocity"),
        parameters={name: ParameterRange(0.05, 20.0) for name in names},
        dynamics={
            "position": "velocity",
            "velocity": f"-damping*velocity - spring*position{cube} + gain*force",
        },
        observation={"y": "position"},
    )


@dataclass(frozen=True)
class Row:
    """A family with its settings, and its system."""

    module: ModuleType
    config: Any
    method: LevenbergMarquardt
    hardening: float = HARDENING
    physics: Physics | None = None


ROWS = {
    "greybox": Row(
        greybox, greybox.Config(), LevenbergMarquardt(30, starts=2), physics=equations(True)
    ),
    "linear": Row(linear, linear.Config(order=2), LevenbergMarquardt(50), hardening=0.0),
    "hybrid": Row(
        hybrid, hybrid.Config(units=3, ridge=1e-5), LevenbergMarquardt(30, starts=2),
        physics=equations(False),
    ),
    "neural_ss": Row(
        neural_ss, neural_ss.Config(order=2, hidden=6), LevenbergMarquardt(50)
    ),
}  # fmt: skip


def motion(u: Array, hardening: float) -> Array:
    """Positions (T,) before each input acts."""

    def rate(x: Array, force: float) -> Array:
        pull = SPRING * x[0] + hardening * x[0] ** 3
        return np.array([x[1], GAIN * force - DAMPING * x[1] - pull])

    x, found = np.zeros(2), np.empty(len(u))
    for k, force in enumerate(u):
        found[k] = x[0]
        for _ in range(4):
            middle = x + 0.5 * DT / 4 * rate(x, force)
            x = x + DT / 4 * rate(middle, force)
    return found


def disturbance(rng: np.random.Generator, slow_time: float | None) -> Array:
    """White noise, and a slow disturbance unless there is no time constant."""
    white = WHITE * rng.standard_normal(SAMPLES)
    if slow_time is None:
        return white
    keep, slow = np.exp(-DT / slow_time), rng.standard_normal(SAMPLES)
    for k in range(1, SAMPLES):
        slow[k] = keep * slow[k - 1] + np.sqrt(1 - keep**2) * slow[k]
    return white + SLOW * slow


def error(row: Row, method: LevenbergMarquardt, slow_time: float | None, seed: int) -> float:
    """Simulation error in percent of the deviation of the truth."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal((2, SAMPLES // 5)), 5, axis=1)
    truths = [motion(force, row.hardening) for force in u]
    y = [truth + truth.std() * disturbance(rng, slow_time) for truth in truths]
    record = Trajectory(u[0][:, None], y[0][:, None], DT)
    context = Context(
        (Signal("force"),), (Signal("y"),), DT, n_past_u=PAST, n_past_y=PAST, seed=seed,
        physics=row.physics,
    )  # fmt: skip
    model = row.module.train(row.module.build(row.config, context), [record], context, method)
    past_u, past_y, future = u[1][None, :PAST, None], y[1][None, :PAST, None], u[1][None, PAST:]
    found = model.simulate(past_u, past_y, future[..., None])[0, SKIP:, 0]
    truth = truths[1][PAST + SKIP :]
    return 100.0 * float(np.std(found - truth) / truth.std())


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--families", default=",".join(ROWS))
    options = parser.parse_args(arguments)
    started = time.perf_counter()
    print("| family | slow part, s | least squares, % | noise model, % | ratio |")
    print("|---|---|---|---|---|")
    for name in options.families.split(","):
        row = ROWS[name]
        for slow_time in (*TIMES, None):
            methods = row.method, replace(row.method, noise_model="slow")
            errors = [[error(row, m, slow_time, seed) for m in methods] for seed in options.seeds]
            plain, slow = (statistics.median(column) for column in zip(*errors, strict=True))
            ratio = statistics.median(b / a for a, b in errors)
            label = "none" if slow_time is None else f"{slow_time:g}"
            print(f"| {name} | {label} | {plain:.2f} | {slow:.2f} | {ratio:.2f} |", flush=True)
    print(f"{time.perf_counter() - started:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
