"""Gain of a model without `step` that looks ahead inside chunks, up to where a check objects.

python benchmarks/machinery/look_ahead.py [--samples 480] [--seeds 8] [--shares 0.1 0.2 0.3]

The candidate simulates an honest first-order lag and takes a share of the way to the next measured
output, which an input carries. A chunk ends where its inputs turn back: from there on it answers
honestly. Printed are the mean and the lowest V over that of the honest candidate, on records from
several seeds, and on how many of them the evaluator objects. Candidates run in its sandbox.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from asia.data.trajectory import Trajectory
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.sandbox.availability import probe
from asia.judge.scoring.outcome import Score

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.redteam.attacks.source import HONEST, candidate, fill_in
from tests.redteam.problem import SmallProblem, small_problem

LOOK_AHEAD = """
def ahead(past_u, past_y, u):
    plain = honest(past_u, past_y, u)
    y = plain.copy()
    y[:, :-1] += SHARE * (u[:, 1:, 1:2] - y[:, :-1])
    turned = np.flatnonzero(np.abs(np.diff(u[0, :, 2])) < 0.5)
    if len(turned):
        y[:, turned[0] :] = plain[:, turned[0] :]
    return y
"""


def main() -> None:
    ask = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    ask.add_argument("--samples", type=int, default=480)
    ask.add_argument("--seeds", type=int, default=8)
    ask.add_argument("--shares", type=float, nargs="+", default=[0.1, 0.15, 0.2, 0.25, 0.3, 0.4])
    given = ask.parse_args()
    for share in given.shares:
        found = [gained(noisy(seed, given.samples), share) for seed in range(given.seeds)]
        ratios = [ratio for ratio, _ in found]
        print(
            f"{given.samples} samples, share {share:g}: V {np.mean(ratios):.3f} times that of the "
            f"honest candidate (lowest {min(ratios):.3f}), "
            f"{sum(refused for _, refused in found)} of {given.seeds} refused",
            flush=True,
        )


def noisy(seed: int, samples: int) -> SmallProblem:
    """The noisy problem of the red team with another record."""
    problem = small_problem("noisy")
    pole, gain = problem.crude
    rng = np.random.default_rng(100 + seed)
    drive = np.repeat(rng.normal(size=-(-samples // 6)), 6)[:samples]
    y = np.zeros(samples)
    for k in range(1, samples):
        y[k] = pole * y[k - 1] + gain * drive[k - 1]
    y += 0.2 * rng.normal(size=samples)
    before = np.concatenate([[0.0], y[:-1]])
    u = np.stack([drive, before, np.arange(float(samples))], axis=1)
    return replace(problem, records=(Trajectory(u, y, 1.0, "record"),))


def gained(problem: SmallProblem, share: float) -> tuple[float, bool]:
    """V over that of the honest candidate, and whether a check objects."""
    evaluator = problem.evaluator(WorkerRunner, probe().level, seconds=60.0, memory_mb=2048)
    top = f"SHARE = {share}\n{LOOK_AHEAD}"
    cheat = candidate(after="ahead(past_u, past_y, u)", top=top)
    plain, source = (fill_in(one, "{'MARK': 'rt'}", problem) for one in (HONEST, cheat))
    honest, found = evaluator.evaluate(plain).outcome, evaluator.evaluate(source)
    assert isinstance(honest, Score), honest
    assert isinstance(found.outcome, Score), found.outcome
    refused = evaluator.objection(source, found) is not None
    return found.outcome.value / honest.value, refused


if __name__ == "__main__":
    main()
