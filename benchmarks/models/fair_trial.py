"""V and time of a fair trial: a family's first configuration with its freest setting, against the
variant that the search chooses inside the training records.

For each measured system and family the table has V relative to the best linear model, without and
with the choice, the chosen variant, and the time with the choice over that without. Fits are made
in the sandbox, as in a search. Variants are taken from `asia.search.fair_trial`.

    python benchmarks/models/fair_trial.py --zoo DATA/zoo
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import geometric_mean

from asia.agents.library.registry import family
from asia.judge.evaluation.evaluator import Evaluation, EvaluationData, Evaluator
from asia.judge.evaluation.fold_fits import search_context
from asia.judge.evaluation.references import LINEAR, best_linear
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import LocalExecutor
from asia.judge.sandbox.availability import probe
from asia.judge.scoring.outcome import Score
from asia.problem.folds import make_folds
from asia.problem.load import load_problem
from asia.problem.problem import prepared
from asia.search.agent_views import problem_facts
from asia.search.fair_trial import choice, variants_of

SYSTEMS = "heating,hairdryer,dryer2,cd_arm"
FAMILIES = "neural_ss,nl_lfr,block_oriented"
LOST = 3.0
"""Ratio to the linear model at which a failed or diverged candidate is counted."""


def ratio(evaluation: Evaluation, linear: float) -> float:
    """V over that of the linear model, at most `LOST`."""
    outcome = evaluation.outcome
    return min(outcome.value / linear, LOST) if isinstance(outcome, Score) else LOST


def rows(system: Path, families: Sequence[str]) -> list[tuple[float, float, float]]:
    """Print a row for each family; return the two ratios to the linear model and that of times."""
    problem = load_problem(str(system))
    rule, facts = problem.protocol, problem_facts(problem)
    records = prepared(problem, problem.train)
    folds = make_folds(records, rule)
    workers = WorkerRunner(probe().level, problem.budget, LocalExecutor(), standby=len(folds))
    found: list[tuple[float, float, float]] = []
    with workers.ready_workers():
        evaluator = Evaluator(
            EvaluationData(folds, records, search_context(problem, 0), rule), workers
        )
        reference = best_linear(evaluator)
        assert isinstance(reference.outcome, Score)
        linear = reference.outcome.value
        for name in families:
            row = family(name)
            assert row is not None
            source = row.trial(facts).source(name)
            begins = {"linear": reference.source or LINEAR}
            sources = variants_of(source, begins)
            if not sources:
                continue
            begun = time.monotonic()
            free = evaluator.evaluate(list(sources.values())[-1])
            between = time.monotonic()
            sources, tried = choice(evaluator, source, begins)
            chosen = next((v.name for v in tried if v.chosen), list(sources)[-1])
            fair = evaluator.evaluate(sources[chosen])
            seconds = time.monotonic() - between, between - begun
            pair = ratio(free, linear), ratio(fair, linear)
            found.append((*pair, seconds[0] / seconds[1]))
            inner = ", ".join(
                f"{v.name} {'failed' if v.error is None else f'{v.error:.4g}'}"
                f"{f' (+{v.behind:.2g} of {v.deviation:.2g})' if v.behind else ''}"
                for v in tried
            )
            print(
                f"| {system.name} | {linear:.4g} | {name} | {pair[0]:.3f} | {pair[1]:.3f} | "
                f"{chosen} | {seconds[1]:.0f} s, {seconds[0] / seconds[1]:.1f} | {inner} |",
                flush=True,
            )
    return found


def main() -> None:
    """Print a row for each system and family, then the means."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--zoo", type=Path, required=True)
    parser.add_argument("--systems", default=SYSTEMS)
    parser.add_argument("--families", default=FAMILIES)
    options = parser.parse_args()
    print("| system | linear V | family | freest | chosen | variant | seconds, ratio | inner |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    found: list[tuple[float, float, float]] = []
    for name in options.systems.split(","):
        found += rows(options.zoo / name, options.families.split(","))
    free, fair, time_ratio = zip(*found, strict=True)
    for label, each in (("freest", free), ("chosen", fair)):
        worse = sum(one > 1.001 for one in each), sum(one > 1.2 for one in each)
        print(
            f"{label}: {geometric_mean(each):.3f} of the linear V; {worse[0]} of {len(each)} worse "
            f"than it, {worse[1]} by more than 1.2"
        )
    print(f"time: {geometric_mean(time_ratio):.1f} of that without the choice")


if __name__ == "__main__":
    main()
