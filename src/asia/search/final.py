"""Final models of a search: refit, stack, and the model to use."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import numpy as np

from asia._diagnostic import diagnostic
from asia.candidate import ParameterEstimates
from asia.data.statistics import integrating, needs_loop, relation
from asia.data.trajectory import Array
from asia.errors import CandidateError, Reason
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.evaluation.results import (
    SUSPICIOUS_RATIO,
    Refit,
    RefitModel,
    consistency,
    mean_simulation,
)
from asia.judge.scoring.outcome import Failure, score_fold
from asia.ledger.artifacts import Store
from asia.ledger.events import (
    Feedback,
    Fit,
    RefitCheck,
    Refitted,
    Stack,
    StackMember,
)
from asia.ledger.evidence import EstimatedModel, findings_of, fold_estimates, put_estimates
from asia.ledger.run import ModelToUse
from asia.ledger.text import error_line, error_value
from asia.ledger.view import Experiment, SearchView
from asia.problem.check import feedback_pairs
from asia.problem.metrics import find_metric
from asia.problem.problem import Problem
from asia.recipe import MODELS, read_recipe
from asia.search.agent_views import problem_facts
from asia.search.fair_trial import evaluation_of
from asia.search.guard import Gate
from asia.search.stress import StressRoom, bounded_model

# Check of a refit: it saw all training records and must fit them as well as the fold models do.


STARTS = 3
# Maximum error of a refit relative to the median fold model: above it, it does not fit its data.
FALLS_SHORT = 1.2
# Maximum error of a refit relative to the ensemble, and maximum difference relative to that of one
# fold model from the others: a refit above either is only a fallback.
NOT_WORSE, NOT_FURTHER = 1.05, 2.0
# Negligible error, in standard deviations of the output.
NEGLIGIBLE = 1e-4

Answers = tuple[Array, ...]


@dataclass(frozen=True)
class CheckedRefit:
    """A refit that was compared with the fold models."""

    model: bytes | None
    """The start that was kept; None where something speaks against all of them."""
    detail: str
    check: RefitCheck | None
    """The comparison; None where it could not be made."""
    estimates: ParameterEstimates | None = None


def check_refit(
    evaluator: Evaluator,
    source: str,
    fold_models: Sequence[bytes],
    first: RefitModel | CandidateError,
    metric: str,
) -> CheckedRefit:
    """Compare a refit with the fold models on the training records; where it is worse than their
    ensemble, fit again from other seeds and keep the best. first: the refit as `Evaluator.refit`
    made it."""
    comparison = _Comparison(evaluator, source, metric, fold_models)
    tried: list[RefitModel | CandidateError] = []
    models: list[bytes] = []
    while len(tried) < STARTS:
        fitted = first if not tried else evaluator.refit_again(source, len(tried))
        if isinstance(fitted, RefitModel):
            if fitted.model in models:
                break  # a fit without randomness
            models.append(fitted.model)
        tried.append(fitted)
        comparison.add(fitted.model if isinstance(fitted, RefitModel) else fitted)
        if is_worthy(comparison.result):
            break
    check = comparison.result
    if check.kept is None:
        return CheckedRefit(None, none_words(comparison.causes), check)
    kept = tried[check.kept - 1]
    assert isinstance(kept, RefitModel)
    return CheckedRefit(kept.model, "", check, kept.estimates)


def is_worthy(check: RefitCheck) -> bool:
    """Return whether it is as good as the ensemble, and as near as fold models to each other."""
    if check.kept is None:
        return False
    distance, usual = check.starts[check.kept - 1].disagreement, check.fold_disagreement
    near = distance is None or usual is None or distance <= NOT_FURTHER * usual + NEGLIGIBLE
    return near and is_as_good(check)


def is_as_good(check: RefitCheck) -> bool:
    """Return whether its training error is hardly above that of the ensemble, if that has one."""
    error = None if check.kept is None else check.starts[check.kept - 1].value
    ensemble = check.ensemble_error
    return error is not None and (ensemble is None or error <= NOT_WORSE * ensemble + NEGLIGIBLE)


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

    @property
    def result(self) -> RefitCheck:
        """Return the findings so far. The start with the lowest error that nothing speaks against
        is kept."""
        errors = [
            (start.value, number)
            for number, start in enumerate(self._starts, 1)
            if start.value is not None and not start.failed
        ]
        return RefitCheck(
            fold_errors=self._fold_errors,
            ensemble_error=None if self._mean is None else self._error(self._mean),
            fold_disagreement=self._fold_disagreement,
            starts=tuple(self._starts),
            kept=min(errors)[1] if errors else None,
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
        error = self._error(answers)
        usual = [one for one in self._fold_errors if one is not None]
        text = cause = ""
        if error is None:
            text, cause = "its error on the training records is not finite", "diverged"
        elif usual and error > FALLS_SHORT * median(usual) + NEGLIGIBLE:
            own, other = error_value(error), error_value(median(usual))
            text = f"its error on its own training records is {own}, that of a fold model {other}"
            cause = (
                f"does not fit its own training records (error {own}, that of a fold model {other})"
            )
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


# The rule for the model to use. It knows training data alone; docs/design/model-to-use.md says why
# it is as it is.


# Nested V of a stack, relative to the best candidate's V: below the first it is named whatever the
# refit is worth, up to the second where one model of all data is no better than a mean of models.
STACK_GAIN, STACK_WORTH = 0.8, 1.2
# Error of a refit on the training records, relative to the ensemble's, up to which the other third
# of the data made it better. The fold models of the best candidate were chosen by V, the refit was
# not.
BETTER = 0.8
# Disagreement of fold models, relative to the ensemble's error, up to which a mean gains nothing.
AGREE = 0.2


@dataclass(frozen=True)
class FinalEvidence:
    """Evidence for the choice of the model to use."""

    value: float
    """V of the best candidate."""
    check: RefitCheck | None
    """The comparison of the refit with the fold models; None where there is none."""
    detail: str
    """Why there is no refit; "" where there is one."""
    stack: Stack | None

    @staticmethod
    def of(best: Experiment, refitted: Refitted) -> FinalEvidence:
        """Return the evidence from the best candidate and the end of its search."""
        assert best.score is not None
        return FinalEvidence(
            value=best.score.value,
            check=refitted.check,
            detail=refitted.detail if refitted.model is None else "",
            stack=refitted.stack,
        )


def choose_model(evidence: FinalEvidence) -> ModelToUse:
    """The model to use."""

    def number(error: float | None) -> str:
        return "none" if error is None else error_value(error)

    value, stack, check = evidence.value, evidence.stack, evidence.check
    if stack is not None and stack.value < STACK_GAIN * value:
        return ModelToUse(
            "stack",
            f"The V of the stack by nested cross-validation, {error_value(stack.value)}, is "
            "clearly below the "
            f"best candidate's, {error_value(value)}.",
        )
    if check is None or evidence.detail:
        why = evidence.detail or "there is no refit"
        why = f"{why[:1].upper()}{why[1:]}."
    else:
        kept = check.starts[(check.kept or 0) - 1]
        errors = f"{number(kept.value)}, the ensemble's {number(check.ensemble_error)}"
        apart, usual, ensemble = kept.disagreement, check.fold_disagreement, check.ensemble_error
        error = kept.value or 0.0
        if is_worthy(check):
            if ensemble is None or len(check.fold_errors) < 3:
                # With two folds a fold model has seen half of the data only.
                close = "nearly" if error > (ensemble or np.inf) else "at least"
                text = f"It fits the training records {close} as well as the ensemble"
                return ModelToUse("refit", f"{text} (error {errors}).")
            if error <= BETTER * ensemble + NEGLIGIBLE:
                text = "It fits the training records clearly better than the ensemble"
                return ModelToUse("refit", f"{text} (error {errors}).")
            if (usual or 0.0) <= AGREE * ensemble + NEGLIGIBLE:
                text = (
                    "The fold models agree, so a mean of models gains nothing, and one is simpler"
                )
                return ModelToUse("refit", f"{text} (training error {errors}).")
            how = "little" if error < ensemble else "no"
            why = f"The refit fits the training records {how} better than the ensemble ({errors})."
        elif is_as_good(check):
            why = (
                "The refit differs from the fold models by more than they differ from each other: "
                f"{number(apart)} against {number(usual)} standard deviations."
            )
        else:
            why = f"The refit's error on its own training records is {errors}."
    if stack is not None and stack.value <= STACK_WORTH * value and len(stack.folds) > 2:
        return ModelToUse(
            "stack",
            f"{why} The V of the stack by nested cross-validation, {error_value(stack.value)}, is "
            f"near the best candidate's, {error_value(value)}, and it depends less on one "
            "candidate.",
        )
    return ModelToUse("ensemble", why)


# Few folds say little about weights that are fitted to them: weights by V alone predict as well.


MOST_MEMBERS = 8
# V of a member at most, relative to the best one.
NEAR = 1.5


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
) -> Stack | None:
    """The stack of all scored candidates; None where it would be one candidate alone.

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
    return _stack_of(scored, evaluator, store, metric)


