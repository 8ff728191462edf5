"""Folds that can change no decision any more, since V is too high without them."""

from __future__ import annotations

import threading
from collections.abc import Callable

from asia.errors import Reason
from asia.evaluation._results import FoldEnd, FoldResult
from asia.scoring import Failure


class FoldBound:
    """A lower bound on V from the first folds of a fit, while others run in other threads.

    The parts of V are never negative. So V is at least the sum of those that are known, over the
    number of folds. Only folds without a gap before them count, so what comes out does not depend
    on which fold ends first.
    """

    def __init__(self, folds: int, over: float) -> None:
        """over: the V above which the other folds do not count."""
        self._over = over
        self._parts: list[float | None] = [None] * folds
        self._lock = threading.Lock()

    def fit(self, index: int, job: Callable[[], FoldEnd]) -> FoldEnd | None:
        """What the fold gives; None, and nothing is fitted, where it does not count any more."""
        if self.failure() is not None:
            return None
        end = job()
        if isinstance(end.result, FoldResult):
            with self._lock:
                self._parts[index] = end.result.score.value
        return end

    def failure(self) -> Failure | None:
        """Why the candidate has no V: its last fold that counts, and the bound there; None as long
        as all folds count."""
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
