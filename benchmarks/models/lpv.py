"""Linear parameter-varying models against models without a scheduling signal.

    python benchmarks/models/lpv.py [SEED ...] [--only TEXT]

Two generated systems: a mass on a spring whose stiffness and damping follow a scheduling signal,
and a heater whose time constant is inverse to a flow. 1500 samples to train, 1500 new ones to test,
1 % noise. The table has the test error in standard deviations of the output, the mean over seeds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Signal, Trajectory
from asia.models import arx, linear, neural_ss, nl_lfr
from asia.models.methods import LevenbergMarquardt

CONTEXT = Context(
    (Signal("force"), Signal("condition", role="scheduling")), (Signal("y"),), 0.1, 20, 20, seed=1
)


def spring(x: Any, u: float, p: float) -> Any:
    """Mass on a spring: frequency and damping rise with p."""
    return np.array([x[1], u - (2.0 + 1.5 * p) * x[0] - (0.4 + 0.3 * p) * x[1]])


def heater(x: Any, u: float, p: float) -> Any:
    """Heated flow: rate and gain follow the flow, quadratically."""
    flow = 0.6 + 0.4 * p + 0.15 * p**2
    return np.array([u - flow * x[0], 2.0 * (x[0] - x[1])])


def record(system: Callable[[Any, float, float], Any], output: int, random: Any) -> Trajectory:
    """A record of 1500 samples with a slow scheduling signal."""
    count, x = 1500, np.zeros(2)
    u = np.repeat(random.normal(size=count // 10), 10)
    p = np.interp(np.arange(count), np.arange(0, count + 60, 60), random.uniform(-1, 1, 26))
    y = np.empty(count)
    for k in range(count):
        y[k] = x[output]
        for _ in range(10):
            x = x + 0.01 * system(x, u[k], p[k])
    y += 0.01 * y.std() * random.normal(size=count)
    return Trajectory(np.column_stack([u, p]), y[:, None], 0.1)


MODELS: dict[str, tuple[Any, Any]] = {
    "linear, state space": (linear, linear.Config()),
    "arx, LTI": (arx, arx.Config()),
    "arx, affine": (arx, arx.Config(scheduling=1)),
    "arx, quadratic": (arx, arx.Config(scheduling=2)),
    "neural_ss": (neural_ss, neural_ss.Config()),
    "neural_ss, polynomial": (neural_ss, neural_ss.Config(basis="polynomial", degree=2)),
    "neural_ss, affine": (neural_ss, neural_ss.Config(basis="scheduling", degree=2)),
    "neural_ss, quadratic": (neural_ss, neural_ss.Config(basis="scheduling", degree=3)),
    "nl_lfr": (nl_lfr, nl_lfr.Config()),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seeds", nargs="*", type=int, default=[1, 2, 3])
    parser.add_argument("--only", default="", help="part of the names of the models")
    options = parser.parse_args()
    seeds = options.seeds
    print(f"{'model':24} {'spring':>8} {'heater':>8} {'seconds':>8}")
    for name, (family, config) in MODELS.items():
        if options.only not in name:
            continue
        errors: list[list[float]] = []
        begin = time.perf_counter()
        for system, output in ((spring, 0), (heater, 1)):
            found: list[float] = []
            for seed in seeds:
                random = np.random.default_rng(seed)
                train, test = (record(system, output, random) for _ in range(2))
                model = family.build(config, CONTEXT)
                model = family.train(model, [train], CONTEXT, LevenbergMarquardt(iterations=30))
                past, rest = test[:20], test[20:]
                y = model.simulate(past.u[None], past.y[None], rest.u[None])[0]
                found.append(float(np.sqrt(np.mean((y - rest.y) ** 2)) / test.y.std()))
            errors.append(found)
        seconds = (time.perf_counter() - begin) / (2 * len(seeds))
        print(f"{name:24} {np.mean(errors[0]):8.4f} {np.mean(errors[1]):8.4f} {seconds:8.1f}")


if __name__ == "__main__":
    main()