def _stack_of(
    scored: Sequence[Experiment], evaluator: Evaluator, store: Store, metric: str
) -> Stack | None:
    """Weights from all folds, V from weights that the judged fold had no part in."""
    if not scored:
        return None
    values = np.array([[fold.value for fold in e.score.folds] for e in scored if e.score]).T
    weights = stack_weights(values)
    if np.count_nonzero(weights) < 2:
        return None
    shortfall = find_metric(metric).shortfall
    judged: list[float] = []
    for fold in evaluator.data.folds:
        nested = stack_weights(np.delete(values, fold.index, axis=0))
        y = np.concatenate([block.y for block in fold.held_out])
        y_hat = np.zeros_like(y)
        for place in np.flatnonzero(nested).tolist():
            answers = store.get_arrays(scored[place].folds[fold.index].y_hat, fold.shapes)
            y_hat += nested[place] * np.concatenate(answers)
        judged.append(shortfall(y, y_hat, fold.scale))
    order = [k for k in np.argsort(-weights, kind="stable").tolist() if weights[k] > 0]
    members = tuple(StackMember(scored[k].number, float(weights[k])) for k in order)
    return Stack(members, float(np.mean(judged)), tuple(judged))


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

    def stacked(refused: Collection[int] = ()) -> Stack | None:
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
        stack = make()
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
        stack=stack,
        estimates=estimates,
    )
    if problem.control is not None:
        return replace(refitted, failed_checks=tuple(failed), **_chosen_controller(refitted))
    chosen = choose_model(FinalEvidence.of(best, refitted))
    refused: set[int] = set()
    while refitted.stack is not None and (
        chosen.model == "stack" or refitted.stack.value < best.score.value
    ):
        members = [view.experiment(m.experiment) for m in refitted.stack.members]
        wrong = {e.number for e in members if not is_sound(e)}
        if not wrong and gate.confirms_stack(refitted.stack, best, view):
            break
        refused |= wrong
        refitted = replace(refitted, stack=stacked(refused) if wrong else None)
        chosen = choose_model(FinalEvidence.of(best, refitted))
    refitted = replace(refitted, use=chosen.model, reason=chosen.reason)
    with diagnostic("stress simulation", failed):
        room = StressRoom(evaluator, store, view, integrating(problem_facts(problem).records))
        without = replace(FinalEvidence.of(best, refitted), stack=None)
        second = choose_model(without).model
        refitted = bounded_model(room, view, best, refitted, chosen, second, is_sound)
    with diagnostic("feedback on the inputs", failed):
        found = unheeded_feedback(problem, store.text(best.source))
        if found is not None and found.declared:
            scored = {e.number: e.score.value for e in view.finished if e.score is not None}
            other = min(sound & scored.keys(), key=scored.__getitem__, default=None)
            found = replace(found, sound=other)
        refitted = replace(refitted, feedback=found)
    return replace(refitted, failed_checks=tuple(failed))


def _chosen_controller(refitted: Refitted) -> dict[str, Any]:
    """Controller to use: that of all training scenarios, or, where there is none, the first fold's.

    K controllers in one loop would be another controller, so none is a mean of others.
    """
    if refitted.model is not None:
        return {"use": "refit", "reason": "It was designed for all training scenarios."}
    return {
        "use": "ensemble",
        "reason": f"There is no design for all scenarios: {refitted.detail}.",
    }


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
    found = relation(records)
    return Feedback(tuple(names), found.pole if found.unstable else None)


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
    """Those of the refit; without one, those of the fold models."""
    found: ParameterEstimates | EstimatedModel | None = checked.estimates
    if checked.model is None:
        findings = findings_of(store, best)
        found = fold_estimates([dict(one.parameters) for one in findings])
    if found is None or not found.parameters:
        return None
    recipe = read_recipe(store.text(best.source))
    return put_estimates(store, found, library=recipe is not None and recipe.package == MODELS)
