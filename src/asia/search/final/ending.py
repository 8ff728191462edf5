"""Final models of a search: refit the winner on all training records, check the refit, build the
stack, choose the model to use.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace

from asia._boundary import diagnostic
from asia.errors import CandidateError
from asia.evaluation import Evaluator, Refit
from asia.ledger import Again, Experiment, Refitted, SearchView, Stack, Store, put_estimates
from asia.scoring import Failure
from asia.search.final.choice import FinalEvidence, choose_model
from asia.search.final.refit import CheckedRefit, check_refit
from asia.search.final.stacking import make_stack


def refit_winner(
    evaluator: Evaluator, view: SearchView, best: Experiment, store: Store, metric: str
) -> Refitted:
    """The last line of a search, but for looks at the guard. Workers that end for no fault of the
    candidate leave a search without a refit, not without a model."""
    assert best.score is not None
    failed: list[str] = []

    def stacked() -> Stack | None:
        with diagnostic("stack", failed):
            return make_stack(evaluator, view, store, metric)
        return None

    with ExitStack() as opened:
        make = stacked
        if not evaluator.one_by_one:
            # It does not depend on the refit.
            make = opened.enter_context(evaluator.background(stacked)).result
        try:
            refit, checked = _refit(evaluator, best, store, metric, failed)
        except CandidateError as error:
            refit, checked = None, CheckedRefit(None, str(error), None)
        stack = make()
    estimates: str | None = None
    with diagnostic("parameter intervals", failed):
        estimates = _kept_estimates(store, checked)
    refitted = Refitted(
        experiment=best.number,
        model=None if checked.model is None else store.put(checked.model),
        detail=checked.detail,
        again=None if refit is None else _second_fit(best, refit),
        check=checked.check,
        stack=stack,
        estimates=estimates,
        failed_checks=tuple(failed),
    )
    chosen = choose_model(FinalEvidence.of(best, refitted))
    return replace(refitted, use=chosen.model, reason=chosen.reason)


def _refit(
    evaluator: Evaluator, best: Experiment, store: Store, metric: str, failed: list[str]
) -> tuple[Refit, CheckedRefit]:
    assert best.result is not None
    source = store.text(best.proposed.source)
    models = [store.get(fold.model) for fold in best.result.folds]
    refit = evaluator.refit(source)
    with diagnostic("comparison of the refit", failed):
        return refit, check_refit(evaluator, source, models, refit.model, metric)
    return refit, CheckedRefit(None, "it could not be compared with the fold models", None)


def _kept_estimates(store: Store, checked: CheckedRefit) -> str | None:
    found = checked.estimates
    return None if found is None or not found.parameters else put_estimates(store, found)


def _second_fit(best: Experiment, refit: Refit) -> Again:
    """Compare the second fit of a fold with the first one."""
    assert best.score is not None
    first, second = best.score.folds[refit.fold - 1], refit.again
    if isinstance(second, Failure):
        return Again(refit.fold, None, second.reason.value)
    value = second.score.value
    ratio = value / first.value if first.value > 0 else float(value == first.value)
    return Again(refit.fold, ratio)
