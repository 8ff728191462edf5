"""Starts of neural state-space fits, and initial states of their simulations."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np

from asia.candidate import Context
from asia.data import Trajectory
from asia.models import neural_ss, nl_lfr
from asia.models._least_squares import LevenbergMarquardt
from asia.problem import Signal

sys.path.insert(0, str(Path(__file__).parents[1] / "searches"))
from systems import KINDS, PAST, Record, make_system

CONFIG = neural_ss.Config(delay=None)
FEEDBACK = replace(CONFIG, channels=1)
CONFIGS = {
    "functions of all states": CONFIG,
    "with pieces and past fit": replace(CONFIG, pieces=True, past_fit=True),
    "one function in feedback": FEEDBACK,
    "one in feedback, with both": replace(FEEDBACK, pieces=True, past_fit=True),
    "nl_lfr": nl_lfr.Config(),
    "nl_lfr, two channels": nl_lfr.Config(channels=2),
}
Config = neural_ss.Config | nl_lfr.Config
Model = neural_ss.NeuralStateSpace | nl_lfr.NonlinearLfr
METHOD = LevenbergMarquardt(iterations=60, starts=2)


def main() -> None:
    """Print a row for each fit, then the medians."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--systems", default="duffing,mimo,bilinear,wiener_hammerstein")
    parser.add_argument("--seeds", default="100,101")
    parser.add_argument("--configs", default=",".join(map(str, range(len(CONFIGS)))))
    options = parser.parse_args()
    rows: dict[str, list[tuple[float, float, float, float]]] = {}
    print("| system | configuration | folds on their other half | folds, fresh | all, fresh | s |")
    print("|---|---|---|---|---|---|")
    for name in options.systems.split(","):
        for seed in map(int, options.seeds.split(",")):
            for number in map(int, options.configs.split(",")):
                words, config = list(CONFIGS.items())[number]
                row = _row(name, seed, config)
                rows.setdefault(words, []).append(row)
                cells = " | ".join(f"{value:.3g}" for value in row)
                print(f"| {name}-{seed} | {words} | {cells} |", flush=True)
    for words, found in rows.items():
        cells = " | ".join(f"{median(column):.3g}" for column in zip(*found, strict=True))
        print(f"| **median** | {words} | {cells} |")


def _row(name: str, seed: int, config: Config) -> tuple[float, float, float, float]:
    system, start = make_system(KINDS[name], seed), time.monotonic()
    nu, ny = system.train.u.shape[1], system.train.y.shape[1]
    context = Context(
        tuple(Signal(f"u{i + 1}") for i in range(nu)),
        tuple(Signal(f"y{i + 1}") for i in range(ny)),
        KINDS[name].sampling_time, n_past_u=PAST, n_past_y=PAST, seed=1,
    )  # fmt: skip
    half = len(system.train.u) // 2
    parts = slice(0, half), slice(half, 2 * half), slice(0, 2 * half)

    def error(model: Model, record: Record, part: slice) -> float:
        u, y, truth = record.u[None, part], record.y[None, part], record.truth[part]
        y_hat = model.simulate(u[:, :PAST], y[:, :PAST], u[:, PAST:])[0]
        wrong = np.sqrt(np.mean((truth[PAST:] - y_hat) ** 2, axis=0))
        return float(np.mean(wrong / system.noise_std))

    models: list[Model] = []
    for part in parts:
        record = Trajectory(
            system.train.u[part], system.train.y[part], context.sampling_time, "train"
        )
        models.append(_trained(config, record, context))
    other = [error(m, system.train, p) for m, p in zip(models[:2], parts[1::-1], strict=True)]
    fresh = [error(m, system.test, parts[2]) for m in models]
    return float(np.mean(other)), float(np.mean(fresh[:2])), fresh[2], time.monotonic() - start


def _trained(config: Config, record: Trajectory, context: Context) -> Model:
    if isinstance(config, nl_lfr.Config):
        return nl_lfr.train(nl_lfr.build(config, context), [record], context, METHOD)
    return neural_ss.train(neural_ss.build(config, context), [record], context, METHOD)


if __name__ == "__main__":
    main()
