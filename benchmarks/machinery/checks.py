"""Cost of the checks on answers for a scored evaluation and for a new best.

python benchmarks/machinery/checks.py [--problems two_tanks_sim cascaded_tanks] [--repeats 3]

For each problem its baseline and a first candidate of the library's aptest families are evaluated
with all relations checked and with none, in turns. `scored` is the evaluation of a candidate, `new
best` the examination that follows where it would be kept. Prints medians and the ratio of the sum
of both to the evaluation without checks.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Collection
from statistics import median

from asia.agents.library.registry import all_families
from asia.candidate import Context
from asia.judge.evaluation.evaluator import EvaluationData, Evaluator, EvaluatorOptions
from asia.judge.evaluation.relations import SuspicionKind
from asia.judge.evaluation.results import Evaluation
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import LocalExecutor
from asia.judge.sandbox.availability import machine, probe
from asia.judge.scoring.outcome import Failure
from asia.problem.folds import make_folds
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from asia.search.agent_views import problem_facts

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
    print("| problem | candidate | without | scored | new best | ratio |")
    print("|---|---|---|---|---|---|")
    for name in given.problems:
        problem = load_problem(name)
        for family, source in candidates(problem, given.families).items():
            print(f"| {name} | {family} | {row(problem, source, given.repeats)} |", flush=True)


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
        objection = checked.objection(source, found.folds)
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
