"""The look at the guard: how the last incumbents do on records that no search has seen."""

from __future__ import annotations

from asia.judge.evaluation.description import guard_error
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.scoring.outcome import Score
from asia.ledger.artifacts import Store
from asia.ledger.events import GuardLooked, GuardScore
from asia.ledger.view import SearchView
from asia.problem.folds import whole
from asia.problem.problem import Problem
from asia.problem.seal import open_guard

NEW_BESTS = 3


def look_at_guard(
    problem: Problem, evaluator: Evaluator, store: Store, view: SearchView
) -> GuardLooked:
    """Score the ensembles of the last three new bests on the guard records, in the search's metric
    over the standard deviations of all training records. Where the same ones were looked at before,
    nothing new is learned and the look is not counted again."""
    bests = view.bests[-NEW_BESTS:]
    last = view.looks[-1] if view.looks else None
    if last is not None and [s.experiment for s in last.scores] == [e.number for e in bests]:
        return last
    blocks = whole(open_guard(problem), problem.protocol)
    scores: list[GuardScore] = []
    for experiment in bests:
        models = [store.get(fold.model) for fold in experiment.folds]
        outcome = guard_error(evaluator, store.text(experiment.proposed.source), models, blocks)
        scores.append(GuardScore(experiment.number, outcome))
    values = [(s.outcome.value, s.experiment) for s in scores if isinstance(s.outcome, Score)]
    pick = min(values)[1] if values else None
    return GuardLooked(look=1 + (last.look if last else 0), scores=tuple(scores), pick=pick)
