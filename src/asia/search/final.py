"""Final models of a search: refit, stack, and the model to use."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from asia._diagnostic import diagnostic
from asia.candidate import ParameterEstimates
from asia.data.statistics import integrating, largest_pole, needs_loop, unstable
from asia.data.trajectory import Array
from asia.errors import CandidateError, Reason
from asia.judge.evaluation.evaluator import Evaluator, Refit, RefitModel
from asia.judge.scoring.outcome import (
    SUSPICIOUS_RATIO,
    Failure,
    consistency,
    mean_simulation,
    score_fold,
    score_parts,
)
from asia.ledger.artifacts import Store
from asia.ledger.events import (
    Feedback,
    Fit,
    RefitCheck,
    Refitted,
    Stack,
    StackMember,
)
from asia.ledger.evidence import EstimatedModel, fold_estimates, folds_of, put_estimates
from asia.ledger.run import ModelToUse
from asia.ledger.view import Experiment, SearchView
from asia.presentation.experiments import error_line
from asia.presentation.table import error_value
from asia.problem.check import feedback_pairs
from asia.problem.metrics import find_metric
from asia.problem.problem import Problem
from asia.recipe import MODELS, read_recipe
from asia.search.agent_views import problem_facts
from asia.search.fair_trial import behind_least, evaluation_of
from asia.search.guard import Gate
from asia.search.stress import NEAR, StressRoom, bounded_model

# One model of all training records: a refit, unless the ensemble or a fold model fits them better.


STARTS = 3
# Error of a refit, or of the ensemble, relative to the least one, above which it ended in a poorer
# minimum.
FALLS_SHORT = 1.2

Answers = tuple[Array, ...]
FinalKind = Literal["refit", "ensemble", "fold"]


@dataclass(frozen=True)
class CheckedRefit:
    """A refit that was compared with the fold models."""

    model: bytes | None
    """The start that was kept, or a fold model in its place; None where there is neither."""
    detail: str
    """Why there is none."""
    check: RefitCheck | None
    """The comparison; None where it could not be made."""
    estimates: ParameterEstimates | None = None
    fold: int = 0
    """The fold whose model takes its place, 1-based; 0 for a refit."""


def check_refit(
    evaluator: Evaluator,
    source: str,
    fold_models: Sequence[bytes],
    first: RefitModel | CandidateError,
    metric: str,
) -> CheckedRefit:
    """Compare a refit with the ensemble and the fold models on the training records; where one of
    them fits these clearly better, fit again from other seeds. A fold model that fits them clearly
    better than refits and ensemble takes the place of the refit: these ended in poorer minima.
    first: the refit as `Evaluator.refit` made it."""
    comparison = _Comparison(evaluator, source, metric, fold_models)
    tried: list[RefitModel | CandidateError] = []
    models: list[bytes] = []
    kind: FinalKind = "ensemble"
    place = 0
    while len(tried) < STARTS and kind != "refit":
        fitted = first if not tried else evaluator.refit_again(source, len(tried))
        if isinstance(fitted, RefitModel):
            if fitted.model in models:
                break  # a fit without randomness
            models.append(fitted.model)
        tried.append(fitted)
        comparison.add(fitted.model if isinstance(fitted, RefitModel) else fitted)
        kind, place = comparison.best()
    check = comparison.result(place + 1 if kind == "refit" else None)
    if kind == "refit":
        kept = tried[place]
        assert isinstance(kept, RefitModel)
        return CheckedRefit(kept.model, "", check, kept.estimates)
    if kind == "fold":
        return CheckedRefit(fold_models[place], "", check, fold=place + 1)
    errors = _errors(check)
    detail = f"errors on the training records: {errors}" if "refit" in errors else ""
    return CheckedRefit(None, detail or none_words(comparison.causes), check)


def _errors(check: RefitCheck) -> str:
    """`refit 0.12, ensemble 0.08`: errors on the training records."""
    refits = [start.value for start in check.starts if start.value is not None and not start.failed]
    errors = {"refit": min(refits, default=None), "ensemble": check.ensemble_error}
    return ", ".join(f"{name} {error_value(e)}" for name, e in errors.items() if e is not None)


_COUNT = {2: "both", 3: "all three"}
_DIVERGED = re.compile(r"\bnan|\binf|finite|diverge|overflow|converge|singular", re.IGNORECASE)
_CAUSES = {
    Reason.NOT_FINITE: "diverged",
    Reason.MEMORY: "ran out of memory",
    Reason.FIT_TIMEOUT: "did not end in time",
    Reason.SIMULATE_TIMEOUT: "took too long to simulate",
}


def none_words(causes: Sequence[str]) -> str:
    """Why there is no refit, in one sentence. causes: what each start did."""
    count = len(causes)
    where = f" in {_COUNT.get(count, f'all {count}')} starts" if count > 1 else ""
    kinds = {cause.partition(" (")[0] for cause in causes}
    if len(kinds) > 1:
        return f"no start of the refit is usable: one {', one '.join(causes)}"
    kind, bracket, detail = causes[-1].partition(" (")
    return f"the refit {kind}{where}{bracket}{detail}"


def cause_of(error: CandidateError) -> str:
    """Describe the failure of a fit or simulation without its traceback."""
    line = error_line(error.detail, 120)
    known = _CAUSES.get(error.reason)
    if known is None and error.reason is Reason.CRASH and _DIVERGED.search(line):
        known = "diverged"
    return known or f"failed ({line or error.reason.value})"


class _Comparison:
    """Starts of the refit against the fold models, on the training records."""

    def __init__(
        self, evaluator: Evaluator, source: str, metric: str, fold_models: Sequence[bytes]
    ) -> None:
        self._evaluator, self._source, self._metric = evaluator, source, metric
        self._starts: list[Fit] = []
        self.causes: list[str] = []
        """Objections against each start, in a few words."""
        answers = evaluator.models.simulate_training(source, fold_models)
        sound = [one for one in answers if not isinstance(one, CandidateError)]
        self._mean = mean_simulation(sound) if len(sound) == len(answers) else None
        self._ensemble_error = None if self._mean is None else self._error(self._mean)
        self._fold_errors = tuple(
            None if isinstance(one, CandidateError) else self._error(one) for one in answers
        )
        self._fold_disagreement: float | None = None
        if self._mean is not None and len(sound) > 1:
            apart = [
                self._apart(one, mean_simulation([*sound[:k], *sound[k + 1 :]]))
                for k, one in enumerate(sound)
            ]
            self._fold_disagreement = float(np.mean(apart))

    def best(self) -> tuple[FinalKind, int]:
        """The first of refits, ensemble and fold models whose error on the training records is not
        clearly above the least, and its place among those of its kind."""
        errors: dict[tuple[FinalKind, int], float] = {}
        kinds: tuple[tuple[FinalKind, Sequence[float | None]], ...] = (
            ("refit", [None if start.failed else start.value for start in self._starts]),
            ("ensemble", [self._ensemble_error]),
            ("fold", self._fold_errors),
        )
        for kind, values in kinds:
            known = [(value, i) for i, value in enumerate(values) if value is not None]
            if known:
                value, place = min(known)
                errors[kind, place] = value
        most = FALLS_SHORT * min(errors.values(), default=0.0)
        return next((one for one, value in errors.items() if value <= most), ("ensemble", 0))

    def result(self, kept: int | None) -> RefitCheck:
        """Return the findings. kept: the start that is the refit, 1-based."""
        return RefitCheck(
            fold_errors=self._fold_errors,
            ensemble_error=self._ensemble_error,
            fold_disagreement=self._fold_disagreement,
            starts=tuple(self._starts),
            kept=kept,
        )

    def add(self, model: bytes | CandidateError) -> None:
        """Note one start."""
        start = Fit(len(self._starts), "refit")
        if isinstance(model, CandidateError):
            self.causes.append(cause_of(model))
            self._starts.append(replace(start, failed=f"its fit failed: {model}"))
            return
        (answers,) = self._evaluator.models.simulate_training(self._source, [model])
        if isinstance(answers, CandidateError):
            self.causes.append(cause_of(answers))
            self._starts.append(replace(start, failed=f"its simulation failed: {answers}"))
            return
        error, text, cause = self._error(answers), "", ""
        if error is None:
            text, cause = "its error on the training records is not finite", "diverged"
        else:
            failure = self._evaluator.refit_objection(self._source, model, answers)
            if failure is not None:
                text = failure.detail or failure.advice
                cause = f"gives invalid simulations ({error_line(text)})"
        self.causes.append(cause)
        apart = None if self._mean is None else self._apart(answers, self._mean)
        self._starts.append(replace(start, value=error, failed=text, disagreement=apart))

    def _error(self, answers: Answers) -> float | None:
        y = [block.y for block in self._evaluator.data.training_blocks]
        try:
            return score_fold(y, answers, self._evaluator.data.scale, self._metric).value
        except CandidateError:
            return None

    def _apart(self, one: Answers, other: Answers) -> float:
        """Root mean square difference over the standard deviation, mean over the outputs."""
        apart = np.concatenate([a - b for a, b in zip(one, other, strict=True)])
        return float(np.mean(np.sqrt(np.mean(apart**2, axis=0)) / self._evaluator.data.scale))


def choose_model(single: Array, stack: Array | None, refitted: Refitted) -> ModelToUse:
    """The model to use: a stack whose error on held-out records is more than one standard error
    below that of the best candidate, else the refit, else the ensemble.

    Args:
        single: errors (n,) of the best candidate on parts of the held-out records
        stack: those of the stack on the same parts; None where there is none
        refitted: the refit, and why there is none
    """
    if stack is not None:
        behind, deviation = behind_least({"single": single, "stack": stack})
        if behind["single"] > deviation["single"]:
            both = error_value(float(stack.mean())), error_value(float(single.mean()))
            return ModelToUse(
                "stack",
                f"On parts of the held-out records its error is {both[0]}, that of the best "
                f"candidate {both[1]}: lower by more than one standard error.",
            )
    return one_model(refitted)


def one_model(refitted: Refitted) -> ModelToUse:
    """The refit, or the fold model in its place; the ensemble where there is neither."""
    if refitted.model is None:
        why = refitted.detail or "there is no refit"
        return ModelToUse("ensemble", f"{why[:1].upper()}{why[1:]}.")
    if not refitted.fold or refitted.check is None:
        return ModelToUse("refit", "It was fitted to all training records.")
    error = refitted.check.fold_errors[refitted.fold - 1]
    return ModelToUse(
        "refit",
        f"The model of fold {refitted.fold} takes its place: it fits all training records best "
        f"(errors: {'' if error is None else error_value(error)}, {_errors(refitted.check)}).",
    )


# Few folds say little about weights that are fitted to them: weights by V alone predict as well.


MOST_MEMBERS = 8


def stack_weights(values: Array) -> Array:
    """Weights (n,) of the candidates by their parts of V (folds, n): inverse to the fourth power of
    V for those near the best one, at most `MOST_MEMBERS`, and 0 for the others."""
    mean = np.maximum(values.mean(axis=0), np.finfo(float).tiny)
    ranked = np.argsort(mean, kind="stable")[:MOST_MEMBERS]
    near = ranked[mean[ranked] <= NEAR * mean[ranked[0]]]
    weights = np.zeros(len(mean))
    weights[near] = (mean[ranked[0]] / mean[near]) ** 4
    return weights / weights.sum()


def make_stack(
    evaluator: Evaluator, view: SearchView, store: Store, metric: str, refused: Collection[int] = ()
) -> tuple[Stack, Array] | None:
    """The stack of all scored candidates, with weights from all folds, and its errors (n,) on parts
    of the held-out records, with weights that the judged fold had no part in; None where it would
    be one candidate alone.

    Args:
        refused: numbers of experiments that may not be members
    """
    scored: list[Experiment] = []
    for e in view.finished:
        if e.score is None or e.result is None or e.number in refused:
            continue
        # Twins, and fair trials that end in one and the same model.
        if any(one.score == e.score for one in scored):
            continue
        errors = [fold.diagnostics.train_error for fold in e.result.folds]
        # Those that were never checked must not be much better where they were not fitted.
        if e.kept or e.lowest or consistency(e.score.value, errors) >= SUSPICIOUS_RATIO:
            scored.append(e)
    if not scored:
        return None
    values = np.array([[fold.value for fold in e.score.folds] for e in scored if e.score]).T
    weights = stack_weights(values)
    if np.count_nonzero(weights) < 2:
        return None
    judged: list[tuple[Array, ...]] = []
    for fold in evaluator.data.folds:
        nested = stack_weights(np.delete(values, fold.index, axis=0))
        members = np.flatnonzero(nested).tolist()
        each = [store.get_arrays(scored[i].folds[fold.index].y_hat, fold.shapes) for i in members]
        judged.append(
            tuple(np.tensordot(nested[members], np.stack(y), 1) for y in zip(*each, strict=True))
        )
    order = [k for k in np.argsort(-weights, kind="stable").tolist() if weights[k] > 0]
    members = tuple(StackMember(scored[k].number, float(weights[k])) for k in order)
    shortfall = find_metric(metric).shortfall
    folds = tuple(
        shortfall(np.concatenate([b.y for b in fold.held_out]), np.concatenate(y_hat), fold.scale)
        for fold, y_hat in zip(evaluator.data.folds, judged, strict=True)
    )
    return Stack(members, float(np.mean(folds)), folds), held_out_errors(evaluator, judged, metric)


def held_out_errors(evaluator: Evaluator, answers: Sequence[Answers], metric: str) -> Array:
    """Errors (n,) on parts of the held-out records. answers: simulations, for each fold."""
    found: list[float] = []
    for fold, y_hat in zip(evaluator.data.folds, answers, strict=True):
        found += score_parts([block.y for block in fold.held_out], y_hat, fold.scale, metric)
    return np.array(found)


def _passes(evaluator: Evaluator, experiment: Experiment, store: Store) -> bool:
    """Whether a candidate answers like a model."""
    assert experiment.result is not None
    evaluation = evaluation_of(experiment.result, store)
    return evaluator.objection(store.text(experiment.source), evaluation) is None


def refit_best(
    problem: Problem,
    evaluator: Evaluator,
    view: SearchView,
    best: Experiment,
    store: Store,
    metric: str,
    gate: Gate,
) -> Refitted:
    """The last line of a search, but for looks at the guard. Workers that end for no fault of the
    candidate leave a search without a refit, not without a model."""
    assert best.score is not None
    failed: list[str] = []

    # Experiments whose fits ignore a declared loop are no members beside a best candidate that
    # does not.
    sound = _sound_in_loop(problem, view, store)
    biased = {e.number for e in view.finished} - sound if best.number in sound else set[int]()
    biased |= {e.number for e in view.finished if e.unconfirmed}

    def stacked(refused: Collection[int] = ()) -> tuple[Stack, Array] | None:
        if problem.control is not None:  # A mean of responses is no response.
            return None
        refused = biased.union(refused)
        with diagnostic("stack", failed):
            return make_stack(evaluator, view, store, metric, refused)
        return None

    def is_sound(e: Experiment) -> bool:
        """Whether it passes the checks of a new best."""
        if e.kept or e.lowest:
            return True
        return _passes(evaluator, e, store) and gate.admits(e, best, view)

    with ExitStack() as opened:
        make = stacked
        if not evaluator.workers.is_sequential:
            # It does not depend on the refit.
            make = opened.enter_context(evaluator.workers.background(stacked)).result
        refit: Refit | None = None
        try:
            source = store.text(best.source)
            models = [store.get(fold.model) for fold in best.folds]
            refit = evaluator.refit(source, models)
            checked = CheckedRefit(None, "it could not be compared with the fold models", None)
            with diagnostic("comparison of the refit", failed):
                checked = check_refit(evaluator, source, models, refit.model, metric)
        except CandidateError as error:
            refit, checked = None, CheckedRefit(None, str(error), None)
        made = make()
    estimates: str | None = None
    with diagnostic("parameter intervals", failed):
        estimates = _kept_estimates(store, checked, best)
    again: Fit | None = None
    if refit is not None:
        # The second fit of one fold, compared with the first one.
        first, second = best.score.folds[refit.fold - 1].value, refit.again
        if isinstance(second, Failure):
            again = Fit(0, "repetition", failed=second.reason.value, fold=refit.fold)
        else:
            value = second.value
            ratio = value / first if first > 0 else float(value == first)
            again = Fit(0, "repetition", ratio, fold=refit.fold)
    refitted = Refitted(
        experiment=best.number,
        model=None if checked.model is None else store.put(checked.model),
        detail=checked.detail,
        again=again,
        check=checked.check,
        stack=made and made[0],
        estimates=estimates,
        fold=checked.fold,
    )
    if problem.control is not None:  # K controllers in one loop would be another controller.
        one = one_model(refitted)
        return replace(refitted, failed_checks=tuple(failed), use=one.model, reason=one.reason)
    folds = zip(best.folds, evaluator.data.folds, strict=True)
    answers = [store.get_arrays(one.y_hat, fold.shapes) for one, fold in folds]
    single = held_out_errors(evaluator, answers, metric)
    chosen = choose_model(single, made and made[1], refitted)
    refused: set[int] = set()
    while made is not None and (chosen.model == "stack" or made[0].value < best.score.value):
        members = [view.experiment(m.experiment) for m in made[0].members]
        wrong = {e.number for e in members if not is_sound(e)}
        if not wrong and gate.confirms_stack(made[0], best, view):
            break
        refused |= wrong
        made = stacked(refused) if wrong else None
        chosen = choose_model(single, made and made[1], refitted)
    refitted = replace(refitted, stack=made and made[0], use=chosen.model, reason=chosen.reason)
    with diagnostic("stress simulation", failed):
        room = StressRoom(evaluator, store, view, integrating(problem_facts(problem).records))
        second = choose_model(single, None, refitted).model
        refitted = bounded_model(room, view, best, refitted, chosen, second, is_sound)
    with diagnostic("feedback on the inputs", failed):
        found = unheeded_feedback(problem, store.text(best.source))
        if found is not None and found.declared:
            scored = {e.number: e.score.value for e in view.finished if e.score is not None}
            other = min(sound & scored.keys(), key=scored.__getitem__, default=None)
            found = replace(found, sound=other)
        refitted = replace(refitted, feedback=found)
    return replace(refitted, failed_checks=tuple(failed))


def unheeded_feedback(problem: Problem, source: str) -> Feedback | None:
    """Feedback on the training records that the best candidate's fit does not take into account:
    [loop] does not name it, or the best candidate uses no method for it; None where none is
    found."""
    if problem.loop is not None:
        if _is_sound_in_loop(problem, source):
            return None
        return Feedback(tuple(s.name for s in problem.inputs), None, declared=True)
    names = dict.fromkeys(given.name for given, _ in feedback_pairs(problem))
    records = problem_facts(problem).records
    if not names and needs_loop(records):
        names = dict.fromkeys(signal.name for signal in problem.inputs)
    if not names:
        return None
    return Feedback(tuple(names), largest_pole(records) if unstable(records) else None)


def _sound_in_loop(problem: Problem, view: SearchView, store: Store) -> set[int]:
    """Numbers of the finished experiments whose fits take a declared loop into account; all
    without a loop."""
    finished = view.finished
    if problem.loop is None:
        return {e.number for e in finished}
    return {e.number for e in finished if _is_sound_in_loop(problem, store.text(e.source))}


def _is_sound_in_loop(problem: Problem, source: str) -> bool:
    """Whether the fit uses a method for the declared loop. Sources that are not of the library are
    not judged; static functions are fitted in open loop."""
    recipe = read_recipe(source)
    explained = problem.loop is None or not problem.loop.methods
    return explained or recipe is None or bool(recipe.get("loop") and not recipe.maps)


def _kept_estimates(store: Store, checked: CheckedRefit, best: Experiment) -> str | None:
    """Those of the refit; without one, those of the fold models, or of the one in its place."""
    found: ParameterEstimates | EstimatedModel | None = checked.estimates
    if checked.model is None or checked.fold:
        tables = [dict(one.parameters) for one in folds_of(store, best)]
        found = fold_estimates(tables, checked.fold)
    if found is None or not found.parameters:
        return None
    recipe = read_recipe(store.text(best.source))
    return put_estimates(store, found, library=recipe is not None and recipe.package == MODELS)
