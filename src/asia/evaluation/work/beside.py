"""Work of a search beside other work of it: how it is asked for, and what comes of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from asia._stopwatch import Lane, Stopwatch
from asia.evaluation.work.stopping import FitStop
from asia.executor import Turn

T = TypeVar("T")

SPARE_TURN = 1_000_000_000
"""The turn of work that may turn out not to be needed: behind all that is."""


def nothing() -> None:
    """For whom nobody listens."""


@dataclass(frozen=True)
class Asked:
    """How a thread of the search wants its jobs run."""

    turn: Turn = field(default_factory=Turn)
    """When those that must wait are let in."""
    stop: FitStop = field(default_factory=FitStop)
    """Ends them."""
    on_begin: Callable[[], None] = nothing
    """Called as each of them begins."""


class Beside(Generic[T]):
    """A job that gives others to the executor, in a thread of its own."""

    def __init__(
        self, asked: Asked, watch: Stopwatch, thread: ThreadPoolExecutor, job: Callable[[], T]
    ) -> None:
        """asked: how it wants its jobs run."""
        self._asked, self._watch = asked, watch
        self._under_way: Future[tuple[T, Lane]] = thread.submit(self._run, job)

    def _run(self, job: Callable[[], T]) -> tuple[T, Lane]:
        with self._watch.aside() as lane:
            return job(), lane

    def result(self) -> T:
        """What the job gives, waited for; raises what it raised. Its jobs need not wait longer than
        others now."""
        self._asked.turn.number = 0
        begin = time.monotonic()
        found, lane = self._under_way.result()
        self._watch.waited(lane, time.monotonic() - begin)
        return found

    def drop(self) -> None:
        """Nobody asks for the result any more: what it still does is ended."""
        self._asked.stop.stop()
