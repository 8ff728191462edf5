"""Linear models of the fine steering mirror by level of excitation: one system, one for each level,
and one for each but the middle level, which is then interpolated.

Cross-validation on the training records with the folds of the problem; the test set stays closed.
Prints for each level the RMSE as its board has it, the mean over outputs and held-out records.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import numpy as np

from asia.candidate import Context
from asia.data import Trajectory
from asia.models import linear
from asia.models._least_squares import LevenbergMarquardt
from asia.problem.folds import make_folds
from asia.problem.load import load_problem
from asia.problem.problem import Problem

ONE = linear.Config(order=None, delay=None, periodic=True)
EACH = linear.Config(order=None, delay=None, periodic=True, levels=True)


def main() -> None:
    """Fit and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--iterations", type=int, default=30)
    parser.add_argument("--folds", type=int, default=3)
    chosen = parser.parse_args()
    problem = load_problem("fine_steering_mirror")
    print("| model | V | RMSE by level [um] | fit s a fold |")
    print("|---|---|---|---|")
    for name, config, left_out in (
        ("one system", ONE, ""),
        ("a system for each level", EACH, ""),
        ("the same without 200 mV", EACH, "200mV"),
        ("one system, without 200 mV", ONE, "200mV"),
    ):
        method = LevenbergMarquardt(iterations=chosen.iterations)
        found = [measured(problem, k, config, method, left_out) for k in range(chosen.folds)]
        v, seconds = np.mean([f[0] for f in found]), np.mean([f[2] for f in found])
        levels = np.mean([f[1] for f in found], axis=0)
        print(f"| {name} | {v:.4f} | {', '.join(f'{e:.3f}' for e in levels)} | {seconds:.0f} |")


def measured(
    problem: Problem,
    number: int,
    config: linear.Config,
    method: LevenbergMarquardt,
    left_out: str,
) -> tuple[float, list[float], float]:
    """V of a fold, RMSE by level, seconds of the fit; records of a level may be left out of it."""
    rule = problem.protocol
    fold = make_folds(problem.train, rule)[number]
    context = Context(
        problem.inputs, problem.outputs, problem.sampling_time, rule.past_inputs, rule.past_outputs
    )
    train = [r for r in fold.train if not (left_out and r.name.startswith(left_out))]
    begun = time.perf_counter()
    model = linear.train(linear.build(config, context), train, context, method)
    seconds = time.perf_counter() - begun
    held = {r.name for block in fold.held_out for r in problem.train if r.name == block.name}
    records = [r for r in problem.train if r.name in held]
    squares = {r.name: squared(model, r, rule.past) for r in records}
    scale = np.concatenate([r.y for r in fold.train]).std(axis=0)
    v = float(np.mean(np.sqrt(np.mean(list(squares.values()), axis=0)) / scale))
    levels = sorted({name.split("_")[0] for name in squares})
    factor = rule.test.unit_factor or 1.0
    return v, [factor * level_error(squares, level) for level in levels], seconds


def squared(model: linear.LinearStateSpace, r: Trajectory, past: int) -> np.ndarray:
    """Mean squared error of each output."""
    found = model.simulate(r.u[None, :past], r.y[None, :past], r.u[None, past:])[0]
    return ((found - r.y[past:]) ** 2).mean(axis=0)


def level_error(squares: dict[str, np.ndarray], level: str) -> float:
    """Mean over outputs and records."""
    own: Sequence[np.ndarray] = [s for name, s in squares.items() if name.startswith(level)]
    return float(np.sqrt(np.stack(own)).mean())


if __name__ == "__main__":
    main()
