"""The score on a fold's held-out part while a candidate trains: metered, capped, a number only."""

from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from typing import Self

from asia.candidate import VALIDATION_SCORES, Context
from asia.errors import CandidateError, Reason
from asia.judge.evaluation.requests import simulate_held_out
from asia.judge.sandbox.types import ScoreRefusedError
from asia.judge.sandbox.worker.worker import Worker
from asia.judge.scoring.outcome import score_fold
from asia.problem.folds import Fold
from asia.problem.protocol import ProtocolRule

LARGEST_SCORE = 100.0


@dataclass
class Oracle:
    """Server of `context.validation_score` of one fit of `source` on `fold`; use it as a context
    manager.

    Models are simulated in a worker of their own, opened for the first of them and kept for all:
    the worker that trains never receives a case, and targets stay in the parent.
    """

    open_worker: Callable[[], AbstractContextManager[Worker]]
    source: str
    context: Context
    fold: Fold
    """The fold on whose held-out part models are scored."""
    rule: ProtocolRule
    calls: int = 0
    """Number of scores requested so far."""
    _worker: Worker | None = None
    _stack: ExitStack = field(default_factory=ExitStack)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self._stack.close()

    def __call__(self, model: bytes, deadline: float) -> float:
        """Return the normalised metric as `rounded_score` gives it; inf where the simulation is not
        finite, which is possible before a fit has converged.

        Raises:
            CandidateError: for any other failure of the model
            ScoreRefusedError: after VALIDATION_SCORES calls
        """
        if self.calls >= VALIDATION_SCORES:
            raise ScoreRefusedError(
                f"validation_score was called {VALIDATION_SCORES} times, all that a fit may: "
                "call it less often"
            )
        self.calls += 1
        try:
            if self._worker is None:
                self._worker = self._stack.enter_context(self.open_worker())
            self._worker.answer_by(deadline)
            self._worker.load(self.source, model, self.context)
            blocks = self.fold.held_out
            y_hat = simulate_held_out(self._worker, blocks)
            score = score_fold([b.y for b in blocks], y_hat, self.fold.scale, self.rule.metric)
            return rounded_score(score.value)
        except CandidateError as error:
            if error.reason is Reason.NOT_FINITE:
                return float("inf")
            detail = f"in a call of validation_score: {error.detail or error.reason.advice}"
            raise CandidateError(error.reason, detail) from None


def rounded_score(value: float) -> float:
    """A score as a candidate receives it: four digits, and inf where it is too large to be of use.
    All digits of many scores would reveal the held-out outputs."""
    return float(f"{value:.3e}") if value < LARGEST_SCORE else float("inf")
