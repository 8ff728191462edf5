"""Neural families on one shared nonlinear system, and on the measured cascaded tanks.

    python benchmarks/models/families_neural.py [--families ltc,cnn] [--tanks]

The first table is the simulation error against the noise-free truth of an unseen record, over that
of the best linear model (order chosen inside the training data): below 0.5 a family earns its
place. With --tanks the second is V of both folds on the training record of the cascaded tanks, one
seed; the test record is not opened. Seconds are of processor time, compilation
included.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np

from asia.candidate import Context, Model
from asia.data import Signal, Trajectory
from asia.models import (
    autoregressive,
    cascaded_ltc,
    cnn,
    koopman,
    linear,
    ltc,
    recurrent,
    subnet,
    transformer,
)
from asia.models.methods import Adam
from asia.problem.folds import make_folds
from asia.problem.load import load_problem

PAST = 8
NOISE = 0.05


@dataclass(frozen=True)
class Row:
    """A family with the settings of its two fits."""

    module: ModuleType
    system: dict[str, Any]
    system_method: Adam
    tanks: dict[str, Any]
    tanks_method: Adam


ROWS = {
    "ltc": Row(
        ltc, {"hidden": 32}, Adam(1000, 3e-3, truncation=128), {}, Adam(1000, 1e-3, truncation=256)
    ),
    "recurrent": Row(
        recurrent, {}, Adam(1000, 3e-3, truncation=128), {}, Adam(1000, 3e-3, truncation=256)
    ),
    "cascaded_ltc": Row(
        cascaded_ltc, {}, Adam(1000, 3e-3, truncation=128), {}, Adam(1000, 3e-3, truncation=256)
    ),
    "autoregressive": Row(
        autoregressive, {}, Adam(1000, 5e-3, truncation=64), {}, Adam(1000, 3e-3, truncation=128)
    ),
    "koopman": Row(
        koopman,
        {},
        Adam(1500, 3e-3, truncation=128),
        {"levels": 2, "states": 8, "lift": 4},
        Adam(1000, 3e-3, 0.1, truncation=256),
    ),
    "cnn": Row(
        cnn,
        {"receptive_field": 64},
        Adam(1500, 3e-3, 1e-2, truncation=128, noise=0.05),
        {"width": 8},
        Adam(1000, 5e-3, 0.3, truncation=256, noise=0.1),
    ),
    "transformer": Row(
        transformer,
        {"span": 32},
        Adam(1000, 3e-3, truncation=128, noise=0.05, batch=8),
        {"span": 128},
        Adam(500, 3e-3, 1e-2, noise=0.1),
    ),
    "subnet": Row(
        subnet,
        {"states": 2},
        Adam(1000, 2e-3, truncation=64),
        {},
        Adam(1000, 2e-3, truncation=128),
    ),
}


@dataclass(frozen=True)
class Benchmark:
    """Training records, and what a model's error is measured on."""

    training: Sequence[Trajectory]
    context: Context
    error: Callable[[Model], float]


def main() -> None:
    """Fit what is asked for and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--families", default=",".join(ROWS), metavar="A,B")
    parser.add_argument("--tanks", action="store_true")
    options = parser.parse_args()
    rows = {name: ROWS[name] for name in options.families.split(",")}
    shared = wiener()
    best_linear = shared.error(_linear(shared))
    print("| family | system | error/linear | s |\n|---|---|---|---|")
    for name, row in rows.items():
        start = time.process_time()
        ratio = shared.error(_fit(row.module, row.system, row.system_method, shared)) / best_linear
        print(f"| {name} | Wiener | {ratio:.3f} | {time.process_time() - start:.0f} |", flush=True)
    if not options.tanks:
        return
    folds = tanks()
    known = [fold.error(_linear(fold)) for fold in folds]
    print(f"\n| family | system | V fold 1 | V fold 2 | V | s |\n{'|---' * 6}|")
    print(f"| linear | cascaded tanks | {known[0]:.3f} | {known[1]:.3f} | {np.mean(known):.3f} | |")
    for name, row in rows.items():
        start = time.process_time()
        v = [f.error(_fit(row.module, row.tanks, row.tanks_method, f)) for f in folds]
        print(
            f"| {name} | cascaded tanks | {v[0]:.3f} | {v[1]:.3f} | {np.mean(v):.3f} | "
            f"{time.process_time() - start:.0f} |",
            flush=True,
        )


def _linear(data: Benchmark) -> Model:
    model = linear.build(linear.Config(), data.context)
    return linear.train(model, data.training, data.context)


def _fit(module: ModuleType, config: dict[str, Any], method: Adam, data: Benchmark) -> Model:
    def log(step: float, loss: float) -> None:
        print(f"\r{module.__name__} {step:.0f} {loss:.4f} ", end="", file=sys.stderr)

    context = replace(data.context, log=log)
    return module.train(
        module.build(module.Config(**config), context), data.training, context, method
    )


def wiener(samples: int = 2000) -> Benchmark:
    """A second-order filter into a saturation, 5 % of white noise on the output."""
    rng = np.random.default_rng(7)

    def record(length: int) -> tuple[np.ndarray, np.ndarray]:
        u = np.repeat(rng.standard_normal(length // 3 + 1), 3)[:length]
        x, y = np.zeros(2), np.empty(length)
        for k in range(length):
            y[k] = 5 + 3 * np.tanh(1.5 * x[0] + 0.75 * x[1])
            x = np.array([0.8 * x[0] + 0.3 * x[1], 0.8 * x[1] - 0.3 * x[0]]) + u[k] * _GAIN
        return 2 + u, y

    (u, y), (unseen, truth) = record(samples), record(500)
    sigma = NOISE * y.std()
    noisy, measured = (v + sigma * rng.standard_normal(len(v)) for v in (y, truth))
    context = Context((Signal("u"),), (Signal("y"),), 1.0, n_past_u=PAST, n_past_y=PAST, seed=3)

    def error(model: Model) -> float:
        past = unseen[None, :PAST, None], measured[None, :PAST, None]
        y_hat = model.simulate(*past, unseen[None, PAST:, None])[0, :, 0]
        return float(np.sqrt(np.mean((y_hat - truth[PAST:]) ** 2)))

    return Benchmark([Trajectory(u, noisy, 1.0)], context, error)


_GAIN = np.array([0.2, 0.1])


def tanks() -> list[Benchmark]:
    """The folds of the measured tanks."""
    problem = load_problem("cascaded_tanks")
    rule = problem.protocol
    context = Context(
        problem.inputs,
        problem.outputs,
        problem.sampling_time,
        n_past_u=rule.past_inputs,
        n_past_y=rule.past_outputs,
        horizon=rule.horizon,
    )
    result: list[Benchmark] = []
    for fold in make_folds(problem.train, rule):

        def error(model: Model, fold: Any = fold) -> float:
            block = fold.held_out[0]
            y = model.simulate(block.past_u[None], block.past_y[None], block.u[None])[0]
            return float(np.mean(np.sqrt(np.mean((y - block.y) ** 2, axis=0)) / fold.scale))

        result.append(Benchmark(fold.train, context, error))
    return result


if __name__ == "__main__":
    main()
