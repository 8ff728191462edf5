"""A refit on all records against the mean of three fold models, without a search that chose them.

A row has the error of the refit over that of the mean, on the training record and on a new one, in
standard deviations of the outputs. Then the rows are counted by the first of the two.
"""

from __future__ import annotations

import argparse
import sys
from itertools import pairwise
from pathlib import Path
from statistics import geometric_mean

import numpy as np
from seeds import FAMILIES

from asia.candidate import Context
from asia.data import Trajectory
from asia.models._least_squares import LevenbergMarquardt
from asia.problem import Signal

sys.path.insert(0, str(Path(__file__).parents[1] / "searches"))
from systems import KINDS, PAST, make_system

SYSTEMS = tuple(name for name in KINDS if name not in ("linear", "delay"))
LIMITS = (0.0, 0.7, 0.95, np.inf)
Record = tuple[np.ndarray, np.ndarray]


def ratios(family: str, name: str, seed: int, samples: int, iterations: int) -> tuple[float, float]:
    """Error of the refit over that of the mean, on the training and on the test record."""
    system = make_system(KINDS[name], seed)
    train: Record = system.train.u[:samples], system.train.y[:samples]
    test: Record = system.test.u, system.test.y
    time = KINDS[name].sampling_time
    module, config = FAMILIES[family]

    def fitted(parts: list[Record], number: int) -> list[np.ndarray]:
        """Simulations of both records by a model of these parts."""
        context = Context(
            tuple(Signal(f"u{i + 1}") for i in range(train[0].shape[1])),
            tuple(Signal(f"y{i + 1}") for i in range(train[1].shape[1])),
            time, n_past_u=PAST, n_past_y=PAST, seed=10 * seed + number,
        )  # fmt: skip
        records = [Trajectory(u, y, time, f"part{i + 1}") for i, (u, y) in enumerate(parts)]
        method = LevenbergMarquardt(iterations=iterations, starts=2)
        model = module.train(module.build(config, context), records, context, method)
        return [
            model.simulate(u[None, :PAST], y[None, :PAST], u[None, PAST:])[0]
            for u, y in (train, test)
        ]

    cuts = [0, samples // 3, 2 * samples // 3, samples]
    parts = [(train[0][a:b], train[1][a:b]) for a, b in pairwise(cuts)]
    folds = [fitted([p for k, p in enumerate(parts) if k != left], left) for left in range(3)]
    means = [np.mean(each, axis=0) for each in zip(*folds, strict=True)]
    refit = fitted([train], 7)

    def error(y_hat: np.ndarray, y: np.ndarray) -> float:
        return float(np.sqrt(np.mean(((y_hat - y[PAST:]) / y.std(axis=0)) ** 2)))

    one, other = (
        error(r, y) / error(m, y) for r, m, (_, y) in zip(refit, means, (train, test), strict=True)
    )
    return one, other


def main() -> None:
    """Print a row for each set of fits, then the counts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--families", nargs="+", default=["neural_ss", "nl_lfr"], choices=FAMILIES)
    parser.add_argument("--systems", nargs="+", default=SYSTEMS, choices=SYSTEMS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[901, 902])
    parser.add_argument("--samples", type=int, default=700, help="training samples")
    parser.add_argument("--iterations", type=int, default=40)
    options = parser.parse_args()
    found: list[tuple[float, float]] = []
    print("| family | system | seed | refit / mean, training record | new record |")
    print("|---|---|---|---|---|")
    for seed in options.seeds:
        for name in options.systems:
            for family in options.families:
                one, other = ratios(family, name, seed, options.samples, options.iterations)
                found.append((one, other))
                print(f"| {family} | {name} | {seed} | {one:.3f} | {other:.3f} |", flush=True)
    print("\n| training record | sets | refit better on the new one | geometric mean there |")
    print("|---|---|---|---|")
    for low, high in pairwise(LIMITS):
        new = [other for one, other in found if low <= one < high]
        if new:
            better = sum(other < 1 for other in new)
            print(f"| {low} to {high} | {len(new)} | {better} | {geometric_mean(new):.3f} |")


if __name__ == "__main__":
    main()
