"""The fits of a candidate from other seeds, the next one begun where workers are free."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager

from asia.evaluation import BackgroundJob, Evaluation, Evaluator, JobSettings


@contextmanager
def retest_fits(
    evaluator: Evaluator, fit: Callable[[int], Evaluation], most: int
) -> Generator[Callable[[int], Evaluation]]:
    """Prefetch fits: yield a function that returns the results of `fit(0)`, `fit(1)`, ... in order.

    Once all folds of one fit have started, the next fit begins; an unused one is cancelled. The
    results do not depend on that.

    Args:
        evaluator: the evaluator of the fits.
        fit: function that fits with a repeat number.
        most: maximum number of fits.
    """
    if not evaluator.may_fit_ahead:
        yield fit
        return
    with ExitStack() as opened:
        yield _RetestFits(evaluator, fit, most, opened).take


class _RetestFits:
    def __init__(
        self,
        evaluator: Evaluator,
        fit: Callable[[int], Evaluation],
        most: int,
        opened: ExitStack,
    ) -> None:
        self._evaluator, self._fit, self._most, self._opened = evaluator, fit, most, opened
        self._begun: list[_Begun] = []
        self._fits: list[BackgroundJob[Evaluation]] = []

    def take(self, number: int) -> Evaluation:
        for following in range(len(self._fits), min(number + 2, self._most)):
            self._begin(following)
        return self._fits[number].result()

    def _begin(self, number: int) -> None:
        before = self._begun[-1] if self._begun else None
        mine = _Begun(len(self._evaluator.folds))
        self._begun.append(mine)

        def fit() -> Evaluation:
            if before is not None:
                before.all.wait()
            try:
                return self._fit(number)
            finally:
                mine.all.set()

        job = self._evaluator.background(fit, JobSettings(on_begin=mine.one))
        self._fits.append(self._opened.enter_context(job))


class _Begun:
    """Counter of the folds of a fit that have started."""

    def __init__(self, folds: int) -> None:
        self.all = threading.Event()
        self._left, self._lock = folds, threading.Lock()

    def one(self) -> None:
        """Count one more fold."""
        with self._lock:
            self._left -= 1
            if self._left <= 0:
                self.all.set()
