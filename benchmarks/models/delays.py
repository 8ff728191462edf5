"""Seconds of a fit of equations with a learned delay or plug flow, against a fixed delay.

All fit one record of the same tank behind a pipe, from the same starts, with the same number of
Jacobians, on one thread, in turns. The fixed delay is one of whole samples that the record holds
already, so that its equations remember nothing. Compilation is left out: the first fit of each
counts for nothing.

    python benchmarks/models/delays.py --samples 1000 --repeats 3
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)

import argparse
import time
from statistics import median

import numpy as np

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.models import greybox
from asia.models.methods import LevenbergMarquardt
from asia.problem import ParameterRange, Physics

STEP, DEAD = 1.0, 6.0
TANK = {"a": ParameterRange(0.02, 0.5), "b": ParameterRange(0.2, 3.0)}
CASES: dict[str, tuple[str, str, dict[str, ParameterRange]]] = {
    "fixed": ("held", "x", {}),
    "delay of an input": ("delay(s, dead)", "x", {"dead": ParameterRange(1.0, 15.0)}),
    "plug flow of an input": (
        "plug_flow(s, q, volume)",
        "x",
        {"volume": ParameterRange(1.0, 10.0)},
    ),
    "lag of an input": ("lag(s, dead)", "x", {"dead": ParameterRange(1.0, 15.0)}),
    "delay of a state": ("s", "delay(x, dead)", {"dead": ParameterRange(1.0, 15.0)}),
    "plug flow of a state": ("s", "plug_flow(x, q, volume)", {"volume": ParameterRange(1.0, 10.0)}),
}


def main() -> None:
    """Print the median seconds of a fit and the ratio to the fixed delay."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--iterations", type=int, default=15)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    spent: dict[str, list[float]] = {name: [] for name in CASES}
    for repeat in range(options.repeats + 1):
        for name in CASES:
            seconds = fit_seconds(name, options.samples, options.iterations)
            if repeat:
                spent[name].append(seconds)
    fixed = median(spent["fixed"])
    for name, seconds in spent.items():
        print(f"{name:24}{median(seconds):8.2f} s{median(seconds) / fixed:8.2f}")


def fit_seconds(name: str, samples: int, iterations: int) -> float:
    """Processor time of one fit."""
    signal, output, more = CASES[name]
    rng = np.random.default_rng(0)
    q = np.repeat(rng.uniform(0.4, 1.2, samples // 20 + 1), 20)[:samples]
    s = np.repeat(rng.standard_normal(samples // 7 + 1), 7)[:samples]
    late = int(DEAD / STEP)
    held = np.concatenate([np.repeat(s[:1], late), s[:-late]])
    x = np.zeros(samples)
    for k in range(samples - 1):
        x[k + 1] = x[k] + STEP * 0.1 * (held[k] - x[k])
    y = x + 0.02 * rng.standard_normal(samples)
    physics = Physics(
        ("x",), {"x": f"a*(b*{signal} - x)"}, {**TANK, **more}, observation={"y": output}
    )
    inputs = tuple(map(Signal, ("q", "s", "held")))
    context = Context(inputs, (Signal("y"),), STEP, 10, 10, physics=physics)
    record = Trajectory(np.stack([q, s, held], axis=1), y[:, None], STEP)
    method = LevenbergMarquardt(iterations=iterations, starts=4, tolerance=0.0)
    model = greybox.build(greybox.Config(), context)
    before = time.process_time()
    greybox.train(model, [record], context, method)
    return time.process_time() - before


if __name__ == "__main__":
    main()
