"""Whether a refit deserves to be used: it saw all that the fold models saw, and must fit it as
well as they do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median

import numpy as np

from asia.data import Array
from asia.errors import CandidateError
from asia.evaluation import Evaluator, mean_simulation
from asia.ledger import RefitCheck, RefitStart, error_value
from asia.scoring import score_fold

STARTS = 3
# Of the error of a fold model in the middle; one fold model in ten lies further from another.
FALLS_SHORT = 1.2
# In standard deviations of the output: below it an error is as good as none.
NEGLIGIBLE = 1e-3

Answers = tuple[Array, ...]


@dataclass(frozen=True)
class CheckedRefit:
    """A refit that was compared with the fold models."""

    model: bytes | None
    """The first start that nothing speaks against; None where there is none."""
    detail: str
    """Why there is none."""
    check: RefitCheck | None
    """The comparison; None where it could not be made."""


def check_refit(
    evaluator: Evaluator,
    source: str,
    fold_models: Sequence[bytes],
    first: bytes | CandidateError,
    metric: str,
) -> CheckedRefit:
    """Compare a refit with the fold models on the training records; where it falls short, fit again
    from other seeds. first: the refit as `Evaluator.refit` made it."""
    check = _Comparison(evaluator, source, metric, fold_models)
    tried: list[bytes | CandidateError] = []
    while len(tried) < STARTS:
        model = first if not tried else evaluator.refit_again(source, len(tried))
        if isinstance(model, bytes) and model in tried:
            break  # a fit without randomness
        tried.append(model)
        if check.is_sound(model):
            assert isinstance(model, bytes)
            return CheckedRefit(model, "", check.result)
    return CheckedRefit(None, _none_words(check.result.starts), check.result)


def _none_words(starts: Sequence[RefitStart]) -> str:
    """Why there is no refit, for people."""
    if len(starts) == 1:
        return f"the only start of the refit is no good: {starts[0].objection}"
    return f"none of {len(starts)} starts of the refit is good; the last: {starts[-1].objection}"


@dataclass
class _Comparison:
    evaluator: Evaluator
    source: str
    metric: str
    fold_models: Sequence[bytes]
    starts: list[RefitStart] = field(default_factory=list[RefitStart])

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
        """What was found so far."""
        return RefitCheck(
            fold_errors=self._errors,
            ensemble_error=None if self._mean is None else self._error(self._mean),
            fold_disagreement=self._fold_disagreement(),
            starts=tuple(self.starts),
        )

    def is_sound(self, model: bytes | CandidateError) -> bool:
        """Whether nothing speaks against this start, which is noted."""
        if isinstance(model, CandidateError):
            self.starts.append(RefitStart(None, None, f"its fit failed: {model}"))
            return False
        (answers,) = self.evaluator.simulate_training(self.source, [model])
        if isinstance(answers, CandidateError):
            self.starts.append(RefitStart(None, None, f"its simulation failed: {answers}"))
            return False
        error = self._error(answers)
        words = self._error_words(error) or self._relation_words(model, answers)
        apart = None if self._mean is None else self._apart(answers, self._mean)
        self.starts.append(RefitStart(error, apart, words))
        return not words

    def _error_words(self, error: float | None) -> str:
        known = [one for one in self._errors if one is not None]
        if error is None:
            return "its error on the training records is not finite"
        if not known or error <= FALLS_SHORT * median(known) + NEGLIGIBLE:
            return ""
        return (
            f"its error on its own training records is {error_value(error)}, that of a fold model "
            f"{error_value(median(known))}"
        )

    def _relation_words(self, model: bytes, answers: Answers) -> str:
        failure = self.evaluator.refit_objection(self.source, model, answers)
        return "" if failure is None else failure.detail or failure.advice

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
