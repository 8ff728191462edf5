"""The next retest begins where workers are free, and is ended where nobody asks for it."""

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import Executor, LocalExecutor, SequentialExecutor
from asia.judge.sandbox.types import Isolation
from asia.problem.budget import Budget
from asia.search.pending import retest_fits

SECONDS = 20.0


class Runner(WorkerRunner):
    """Fits of two folds each; the test ends them, or their stop does."""

    folds = (1, 2)

    def __init__(self, executor: Executor) -> None:
        super().__init__(Isolation.PROCESS, Budget(fit_seconds=1.0), executor)
        self.workers = self.data = self
        self.begun: list[tuple[int, int]] = []
        self.stopped: list[tuple[int, int]] = []
        self.over: dict[tuple[int, int], threading.Event] = {}
        self.changed = threading.Condition()

    @property
    def may_fit_ahead(self) -> bool:
        return not self.is_sequential

    def fit(self, number: int) -> Any:
        return self.run([partial(self._fold, number, fold) for fold in self.folds])

    def _fold(self, number: int, fold: int) -> tuple[int, int]:
        place = number, fold
        over = self.end_of(number, fold)
        with self.changed:
            self.begun.append(place)
            self.changed.notify_all()
        with self.settings.cancel.on_cancel(lambda: self._stop(place)):
            assert over.wait(SECONDS)
        return place

    def _stop(self, place: tuple[int, int]) -> None:
        with self.changed:
            self.stopped.append(place)
            self.changed.notify_all()
        self.end_of(*place).set()

    def end_of(self, number: int, fold: int) -> threading.Event:
        with self.changed:
            return self.over.setdefault((number, fold), threading.Event())

    def await_begun(self, *places: tuple[int, int]) -> None:
        with self.changed:
            assert self.changed.wait_for(lambda: {*places} <= {*self.begun}, SECONDS)


def later(call: Callable[[], None]) -> threading.Thread:
    thread = threading.Thread(target=call)
    thread.start()
    return thread


def fits(runner: Runner, most: int) -> Any:
    evaluator: Evaluator = runner  # type: ignore[assignment]
    return retest_fits(evaluator, runner.fit, most)


def test_the_next_one_begins_in_a_free_place_and_is_fitted_once() -> None:
    runner = Runner(LocalExecutor(3))

    def course() -> None:
        runner.await_begun((0, 1), (0, 2), (1, 1))
        assert (1, 2) not in runner.begun
        runner.end_of(0, 1).set()
        runner.await_begun((1, 2))
        for place in ((0, 2), (1, 1), (1, 2)):
            runner.end_of(*place).set()

    thread = later(course)
    with fits(runner, 2) as fit:
        assert fit(0) == [(0, 1), (0, 2)]
        assert fit(1) == [(1, 1), (1, 2)]
    thread.join()
    assert sorted(runner.begun) == [(0, 1), (0, 2), (1, 1), (1, 2)]
    assert runner.stopped == []


def test_one_that_nobody_asks_for_is_ended() -> None:
    runner = Runner(LocalExecutor(4))

    def course() -> None:
        runner.await_begun((0, 1), (0, 2), (1, 1), (1, 2))
        runner.end_of(0, 1).set()
        runner.end_of(0, 2).set()

    thread = later(course)
    with fits(runner, 2) as fit:
        fit(0)
    thread.join()
    assert sorted(runner.stopped) == [(1, 1), (1, 2)]


@pytest.mark.parametrize("most", [1, 2])
def test_one_by_one_nothing_is_fitted_ahead(most: int) -> None:
    runner = Runner(SequentialExecutor(LocalExecutor(4)))
    for fold in (1, 2):
        runner.end_of(0, fold).set()
    with fits(runner, most) as fit:
        fit(0)
    assert runner.begun == [(0, 1), (0, 2)]


def test_an_interrupt_ends_all() -> None:
    runner = Runner(LocalExecutor(4))
    for fold in (1, 2):
        runner.end_of(0, fold).set()

    def interrupted() -> None:
        with fits(runner, 2) as fit:
            fit(0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert runner._aborted


def test_what_a_fit_raises_is_raised_where_it_is_asked_for() -> None:
    runner = Runner(LocalExecutor(4))

    def fails(number: int) -> Any:
        return runner.run([partial(int, "no number")])

    evaluator: Evaluator = runner  # type: ignore[assignment]
    with retest_fits(evaluator, fails, 2) as fit, pytest.raises(ValueError, match="no number"):
        fit(0)
