"""Dry run of a candidate during a search: in the sandbox of its evaluator, on made-up records,
without a record in the ledger.
"""

from __future__ import annotations

from dataclasses import replace

from asia.judge.evaluation.dry_runs import DryRun, allowed_seconds, made_up_fold
from asia.judge.evaluation.dry_runs import dry_run as run_dry
from asia.judge.evaluation.relations import SuspicionKind
from asia.judge.sandbox.types import Isolation
from asia.ledger.run import Run
from asia.problem.folds import make_folds
from asia.problem.load import load_lock
from asia.search.run import LOCK, make_evaluator


def dry_run(run: Run, source: str, isolation: Isolation | None = None) -> DryRun:
    """Try `source` as the search of `run` would judge it, on made-up records like those that the
    first fold trains on. isolation: level of the candidate; None for the strongest of this machine.
    Raises UserError where the data of the run are not what they were."""
    problem = load_lock(run.directory / LOCK)
    limit = problem.budget.fit_seconds
    fold = make_folds(problem.train, problem.protocol)[0]
    short = made_up_fold(fold, problem.protocol)
    budget = replace(problem.budget, fit_seconds=allowed_seconds(limit))
    allowed = replace(problem, budget=budget, train=short.train)
    evaluator = make_evaluator(
        allowed, run.view, folds=[short], without=SuspicionKind, isolation=isolation
    )
    return run_dry(evaluator, fold, source, limit)
