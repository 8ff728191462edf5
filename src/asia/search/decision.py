"""Decision on a candidate: keep or discard, with retests from other seeds and the threshold.

`decide` is the entry. A candidate about to become the incumbent is fitted again from other seeds.
It is kept where its mean over the seeds is lower than the incumbent's by more than the significance
threshold. That is a statement on its method. Its first fit is a model by itself: where its V is the
lowest so far, it is the one to hand over, whatever is decided on the method. Neither happens where
the held-out samples of the folds do not show the gain, or show a loss in one fold.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean

from asia.agents.view import PARENT
from asia.judge.evaluation.evaluator import Evaluation, Evaluator
from asia.judge.evaluation.references import LINEAR_REFERENCE
from asia.judge.scoring.confirmation import ComparedParts, Confirmation, paired_gain
from asia.judge.scoring.outcome import Failure, Outcome, Score, same_simulations
from asia.judge.scoring.repeated_fits import is_lower, significance_threshold
from asia.ledger.artifacts import Store
from asia.ledger.events import Fit, Proposed, Status
from asia.ledger.view import Experiment, SearchView
from asia.search.fair_trial import Tried, first_fit
from asia.search.pending import retest_fits

_FIRST_SEED = 1_000_000
"""The number of the first seed of retests: those of `asia validate --repeat` count from 1, and
a seed that chose a best candidate must not confirm it too."""
_WORTH_A_RETEST = 0.5
"""The share of the threshold by which a first fit must be lower: with less, two more fits make a
new best very unlikely."""

RETEST_LIMIT = 1.5
"""V over that of the linear reference from which on nobody would use a candidate, so that its
scatter is not worth two fits: those of a poor baseline can take as long as a whole search."""

_NARROW = 0.1
"""The largest threshold, over the mean, that an incumbent fitted from fewer seeds may leave."""

Confirm = Callable[[str, Evaluation, SearchView], Confirmation | None]
"""Confirmation of the gain of a source with this evaluation; None where V alone is evidence."""


@dataclass(frozen=True)
class Decision:
    """A candidate and the decision on it."""

    tried: Tried
    """Its first fit, or why there is no score."""
    status: Status
    retests: tuple[Fit, ...] = ()
    threshold: float | None = None
    """Required improvement of the mean over seeds; None without incumbent or if one fit decides."""
    deadline: bool = False
    """True if the speed of the machine influenced the decision."""
    validation_scores: int = 0
    """Validation scores given in all fits."""
    lowest: bool = False
    """True if its own fit is the best so far."""
    confirmation: Confirmation | None = None
    """Its gain where nobody could read the answers; None where it was not asked."""

    @property
    def evaluation(self) -> Evaluation:
        """Evaluation of the source that was scored."""
        return self.tried.evaluation


def decide(
    evaluator: Evaluator,
    source: str,
    view: SearchView,
    tried: Tried | None = None,
    proposed: Proposed | None = None,
    confirm: Confirm | None = None,
    store: Store | None = None,
) -> Decision:
    """Evaluate and decide, by the rule that the ledger names. A candidate that would be kept, or
    handed over, must also come back bitwise the same from its bytes, and answer like a model. After
    an objection the folds stay. A new best whose gain is not confirmed is neither kept nor handed
    over. tried: where its first fit was made before; store: artifacts of the search."""
    if tried is None:
        tried = first_fit(evaluator, source, view, proposed, store)
    source, evaluation = tried.source, tried.evaluation
    scores, outcome = evaluation.validation_scores, evaluation.outcome
    if isinstance(outcome, Failure):
        status = outcome.reason.status
        timed_out = status == "timeout"
        return Decision(tried, status, deadline=timed_out, validation_scores=scores)
    if any(v.chosen and v.name == PARENT for v in tried.variants):
        return Decision(tried, "discard", validation_scores=scores)
    objected, confirmation = None, None
    best = view.best.score if view.best else None
    lowest = view.started.retests > 0 and (best is None or outcome.value < best.value)
    if view.started.by_folds and lowest and view.best and store is not None:
        doubt = fold_doubt(evaluator, evaluation, view.best, store)
        if doubt is not None:
            return Decision(tried, doubt, validation_scores=scores)
    check = partial(evaluator.objection, source, evaluation)
    with ExitStack() as opened:
        if lowest and not evaluator.workers.is_sequential:
            # It is checked whatever the retests say.
            objected = opened.enter_context(evaluator.workers.background(check))
        if view.started.retests:
            decision = _decide_by_retests(evaluator, tried, outcome, view)
        else:
            decision = Decision(tried, decide_by_one_fit(outcome, view), validation_scores=scores)
        status = decision.status
        if lowest and status == "discard":
            # From other seeds its method is no better. Its own fit is.
            status = "inconclusive"
        if status == "keep" or lowest:
            failure = check() if objected is None else objected.result()
            if failure is None and confirm is not None:
                confirmation = confirm(source, evaluation, view)
                if confirmation is not None and not confirmation.confirmed:
                    status, lowest = "unconfirmed", False
            if failure is not None:
                refused = replace(failure, folds=evaluation.folds)
                evaluation = replace(evaluation, outcome=refused)
                status, lowest = failure.reason.status, False
    return replace(
        decision,
        tried=replace(tried, evaluation=evaluation),
        status=status,
        deadline=decision.deadline or status == "timeout" or tried.late,
        lowest=lowest,
        confirmation=confirmation,
    )


def fold_doubt(
    evaluator: Evaluator, evaluation: Evaluation, best: Experiment, store: Store
) -> Status | None:
    """Compare a candidate of lower V with the best one on the held-out samples of the folds:
    `inconclusive` where the gain over all of them is not more than chance, `mixed` where it is and
    a fold is worse by more than chance, None where nothing speaks against it."""
    metric = evaluator.data.rule.metric
    parts = [
        ComparedParts(
            [block.y for block in fold.held_out],
            store.get_arrays(before.y_hat, fold.shapes),
            evaluation.artifacts.get_arrays(after.y_hat, fold.shapes),
            fold.scale,
        )
        for fold, before, after in zip(
            evaluator.data.folds, best.folds, evaluation.folds, strict=True
        )
    ]
    if paired_gain(parts, metric).low <= 0.0:
        return "inconclusive"
    return "mixed" if any(paired_gain([one], metric).high < 0.0 for one in parts) else None


def _decide_by_retests(
    evaluator: Evaluator, tried: Tried, score: Score, view: SearchView
) -> Decision:
    """Fit from other seeds until the decision is clear, or there are no more.

    `discard` where it is not lower than the incumbent, `inconclusive` where it is, but not
    significantly. Each as soon as it is certain enough, so most candidates cost no fit more.
    """
    first, known = tried.evaluation, view.incumbent.seed_values if view.incumbent else ()
    scores = first.validation_scores
    if known:
        threshold, lead = significance_threshold(known, known), fmean(known) - score.value
        if lead < _WORTH_A_RETEST * threshold or lead <= 0.0:
            status = "discard" if lead <= 0.0 else "inconclusive"
            return Decision(tried, status, threshold=threshold, validation_scores=scores)
    retests: list[Fit] = []
    values, failure = [score.value], None
    most = view.started.retests
    limit, linear = view.started.retest_limit, view.reference_value(LINEAR_REFERENCE)
    if limit is not None and linear is not None and score.value >= limit * linear:
        most = 0

    def fit(number: int) -> Evaluation:
        return evaluator.evaluate(tried.source, _FIRST_SEED + number)

    with retest_fits(evaluator, fit, most) as take:
        for number in range(most):
            seed, begin = _FIRST_SEED + number, time.monotonic()
            again = take(number)
            seconds = time.monotonic() - begin
            scores += again.validation_scores
            outcome = again.outcome
            if isinstance(outcome, Failure):
                failure = outcome.reason
                retests.append(Fit(seed, "retest", failed=failure.value, seconds=seconds))
                break
            same = same_simulations(first.folds, again.folds)
            folds = tuple(fold.value for fold in outcome.folds)
            retests.append(Fit(seed, "retest", outcome.value, folds, same=same, seconds=seconds))
            if same:
                # One fit shows it: the others would be the same.
                break
            values.append(outcome.value)
            if known and fmean(values) >= fmean(known):
                break
            # A wide threshold would keep better candidates out.
            narrow = significance_threshold(values, values) <= _NARROW * fmean(values)
            if known and narrow and is_lower(values, known):
                break
    if not known:
        # Nothing to beat; its spread is the first threshold.
        status, threshold = "keep", None
    else:
        threshold = significance_threshold(values, known)
        lower = failure is None and is_lower(values, known)
        status = "keep" if lower else "inconclusive"
        if fmean(values) >= fmean(known):
            status = "discard"
    timed_out = failure is not None and failure.status == "timeout"
    return Decision(tried, status, tuple(retests), threshold, timed_out, scores)


def decide_by_one_fit(outcome: Outcome, view: SearchView) -> Status:
    """Decide without retests: `keep` if V is below the lowest so far, else `discard`."""
    if isinstance(outcome, Failure):
        return outcome.reason.status
    best = view.best_value
    return "keep" if best is None or outcome.value < best else "discard"
