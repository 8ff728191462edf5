"""Cost of streamed simulations and of the checks on answers, for a scored evaluation and for a new
best.

python benchmarks/machinery/checks.py [--problems two_tanks_sim cascaded_tanks long] [--repeats 3]

For each problem its baseline and a first candidate of the library's aptest families are evaluated
as a search does and, in turns, without any principle or relation: each record at once, and all in
one worker. `long` is a made-up record of 100 000 samples. `scored` is the evaluation of a
candidate, `new best` the examination that follows where it would be kept. Prints medians and the
ratio of the sum of both to the evaluation without them. The first lines are the round trip of one
sample and the start of a worker.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Collection
from dataclasses import replace
from statistics import median

import numpy as np

from asia.agents.library.registry import all_families
from asia.candidate import Context
from asia.data.trajectory import Signal, Trajectory
from asia.judge.evaluation.evaluator import Evaluation, EvaluationData, Evaluator, EvaluatorOptions
from asia.judge.evaluation.relations import SuspicionKind
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import LocalExecutor
from asia.judge.sandbox.availability import machine, open_worker, probe
from asia.judge.sandbox.types import Limits
from asia.judge.scoring.outcome import Failure
from asia.problem.folds import make_folds
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from asia.search.agent_views import problem_facts

LONG = 100_000
HOLD = """
class Hold:
    def initial(self, past_u, past_y, u):
        return past_y[:, -1]

    def step(self, x, u):
        return x, x

    def simulate(self, past_u, past_y, u):
        return past_y[:, -1:] + 0 * u


def fit(trajectories, context):
    return Hold()
"""
FAMILIES = ("greybox", "physics_net", "linear", "narx", "recurrent")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", nargs="+", default=["two_tanks_sim", "cascaded_tanks"])
    parser.add_argument("--families", nargs="+", default=FAMILIES)
    parser.add_argument("--repeats", type=int, default=3)
    given = parser.parse_args()
    here = machine()
    print(
        f"{here.system}, {here.cores} cores, Python {here.python}, load {os.getloadavg()[0]:.1f};"
    )
    print(f"medians of {given.repeats}, seconds\n")
    for libraries in ((), ("jax",)):
        print(f"start of a worker{' with JAX' if libraries else ''}: {start(libraries):.2f} s")
    print(f"round trip of one sample: {1e6 * round_trip():.0f} us\n")
    print("| problem | candidate | without | scored | new best | ratio |")
    print("|---|---|---|---|---|---|")
    for name in given.problems:
        problem = long_problem() if name == "long" else load_problem(name)
        for family, source in candidates(problem, given.families).items():
            print(f"| {name} | {family} | {row(problem, source, given.repeats)} |", flush=True)


def long_problem() -> Problem:
    """Two tanks' description with one long record of a saturating lag."""
    random = np.random.default_rng(1)
    u = np.repeat(random.normal(size=LONG // 20), 20)
    y = np.zeros(LONG)
    for k in range(1, LONG):
        y[k] = 0.97 * y[k - 1] + 0.03 * np.tanh(u[k - 1])
    record = Trajectory(u, y + 0.005 * random.normal(size=LONG), 1.0, "long")
    return replace(load_problem("two_tanks_sim"), train=(record,), baseline=None)


def start(libraries: Collection[str]) -> float:
    """Median seconds of the start and end of a worker."""
    times: list[float] = []
    for _ in range(7):
        begin = time.monotonic()
        with open_worker(probe().level, Limits(60.0, 60.0, 4096), libraries=libraries) as worker:
            worker.wait()
        times.append(time.monotonic() - begin)
    return median(times)


def round_trip() -> float:
    """Median seconds of one sample of a model that does next to nothing."""
    one, times = (Signal("u"),), list[float]()
    u, past = np.zeros((1, 2000, 1)), np.zeros((1, 1, 1))
    with open_worker(probe().level, Limits(60.0, 60.0, 4096)) as worker:
        worker.fit(HOLD, [], Context(one, one, 1.0, 1, 1))
        for _ in range(7):
            begin = time.monotonic()
            worker.simulate(past, past, u)
            times.append((time.monotonic() - begin) / u.shape[1])
    return median(times)


def candidates(problem: Problem, families: Collection[str]) -> dict[str, str]:
    """The baseline and the families' first candidates."""
    facts = problem_facts(problem)
    rows = [one for one in all_families() if one.name in families and one.suits(facts)]
    return ({"baseline": problem.baseline} if problem.baseline else {}) | {
        one.name: one.trial(facts).source(one.label) for one in rows
    }


def row(problem: Problem, source: str, repeats: int) -> str:
    """Medians over the turns."""
    plain, checked = evaluator(problem, tuple(SuspicionKind)), evaluator(problem, ())
    times: list[tuple[float, float, float]] = []
    for _ in range(repeats):
        bare, _ = timed(plain, source)
        scored, found = timed(checked, source)
        if isinstance(found.outcome, Failure):
            return f"failed: {found.outcome.reason}"
        begin = time.monotonic()
        objection = checked.objection(source, found)
        if objection is not None:
            return f"refused: {objection.detail}"
        times.append((bare, scored, time.monotonic() - begin))
    bare, scored, best = (median(column) for column in zip(*times, strict=True))
    return f"{bare:.1f} | {scored:.1f} | {best:.1f} | {(scored + best) / bare:.2f}"


def timed(judge: Evaluator, source: str) -> tuple[float, Evaluation]:
    """Seconds, and what came of it."""
    begin = time.monotonic()
    found = judge.evaluate(source)
    return time.monotonic() - begin, found


def evaluator(problem: Problem, without: Collection[SuspicionKind]) -> Evaluator:
    """As a search makes one, on two cores."""
    rule = problem.protocol
    facts = problem_facts(problem)
    context = Context(
        facts.inputs, facts.outputs, facts.sampling_time, rule.past_inputs, rule.past_outputs,
        rule.horizon, rule.metric, problem.physics, seed=1,
    )  # fmt: skip
    data = EvaluationData(make_folds(problem.train, rule), problem.train, context, rule)
    workers = WorkerRunner(probe().level, problem.budget, LocalExecutor(2))
    return Evaluator(data, workers, EvaluatorOptions("benchmark", without))


if __name__ == "__main__":
    main()
