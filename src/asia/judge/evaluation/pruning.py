"""Early pruning: folds that can change no decision, since V is too high without them."""

import threading
from collections.abc import Callable

from asia.errors import Reason, SandboxError
from asia.judge.evaluation.background import CancelFlag
from asia.judge.evaluation.results import Evaluation
from asia.judge.scoring.outcome import Failure, Score


class FoldPruner:
    """Lower bound on V from the first folds of a fit, while others run in other threads.

    The parts of V are never negative. So V is at least the sum of the known parts over the number
    of folds. Only folds without a gap before them count, so the result does not depend on which
    fold ends first. Folds after the last one that counts are ended while they run.
    """

    def __init__(self, folds: int, over: float) -> None:
        """over: the V above which the other folds do not count."""
        self._over = over
        self._parts: list[float | None] = [None] * folds
        self._lock = threading.Lock()
        self.cancels = tuple(CancelFlag() for _ in range(folds))
        self.ended = 0
        """How many folds were ended while they ran."""

    def fit(self, index: int, job: Callable[[], Evaluation]) -> Evaluation | None:
        """Run the fit of a fold; return None where it no longer counts: it was not started, or it
        was cancelled."""
        if self.failure() is not None:
            return None
        try:
            end = job()
        except SandboxError:
            if not self.cancels[index].cancelled:
                raise
            with self._lock:
                self.ended += 1
            return None
        if isinstance(end.outcome, Score):
            with self._lock:
                self._parts[index] = end.outcome.value
            failure = self.failure()
            if failure is not None:
                for flag in self.cancels[failure.fold :]:
                    flag.cancel()
        return end

    def failure(self) -> Failure | None:
        """Return the reason why the candidate has no V: its last fold that counts, and the bound
        there; None while all folds count."""
        count, total = len(self._parts), 0.0
        with self._lock:
            parts = self._parts[:-1]
        for place, part in enumerate(parts, 1):
            if part is None:
                return None
            total += part
            if total / count > self._over:
                words = f"V is at least {total / count:.4g} by {place} of {count} folds"
                return Failure(Reason.BEHIND, words, place)
        return None
