"""Fits that are ended from another thread, and folds that do not count any more."""

import threading

import pytest

from asia.errors import Reason, SandboxError
from asia.judge.evaluation.background import CancelFlag
from asia.judge.evaluation.pruning import FoldPruner
from asia.judge.evaluation.results import Evaluation
from asia.judge.scoring.outcome import Failure, Score


class Fold:
    """Stand-in for a fit that the test or its stop ends."""

    def __init__(self, pruner: FoldPruner, index: int, value: float | Failure) -> None:
        self._pruner, self._index, self._value = pruner, index, value
        self.begun, self.over, self.ended = threading.Event(), threading.Event(), False
        self.given: list[Evaluation | None] = []
        self.thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        self.given.append(self._pruner.fit(self._index, self._fit))

    def _fit(self) -> Evaluation:
        def end() -> None:
            self.ended = True
            self.over.set()

        with self._pruner.cancels[self._index].on_cancel(end):
            self.begun.set()
            assert self.over.wait(20.0)
            if self.ended:
                raise SandboxError("the worker is gone")
        value = self._value
        return Evaluation(Score(value, ()) if isinstance(value, float) else value)

    def finish(self) -> None:
        self.over.set()
        self.thread.join()


def started(pruner: FoldPruner, *values: float | Failure) -> list[Fold]:
    folds = [Fold(pruner, index, value) for index, value in enumerate(values)]
    for fold in folds:
        fold.thread.start()
        assert fold.begun.wait(20.0)
    return folds


def test_folds_behind_the_last_one_that_counts_are_ended_at_once() -> None:
    pruner = FoldPruner(4, 1.0)
    first, second, third, fourth = started(pruner, 2.5, 2.0, 9.0, 9.0)
    first.finish()
    assert pruner.failure() is None
    second.finish()
    for fold in (third, fourth):
        fold.thread.join()
        assert fold.ended
        assert fold.given == [None]
    assert pruner.ended == 2
    assert pruner.failure() == Failure(Reason.BEHIND, "V is at least 1.125 by 2 of 4 folds", 2)


def test_an_earlier_fold_is_never_ended_by_a_later_one() -> None:
    pruner = FoldPruner(3, 1.0)
    first, second, third = started(pruner, 0.5, 20.0, 0.5)
    second.finish()
    third.finish()
    assert not first.ended
    assert pruner.failure() is None
    first.finish()
    assert first.given[0] is not None
    # The same as in any other order.
    assert pruner.failure() == Failure(Reason.BEHIND, "V is at least 6.833 by 2 of 3 folds", 2)
    assert pruner.ended == 0


def test_a_fold_that_failed_ends_no_other() -> None:
    pruner = FoldPruner(2, 1.0)
    first, second = started(pruner, Failure(Reason.CRASH), 0.1)
    first.finish()
    assert not second.ended
    second.finish()
    assert second.given[0] is not None
    assert pruner.failure() is None


def test_trouble_with_a_worker_that_was_not_ended_is_raised() -> None:
    def fit() -> Evaluation:
        raise SandboxError("out of luck")

    with pytest.raises(SandboxError, match="out of luck"):
        FoldPruner(2, 1.0).fit(0, fit)


def test_nothing_begins_after_a_stop_and_ended_folds_are_kept() -> None:
    flag, calls = CancelFlag(), list[int]()
    with flag.on_cancel(lambda: calls.append(1)):
        pass
    with flag.on_cancel(lambda: calls.append(2)):
        flag.cancel()
    assert calls == [2]
    with pytest.raises(SandboxError, match="not wanted any more"), flag.on_cancel(lambda: None):
        pass
