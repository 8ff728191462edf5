"""Fit, score and decide on one candidate.

A candidate about to become the incumbent is fitted again from other seeds. It takes the title where
its mean over the seeds is lower than the incumbent's by the floor. That is a statement on its
method. Its first fit is a model by itself: where its V is the lowest so far, it is the one to hand
over, whatever is said of the method.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean

from asia.evaluation import BackgroundJob, Evaluation, Evaluator, FoldResult, same_simulations
from asia.ledger import Retest, SearchView, Status
from asia.scoring import Failure, Score, least_significant_difference
from asia.search.deciding.retesting import retest_fits
from asia.search.deciding.rules import decide

_FIRST_SEED = 1_000_000
"""The number of the first seed of retests: those of `asia validate --repeat` count from 1, and
a seed that chose a winner must not confirm it too."""
_WORTH_A_RETEST = 0.5
"""The share of the floor by which a first fit must be lower: with less, two more fits make a
new best very unlikely."""

_NARROW = 0.1
"""The largest floor, over the mean, that an incumbent fitted from fewer seeds may leave: a wide one
would keep better candidates out."""


@dataclass(frozen=True)
class Judged:
    """A candidate and the decision on it."""

    evaluation: Evaluation
    """Its first fit, or why there is no score."""
    status: Status
    """The decision."""
    retests: tuple[Retest, ...] = ()
    """Its fits from other seeds."""
    floor: float | None = None
    """Significance threshold: required improvement of the mean over seeds; None without an
    incumbent, or if one fit decides.
    """
    deadline: bool = False
    """True if the speed of the machine influenced the decision."""
    validation_scores: int = 0
    """Validation scores given in all fits."""
    lowest: bool = False
    """True if the candidate's own fit is the best so far; its model is handed over until another is
    lower.
    """


@dataclass(frozen=True)
class _Decision:
    """Decision from the fits with several seeds."""

    status: Status
    retests: tuple[Retest, ...] = ()
    floor: float | None = None
    deadline: bool = False
    validation_scores: int = 0


def judge(
    evaluator: Evaluator,
    source: str,
    view: SearchView,
    evaluation: Evaluation | None = None,
    over: float | None = None,
) -> Judged:
    """Evaluate and decide, by the rule that the ledger names. A candidate that would be kept, or
    handed over, must also come back bitwise the same from its bytes, and answer like a model. With
    the Ladder every candidate with a score must: otherwise the check, and the time it takes, would
    say which one is kept. After an objection the folds stay. evaluation: where its first fit was
    made before; over: as in `Proposed`."""
    if evaluation is None:
        evaluation = evaluator.evaluate_first(source, over)
    asked = evaluation.validation_scores
    if isinstance(evaluation.outcome, Failure):
        status = evaluation.outcome.reason.status
        return Judged(evaluation, status, (), None, status == "timeout", asked)
    folds, answers = evaluation.folds, None
    lowest = view.started.retests > 0 and _is_best(evaluation.outcome, view)
    with ExitStack() as opened:
        if lowest and not evaluator.one_by_one:
            # It is checked whatever the retests say.
            check = partial(evaluator.objection_to_answers, source, folds)
            answers = opened.enter_context(evaluator.background(check))
        if view.started.retests:
            found = _Retesting(evaluator, source, evaluation, evaluation.outcome, view).decide()
        else:
            found = _Decision(decide(evaluation.outcome, view))
        status = found.status
        if lowest and status == "discard":
            # From other seeds its method is no better. Its own fit is.
            status = "inconclusive"
        if status == "keep" or lowest or view.started.ladder is not None:
            failure = _objection(evaluator, source, folds, answers)
            if failure is not None:
                evaluation = replace(evaluation, outcome=failure)
                status, lowest = failure.reason.status, False
    deadline = found.deadline or status == "timeout"
    asked += found.validation_scores
    return Judged(evaluation, status, found.retests, found.floor, deadline, asked, lowest)


def _objection(
    evaluator: Evaluator,
    source: str,
    folds: Sequence[FoldResult],
    answers: BackgroundJob[Failure | None] | None,
) -> Failure | None:
    """answers: the part of the checks that has been begun."""
    if answers is None:
        return evaluator.objection(source, folds)
    return answers.result() or evaluator.objection_to_consistency(source, folds)


@dataclass(frozen=True)
class _Retesting:
    """Repeated fits of a candidate with a score, compared with the incumbent."""

    evaluator: Evaluator
    source: str
    first: Evaluation
    score: Score
    view: SearchView

    def decide(self) -> _Decision:
        """`discard` where it is not lower than the incumbent, `inconclusive` where it is, but not
        by the floor. Each as soon as it is certain enough, so most candidates cost no fit
        more."""
        held = self.view.incumbent
        if held is None:
            # Nothing to beat; its spread is the first floor.
            return replace(self._repeat(()), status="keep")
        known = held.seed_values
        floor, lead = least_significant_difference(known, known), fmean(known) - self.score.value
        if lead <= 0.0:
            return _Decision("discard", floor=floor)
        if lead < _WORTH_A_RETEST * floor:
            return _Decision("inconclusive", floor=floor)
        return self._repeat(known)

    def _repeat(self, known: Sequence[float]) -> _Decision:
        """Fit from other seeds until the decision is clear, or there are no more."""
        most = self.view.started.retests
        with retest_fits(self.evaluator, self._fit, most) as fit:
            return self._decided(known, fit, most)

    def _fit(self, number: int) -> Evaluation:
        return self.evaluator.evaluate(self.source, _FIRST_SEED + number)

    def _decided(
        self, known: Sequence[float], fit: Callable[[int], Evaluation], most: int
    ) -> _Decision:
        retests: list[Retest] = []
        values, asked, timed_out, failed = [self.score.value], 0, False, False
        for number in range(most):
            begin = time.monotonic()
            again = fit(number)
            seconds = time.monotonic() - begin
            asked += again.validation_scores
            outcome = again.outcome
            if isinstance(outcome, Failure):
                retests.append(Retest(failed=outcome.reason.value, seconds=seconds))
                timed_out, failed = outcome.reason.status == "timeout", True
                break
            same = same_simulations(self.first.y_hats, again.y_hats)
            folds = tuple(fold.value for fold in outcome.folds)
            retests.append(Retest(outcome.value, folds, same=same, seconds=seconds))
            if same:
                # One fit shows it: the others would be the same.
                break
            values.append(outcome.value)
            higher = fmean(values) >= fmean(known) if known else False
            if higher or (known and _is_lower(values, known) and _is_narrow(values)):
                break
        status, floor = _decision(values, known, failed=failed)
        return _Decision(status, tuple(retests), floor, timed_out, asked)


def _is_best(score: Score, view: SearchView) -> bool:
    best = view.best.score if view.best else None
    return best is None or score.value < best.value


def _decision(
    values: Sequence[float], known: Sequence[float], *, failed: bool
) -> tuple[Status, float | None]:
    if not known:
        return "keep", None
    floor = least_significant_difference(values, known)
    if fmean(values) >= fmean(known):
        return "discard", floor
    return "keep" if not failed and _is_lower(values, known) else "inconclusive", floor


def _is_lower(values: Sequence[float], known: Sequence[float]) -> bool:
    """Return whether the mean is lower by more than the threshold, or by any amount if neither
    depends on the seed.
    """
    return fmean(known) - fmean(values) > least_significant_difference(values, known)


def _is_narrow(values: Sequence[float]) -> bool:
    """Return whether these seeds suffice for an incumbent: the threshold that they give is
    small.
    """
    return least_significant_difference(values, values) <= _NARROW * fmean(values)
