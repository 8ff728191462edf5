"""The look at the guard: how the last incumbents do on records that no search has seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asia.data.trajectory import Array, spread_of
from asia.errors import CandidateError
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.evaluation.results import mean_simulation
from asia.judge.scoring.outcome import Failure, Outcome, Score, combine, score_fold
from asia.ledger.artifacts import Store
from asia.ledger.events import GuardLooked, GuardScore
from asia.ledger.view import Experiment, SearchView
from asia.problem.problem import Problem
from asia.problem.protocol import Block, whole
from asia.problem.seal import open_guard

NEW_BESTS = 3


def look_at_guard(
    problem: Problem, evaluator: Evaluator, store: Store, view: SearchView
) -> GuardLooked:
    """Score the ensembles of the last three new bests on the guard records, in the search's metric
    over the standard deviations of all training records. Where the same ones were looked at before,
    nothing new is learned and the look is not counted again."""
    bests = view.bests
    last = view.looks[-1] if view.looks else None
    expected = [e.number for e in bests[-NEW_BESTS:]]
    if last is not None and [score.experiment for score in last.scores] == expected:
        return last
    blocks = whole(open_guard(problem), problem.protocol)
    y = np.concatenate([record.measured_y for record in problem.train])
    scores: list[GuardScore] = []
    for experiment in bests[-NEW_BESTS:]:
        found = _simulated(evaluator, store, experiment, blocks)
        if not isinstance(found, Failure):
            found = _scored(blocks, found, spread_of(y), problem.protocol.metric)
        scores.append(GuardScore(experiment.number, found))
    values = [(s.outcome.value, s.experiment) for s in scores if isinstance(s.outcome, Score)]
    pick = min(values)[1] if values else None
    return GuardLooked(look=1 + (last.look if last else 0), scores=tuple(scores), pick=pick)


def _simulated(
    evaluator: Evaluator, store: Store, experiment: Experiment, blocks: Sequence[Block]
) -> tuple[Array, ...] | Failure:
    """The mean of the fold models' simulations, one (H, ny) array a block."""
    assert experiment.result is not None
    models = [store.get(fold.model) for fold in experiment.result.folds]
    try:
        source = store.text(experiment.proposed.source)
        return mean_simulation(evaluator.models.simulate_scored(source, models, blocks))
    except CandidateError as error:
        return Failure(error.reason, error.detail)


def _scored(blocks: Sequence[Block], y_hat: Sequence[Array], scale: Array, metric: str) -> Outcome:
    try:
        return combine([score_fold([b.y for b in blocks], y_hat, scale, metric)])
    except CandidateError as error:
        return Failure(error.reason, error.detail)
