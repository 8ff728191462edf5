"""A candidate fitted and scored in this process, by the evaluator's own folds, order of cases and
metric."""

from __future__ import annotations

import linecache
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np

from asia.candidate import VALIDATION_SCORES, Context, Model, check_source, executed_source
from asia.data import Array
from asia.errors import CandidateError, Reason
from asia.evaluation import derive_seed, rounded_score, simulate_held_out, simulate_training
from asia.protocol import Block, Fold, ProtocolRule, whole
from asia.scoring import (
    FoldScore,
    SignedResidual,
    check_reply,
    score_fold,
    signed_residuals,
    without_gaps,
)

_SOURCE_NAME = "candidate.py"


@dataclass(frozen=True, repr=False)
class LocalFold:
    """One fold of a candidate that was fitted in this process."""

    fold: Fold
    """Training and held-out parts."""
    model: Model
    """The fitted model."""
    seconds: float
    """Duration of the fit, s."""
    score: FoldScore
    """The errors on the held-out part; `score.value` is V of this fold."""
    training_score: FoldScore
    """The errors on the training records."""
    training: tuple[Block, ...]
    """The training records as cases."""
    y_hat: tuple[Array, ...]
    """Simulated outputs (H, ny) of each held-out block."""
    training_y_hat: tuple[Array, ...]
    """Simulated outputs (H, ny) of each block in `training`."""

    def __repr__(self) -> str:
        return (
            f"<fold {self.fold.index + 1}: V {self.score.value:.6f}, training "
            f"{self.training_score.value:.6f}, fit {self.seconds:.1f} s>"
        )

    @property
    def parameters(self) -> dict[str, float]:
        """Names and values that the model gives, {} where it has no method `parameters`."""
        named = getattr(self.model, "parameters", None)
        found: Any = named() if callable(named) else {}
        return {str(k): float(v) for k, v in found.items()} if isinstance(found, dict) else {}

    def residuals(self, *, held_out: bool) -> tuple[SignedResidual, ...]:
        """Return the operating ranges in which the model is too high or too low, on the held-out or
        on the training part.
        """
        blocks = self.fold.validation if held_out else self.training
        y_hat = self.y_hat if held_out else self.training_y_hat
        u = [b.case.u for b in blocks]
        y = [without_gaps(b.y, found) for b, found in zip(blocks, y_hat, strict=True)]
        return signed_residuals(u, y, y_hat, self.fold.scale)


def evaluate(
    source: str, folds: Sequence[Fold], context: Context, rule: ProtocolRule, fit_seconds: float
) -> tuple[LocalFold, ...]:
    """Fit `source` on each fold and score it; context: that of the search, with its seed;
    fit_seconds: the limit that `context.deadline` states; a fit that takes longer is not stopped.

    Raises CandidateError for what the evaluator would refuse; what the candidate itself raises
    comes through.
    """
    check_source(source)
    source = executed_source(source)
    return tuple(_fold(source, fold, context, rule, fit_seconds) for fold in folds)


def _fold(
    source: str, fold: Fold, context: Context, rule: ProtocolRule, fit_seconds: float
) -> LocalFold:
    fit = _executed(source)
    known = replace(
        context,
        seed=derive_seed(context.seed, fold.index, 0),
        deadline=time.monotonic() + fit_seconds,
        validation_score=_validation_score(fold, rule)
        if rule.early_stopping == "validation"
        else None,
    )
    begin = time.monotonic()
    model = fit(list(fold.train), known)
    seconds = time.monotonic() - begin
    simulator, training = _Simulator(model), whole(fold.train, rule)
    y_hat = simulate_held_out(simulator, fold.validation, rule.horizon)
    training_y_hat = simulate_training(simulator, training, rule.horizon)
    return LocalFold(
        fold=fold,
        model=model,
        seconds=seconds,
        score=_score(fold.validation, y_hat, fold, rule),
        training_score=_score(training, training_y_hat, fold, rule),
        training=training,
        y_hat=y_hat,
        training_y_hat=training_y_hat,
    )


def _score(
    blocks: Sequence[Block], y_hat: Sequence[Array], fold: Fold, rule: ProtocolRule
) -> FoldScore:
    return score_fold([b.y for b in blocks], y_hat, fold.scale, rule.metric)


def _executed(source: str) -> Any:
    """`fit` of the source, run as module `candidate`, anew for each fold as in a worker."""
    module = ModuleType("candidate")
    module.__file__ = _SOURCE_NAME
    sys.modules["candidate"] = module
    lines = source.splitlines(keepends=True)
    linecache.cache[_SOURCE_NAME] = (len(source), None, lines, _SOURCE_NAME)
    exec(compile(source, _SOURCE_NAME, "exec", dont_inherit=True), module.__dict__)
    return module.fit


@dataclass(frozen=True)
class _Simulator:
    """A model that answers as a worker does: float64, of the right shape, finite."""

    model: Model

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        y = np.array(self.model.simulate(past_u, past_y, u), dtype=np.float64)
        check_reply(y, (*u.shape[:2], past_y.shape[2]))
        return y


def _validation_score(fold: Fold, rule: ProtocolRule) -> Any:
    calls = 0

    def score(model: Model) -> float:
        nonlocal calls
        calls += 1
        if calls > VALIDATION_SCORES:
            raise RuntimeError(f"validation_score was called {VALIDATION_SCORES} times")
        try:
            y_hat = simulate_held_out(_Simulator(model), fold.validation, rule.horizon)
            return rounded_score(_score(fold.validation, y_hat, fold, rule).value)
        except CandidateError as error:
            if error.reason is Reason.NOT_FINITE:
                return float("inf")
            raise

    return score
