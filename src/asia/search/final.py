"""Final models of a search: refit, stack, and the model to use."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from statistics import median

import numpy as np

from asia._diagnostic import diagnostic
from asia.candidate import ParameterEstimates
from asia.data.trajectory import Array
from asia.errors import CandidateError, Reason
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.evaluation.results import (
    SUSPICIOUS_RATIO,
    FoldResult,
    Refit,
    RefitModel,
    consistency,
    mean_simulation,
)
from asia.judge.scoring.outcome import Failure, score_fold
from asia.ledger.artifacts import Store
from asia.ledger.events import Again, RefitCheck, RefitStart, Refitted, Stack, StackMember
from asia.ledger.evidence import put_estimates
from asia.ledger.run import ModelToUse
from asia.ledger.text import error_line, error_value
from asia.ledger.view import Experiment, SearchView
from asia.problem.metrics import find_metric
from asia.problem.protocol import Fold

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
    """Why there is none."""
    check: RefitCheck | None
    """The comparison; None where it could not be made."""
    estimates: ParameterEstimates | None = None
    """Parameter estimates of the refit; None if it reports none."""


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
    """Return whether the refit is as good as the ensemble, and not much further from it than fold
    models are from each other.
    """
    if check.kept is None:
        return False
    distance, usual = check.starts[check.kept - 1].disagreement, check.fold_disagreement
    near = distance is None or usual is None or distance <= NOT_FURTHER * usual + NEGLIGIBLE
    return near and is_as_good(check)


def is_as_good(check: RefitCheck) -> bool:
    """Return whether the error of the refit on the training records is hardly above that of the
    ensemble, or the ensemble has none because a fold model fails there.
    """
    error = None if check.kept is None else check.starts[check.kept - 1].error
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


@dataclass
class _Comparison:
    evaluator: Evaluator
    source: str
    metric: str
    fold_models: Sequence[bytes]
    starts: list[RefitStart] = field(default_factory=list[RefitStart])
    causes: list[str] = field(default_factory=list[str])
    """Objections against each start, in a few words."""

    def __post_init__(self) -> None:
        answers = self.evaluator.models.simulate_training(self.source, self.fold_models)
        self._sound = [one for one in answers if not isinstance(one, CandidateError)]
        complete = len(self._sound) == len(answers)
        self._mean = mean_simulation(self._sound) if complete else None
        self._errors = tuple(
            None if isinstance(one, CandidateError) else self._error(one) for one in answers
        )

    @property
    def result(self) -> RefitCheck:
        """Return the findings so far."""
        return RefitCheck(
            fold_errors=self._errors,
            ensemble_error=None if self._mean is None else self._error(self._mean),
            fold_disagreement=self._fold_disagreement(),
            starts=tuple(self.starts),
            kept=self._kept(),
        )

    def _kept(self) -> int | None:
        """The start with the lowest error that nothing speaks against."""
        errors = [
            (start.error, number)
            for number, start in enumerate(self.starts, 1)
            if start.error is not None and not start.objection
        ]
        return min(errors)[1] if errors else None

    def add(self, model: bytes | CandidateError) -> None:
        """Note one start."""
        self.starts.append(self._start(model))

    def _start(self, model: bytes | CandidateError) -> RefitStart:
        if isinstance(model, CandidateError):
            self.causes.append(cause_of(model))
            return RefitStart(None, None, f"its fit failed: {model}")
        (answers,) = self.evaluator.models.simulate_training(self.source, [model])
        if isinstance(answers, CandidateError):
            self.causes.append(cause_of(answers))
            return RefitStart(None, None, f"its simulation failed: {answers}")
        error = self._error(answers)
        text, cause = self._error_text(error)
        self.causes.append(cause)
        if not text:
            failure = self.evaluator.refit_objection(self.source, model, answers)
            if failure is not None:
                text = failure.detail or failure.advice
                self.causes[-1] = f"gives invalid simulations ({error_line(text)})"
        apart = None if self._mean is None else self._apart(answers, self._mean)
        return RefitStart(error, apart, text)

    def _error_text(self, error: float | None) -> tuple[str, str]:
        """The objection to an error and the cause; "" for none."""
        known = [one for one in self._errors if one is not None]
        if error is None:
            return "its error on the training records is not finite", "diverged"
        if not known or error <= FALLS_SHORT * median(known) + NEGLIGIBLE:
            return "", ""
        own, other = error_value(error), error_value(median(known))
        return (
            f"its error on its own training records is {own}, that of a fold model {other}",
            f"does not fit its own training records (error {own}, that of a fold model {other})",
        )

    def _error(self, answers: Answers) -> float | None:
        y = [block.y for block in self.evaluator.data.training_blocks]
        try:
            return score_fold(y, answers, self.evaluator.data.scale, self.metric).value
        except CandidateError:
            return None

    def _fold_disagreement(self) -> float | None:
        if self._mean is None or len(self._sound) < 2:
            return None
        others = [
            mean_simulation([*self._sound[:k], *self._sound[k + 1 :]])
            for k in range(len(self._sound))
        ]
        pairs = zip(self._sound, others, strict=True)
        return float(np.mean([self._apart(one, rest) for one, rest in pairs]))

    def _apart(self, one: Answers, other: Answers) -> float:
        """Root mean square difference over the standard deviation, mean over the outputs."""
        apart = np.concatenate([a - b for a, b in zip(one, other, strict=True)])
        return float(np.mean(np.sqrt(np.mean(apart**2, axis=0)) / self.evaluator.data.scale))


# The rule for the model to use. It knows training data alone; docs/design/model-to-use.md says why
# it is as it is.


# Maximum nested V of a stack, relative to the winner's V.
STACK_GAIN = 0.8


@dataclass(frozen=True)
class FinalEvidence:
    """Evidence for the choice of the model to use."""

    value: float
    """V of the winner."""
    folds: tuple[float, ...]
    """Its part of each fold."""
    train_errors: tuple[float, ...]
    """The error of each of its fold models on what that was fitted on."""
    check: RefitCheck | None
    """The comparison of the refit with the fold models; None where there is none."""
    detail: str
    """Why there is no refit; "" where there is one."""
    stack: Stack | None
    """The stack."""

    @staticmethod
    def of(best: Experiment, refitted: Refitted) -> FinalEvidence:
        """Return the evidence from the winner and the end of its search."""
        assert best.score is not None
        assert best.result is not None
        return FinalEvidence(
            value=best.score.value,
            folds=tuple(fold.value for fold in best.score.folds),
            train_errors=tuple(fold.diagnostics.train_error for fold in best.result.folds),
            check=refitted.check,
            detail=refitted.detail if refitted.model is None else "",
            stack=refitted.stack,
        )


def choose_model(evidence: FinalEvidence) -> ModelToUse:
    """The model to use."""
    value, stack, check = evidence.value, evidence.stack, evidence.check
    if stack is not None and stack.value < STACK_GAIN * value:
        return ModelToUse(
            "stack",
            f"Its V by nested cross-validation, {error_value(stack.value)}, is clearly below the "
            f"winner's, {error_value(value)}.",
        )
    if evidence.detail or check is None:
        why = evidence.detail or "there is no refit"
        return ModelToUse("ensemble", f"{why[:1].upper()}{why[1:]}.")
    kept = check.starts[(check.kept or 0) - 1]
    errors = f"{_error_text(kept.error)}, that of the ensemble {_error_text(check.ensemble_error)}"
    if is_worthy(check):
        text = f"It is fitted on all training records; its error there is {errors}."
        return ModelToUse("refit", text)
    if is_as_good(check):
        text = f"{_error_text(kept.disagreement)} against {_error_text(check.fold_disagreement)}"
        return ModelToUse(
            "ensemble",
            "The refit differs from the fold models by more than they differ from each other: "
            f"{text} standard deviations.",
        )
    return ModelToUse("ensemble", f"The refit's error on its own training records is {errors}.")


def _error_text(error: float | None) -> str:
    return "none" if error is None else error_value(error)


# Greedy selection of weighted ensembles (Caruana et al., ICML 2004): members are added with
# replacement, each time the one that lowers the error of the mean most; bagged over random halves
# of the candidates, and drawn towards the best one.


MOST_MEMBERS = 8
MOST_CANDIDATES = 24
_BAGS = 12
_ADDITIONS = 12
_LEAST_BAG = 5
_LEAST_WEIGHT = 0.02
_FAR_WORSE = 2.0
# Few folds say little about weights: this share stays with the best candidate. Without it a member
# that is good where it was judged spoils the mean elsewhere.
_SHARE_OF_BEST = 0.5

Shortfall = Callable[[Array, Array, Array], float]
"""y (S, ny), y_hat (S, ny), scale (ny,) -> the metric as it enters V."""


@dataclass(frozen=True)
class HeldOutPart:
    """Held-out part of one fold with the simulation of each candidate's model."""

    y: Array
    """Measured outputs (S, ny)."""
    y_hat: Array
    """Simulated outputs (n, S, ny) of n candidates."""
    scale: Array
    """Standard deviations (ny,) of the outputs."""
    values: tuple[float, ...]
    """The part of this fold in the V of each candidate."""


