"""Literals of new bests, compared with the first best of the search and its guard records."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from asia.judge.evaluation.description import (
    SCATTER,
    Guard,
    Standard,
    check_literals,
    guard_error,
)
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.evaluation.references import LINEAR, MEAN_REFERENCE, training_mean
from asia.judge.evaluation.results import Evaluation
from asia.judge.scoring.description import LiteralCheck, guard_gap
from asia.judge.scoring.outcome import Score
from asia.ledger.artifacts import Store
from asia.ledger.view import Experiment, SearchView
from asia.problem.folds import Block, whole
from asia.problem.problem import Problem
from asia.problem.seal import open_guard
from asia.report.simulated import fold_outputs

LiteralCheckFunction = Callable[[str, Evaluation, SearchView], LiteralCheck | None]
"""Check of the literals of a source with this evaluation."""


@dataclass(frozen=True)
class LiteralExaminer:
    """Compares the literals of new bests with what they gained."""

    problem: Problem
    evaluator: Evaluator
    store: Store

    def check(self, source: str, evaluation: Evaluation, view: SearchView) -> LiteralCheck | None:
        """Check a candidate with a score that is about to be a new best. None for the first
        experiment, which is the problem's baseline, and in searches of older versions.

        V below that of the simulated truth is doubted whatever the literals.
        """
        score = evaluation.outcome
        if not view.started.literal_check or not isinstance(score, Score) or not view.finished:
            return None
        standard = self._standard(view)
        if standard is None:
            return None
        truth = view.truth
        return check_literals(
            self.evaluator, source, score, evaluation.folds, standard,
            partial(self._guard, view, standard),
            doubted=truth is not None and view.below_truth(score.value),
        )  # fmt: skip

    def _standard(self, view: SearchView) -> Standard | None:
        """The first best; the training mean where an agent's candidate would be the first."""
        folds = self.evaluator.data.folds
        if not view.bests:
            mean = next((r.outcome for r in view.references if r.name == MEAN_REFERENCE), None)
            if not isinstance(mean, Score):
                return None
            y_hats = [tuple(training_mean(f, b) for b in f.held_out) for f in folds]
            return Standard(1, self.problem.baseline or LINEAR, mean, y_hats)
        first = view.bests[0]
        assert first.score is not None
        y_hats = fold_outputs(self.store, first, folds)
        source = self.store.text(first.proposed.source)
        return Standard(first.number, source, first.score, y_hats)

    def _guard(self, view: SearchView, standard: Standard) -> Guard | None:
        if view.started.guard_digest is None:
            return None
        known = [(e, e.result.literals) for e in view.bests if e.result and e.score]
        gaps = [
            guard_gap(found.guard, e.score.value)
            for e, found in known
            if e.score is not None and found is not None and found.guard is not None
        ]
        first = self._first_gap(view.bests[0]) if view.bests else self._mean_gap(standard)
        return Guard(self._blocks, min([first, *(gap + SCATTER for gap in gaps)]))

    @cached_property
    def _blocks(self) -> tuple[Block, ...]:
        return tuple(whole(open_guard(self.problem), self.problem.protocol))

    @cached_property
    def _gaps(self) -> dict[int, float]:
        return {}

    def _first_gap(self, first: Experiment) -> float:
        """Gap between guard records and V of the first best."""
        assert first.result is not None
        assert first.score is not None
        if first.number not in self._gaps:
            models = [self.store.get(fold.model) for fold in first.result.folds]
            source = self.store.text(first.proposed.source)
            outcome = guard_error(self.evaluator, source, models, self._blocks)
            value = outcome.value if isinstance(outcome, Score) else np.inf
            self._gaps[first.number] = guard_gap(value, first.score.value)
        return self._gaps[first.number]

    def _mean_gap(self, standard: Standard) -> float:
        """Gap between guard records and V of the training mean."""
        data = self.evaluator.data
        y = np.concatenate([record.measured_y for record in data.records])
        apart = np.concatenate([block.y for block in self._blocks]) - np.nanmean(y, axis=0)
        error = float(np.mean(np.sqrt(np.nanmean(apart**2, axis=0)) / data.scale))
        return guard_gap(error, standard.score.value)
