"""Check of a refit: it saw all training records and must fit them as well as the fold models do."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median

import numpy as np

from asia.candidate import ParameterEstimates
from asia.data import Array
from asia.errors import CandidateError, Reason
from asia.evaluation import Evaluator, RefitModel, mean_simulation
from asia.ledger import RefitCheck, RefitStart, error_line, error_value
from asia.scoring import score_fold

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
        answers = self.evaluator.simulate_training(self.source, self.fold_models)
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
        (answers,) = self.evaluator.simulate_training(self.source, [model])
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
        y = [block.y for block in self.evaluator.training_blocks]
        try:
            return score_fold(y, answers, self.evaluator.scale, self.metric).value
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
        return float(np.mean(np.sqrt(np.mean(apart**2, axis=0)) / self.evaluator.scale))