def select_weights(parts: Sequence[HeldOutPart], shortfall: Shortfall, seed: int = 0) -> Array:
    """Weights (n,) of the candidates, not negative, sum 1, at most `MOST_MEMBERS` above 0: those
    of the weighted mean with a low error, mean over the given folds. Only they are looked at."""
    count = len(parts[0].values)
    pool = candidates([part.values for part in parts])
    size = max((len(pool) + 1) // 2, _LEAST_BAG)
    random = np.random.default_rng(seed)
    weights = np.zeros(count)
    for _ in range(_BAGS if size < len(pool) else 1):
        bag = sorted(random.permutation(pool)[:size].tolist())
        weights += _greedy(parts, shortfall, bag, count)
    weights *= (1.0 - _SHARE_OF_BEST) / weights.sum()
    weights[pool[0]] += _SHARE_OF_BEST
    return _capped(weights)


def candidates(values: Sequence[Sequence[float]]) -> list[int]:
    """Places of those that may be members, the best first. values: of each fold, one a candidate.
    A mean gains little from one that is far worse than the best."""
    mean = np.mean(values, axis=0)
    ranked = np.argsort(mean, kind="stable")[:MOST_CANDIDATES]
    return [int(one) for one in ranked if mean[one] <= _FAR_WORSE * mean[ranked[0]]]


def nested_weights(
    parts: Sequence[HeldOutPart], shortfall: Shortfall, seed: int = 0
) -> tuple[Array, ...]:
    """Return for each fold the weights that are selected on the other folds."""
    return tuple(
        select_weights([*parts[:k], *parts[k + 1 :]], shortfall, seed) for k in range(len(parts))
    )


def _greedy(
    parts: Sequence[HeldOutPart], shortfall: Shortfall, bag: Sequence[int], count: int
) -> Array:
    """The best mean met on the way of always adding the member that lowers the error most."""
    sums = [np.zeros_like(part.y) for part in parts]
    chosen: list[int] = []
    best, best_length = np.inf, 1
    for length in range(1, _ADDITIONS + 1):
        values = [_value(parts, sums, shortfall, one, length) for one in bag]
        place = int(np.argmin(values))
        chosen.append(bag[place])
        sums = [s + part.y_hat[bag[place]] for s, part in zip(sums, parts, strict=True)]
        if values[place] < best:
            best, best_length = values[place], length
    return np.bincount(chosen[:best_length], minlength=count) / best_length


def _value(
    parts: Sequence[HeldOutPart],
    sums: Sequence[Array],
    shortfall: Shortfall,
    added: int,
    length: int,
) -> float:
    pairs = zip(parts, sums, strict=True)
    each = [shortfall(p.y, (s + p.y_hat[added]) / length, p.scale) for p, s in pairs]
    return float(np.mean(each))


def _capped(weights: Array) -> Array:
    """Return the weights without negligible ones, at most `MOST_MEMBERS`."""
    kept = np.argsort(-weights, kind="stable")[:MOST_MEMBERS]
    capped = np.zeros_like(weights)
    capped[kept] = np.where(weights[kept] >= _LEAST_WEIGHT, weights[kept], 0.0)
    return capped / capped.sum()


# A stack of the candidates of a search, from the simulations that its ledger keeps.


# Weights need few samples; V of the stack is computed on all of them.
_MOST_SAMPLES = 2000
_ROUNDS = 3


def make_stack(evaluator: Evaluator, view: SearchView, store: Store, metric: str) -> Stack | None:
    """The stack of all scored candidates; None where it would be one candidate alone. A member that
    was never checked, because it was no new best, is asked what new bests are asked, and left out
    where it objects."""
    scored = [e for e in view.finished if e.score is not None and _is_its_own(e)]
    refused: set[int] = set()
    for _ in range(_ROUNDS):
        found = _Stacking(evaluator.data.folds, store, metric, _eligible(scored, refused)).stack()
        if found is None or view.best is None or view.best.score is None:
            return None
        if view.started.ladder is not None or found.value >= view.best.score.value:
            return found  # with the Ladder all were checked; otherwise this stack is not named
        members = [view.experiment(m.experiment) for m in found.members]
        unchecked = [e for e in members if not (e.kept or e.lowest)]
        bad = {e.number for e in unchecked if not _answers_like_a_model(evaluator, e, store)}
        if not bad:
            return found
        refused |= bad
    return None


def _is_its_own(experiment: Experiment) -> bool:
    """Neither the copy of another one, nor much better where it was not fitted."""
    result, score = experiment.result, experiment.score
    if result is None or score is None or result.duplicate_of is not None:
        return False
    errors = [fold.diagnostics.train_error for fold in result.folds]
    return (
        experiment.kept or experiment.lowest or consistency(score.value, errors) >= SUSPICIOUS_RATIO
    )


def _eligible(scored: Sequence[Experiment], refused: Collection[int]) -> list[Experiment]:
    """Those that can be members by the folds of any of the selections."""
    left = [e for e in scored if e.number not in refused]
    if not left:
        return []
    values = np.array([[fold.value for fold in e.score.folds] for e in left if e.score]).T
    others = [np.delete(values, k, axis=0).tolist() for k in range(len(values))]
    places = {place for part in (values.tolist(), *others) for place in candidates(part)}
    return [left[place] for place in sorted(places)]


def _answers_like_a_model(evaluator: Evaluator, experiment: Experiment, store: Store) -> bool:
    result, score = experiment.result, experiment.score
    assert result is not None
    assert score is not None
    folds = [
        FoldResult(one, store.get(kept.model), _answers(store, kept.y_hat, fold),
                   np.zeros((0, 2)), kept.diagnostics, kept.fit_seconds)
        for one, kept, fold in zip(score.folds, result.folds, evaluator.data.folds, strict=True)
    ]  # fmt: skip
    return evaluator.objection(store.text(experiment.proposed.source), folds) is None


def _answers(store: Store, digest: str, fold: Fold) -> tuple[Array, ...]:
    return store.get_arrays(digest, [block.y.shape for block in fold.validation])


@dataclass(frozen=True)
class _Stacking:
    folds: Sequence[Fold]
    store: Store
    metric: str
    experiments: Sequence[Experiment]

    def stack(self) -> Stack | None:
        """Weights from all folds, V from weights that the judged fold had no part in."""
        if len(self.experiments) < 2:
            return None
        parts = [self._part(fold) for fold in self.folds]
        weights = select_weights(parts, self._shortfall)
        if np.count_nonzero(weights) < 2:
            return None
        nested = nested_weights(parts, self._shortfall)
        values = [self._judged(fold, w) for fold, w in zip(self.folds, nested, strict=True)]
        order = [k for k in np.argsort(-weights, kind="stable").tolist() if weights[k] > 0]
        members = tuple(StackMember(self.experiments[k].number, float(weights[k])) for k in order)
        return Stack(members, float(np.mean(values)), tuple(values))

    @property
    def _shortfall(self) -> Shortfall:
        return find_metric(self.metric).shortfall

    def _part(self, fold: Fold) -> HeldOutPart:
        y = np.concatenate([block.y for block in fold.validation])
        thin = slice(None, None, -(-len(y) // _MOST_SAMPLES))
        y_hat = np.stack([self._simulated(e, fold)[thin] for e in self.experiments])
        values = tuple(e.score.folds[fold.index].value for e in self.experiments if e.score)
        return HeldOutPart(y[thin], y_hat, fold.scale, values)

    def _simulated(self, experiment: Experiment, fold: Fold) -> Array:
        assert experiment.result is not None
        return np.concatenate(_answers(self.store, experiment.result.folds[fold.index].y_hat, fold))

    def _judged(self, fold: Fold, weights: Array) -> float:
        """The error of the weighted mean on all samples that the fold holds out."""
        y = np.concatenate([block.y for block in fold.validation])
        y_hat = np.zeros_like(y)
        for place in np.flatnonzero(weights).tolist():
            y_hat += weights[place] * self._simulated(self.experiments[place], fold)
        return self._shortfall(y, y_hat, fold.scale)


# Final models of a search: refit the winner on all training records, check the refit, build the
# stack, choose the model to use.


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
        if not evaluator.workers.is_sequential:
            # It does not depend on the refit.
            make = opened.enter_context(evaluator.workers.background(stacked)).result
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
