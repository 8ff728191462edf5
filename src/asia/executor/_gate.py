"""No more jobs at once than there is room, the most urgent first."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Generic, TypeVar

T = TypeVar("T")

_LOOK_SECONDS = 1.0


@dataclass
class Turn:
    """How long jobs can wait, which may change while they do."""

    number: int = 0
    """Of jobs that wait, the one with the lowest number goes first."""


@dataclass(frozen=True)
class TurnedJob(Generic[T]):
    """A job that says how long it can wait."""

    turn: Turn
    """When it is its turn."""
    job: Callable[[], T]
    """The job."""

    def __call__(self) -> T:
        return self.job()


def turn_of(job: Callable[[], object]) -> Turn:
    """The turn that a job has; the first one where it says nothing."""
    return job.turn if isinstance(job, TurnedJob) else Turn()


@dataclass(frozen=True)
class _Entrant:
    """Who waits."""

    turn: Turn
    came: int

    @property
    def place(self) -> tuple[int, int]:
        return self.turn.number, self.came


class Gate:
    """Whoever enters waits until there is room: by turn, then in the order of coming."""

    def __init__(self, room: Callable[[], int]) -> None:
        """room: how many may be inside, asked again and again."""
        self._room = room
        self._changed = threading.Condition()
        self._numbers = itertools.count()
        self._waiting: list[_Entrant] = []
        self._inside = 0

    @contextmanager
    def entered(self, turn: Turn) -> Generator[None]:
        """Inside, once there is room and no other who waits has an earlier turn."""
        with self._changed:
            mine = _Entrant(turn, next(self._numbers))
            self._waiting.append(mine)
            try:
                while self._inside >= self._room() or self._first is not mine:
                    self._changed.wait(_LOOK_SECONDS)
            finally:
                self._waiting.remove(mine)
                self._changed.notify_all()
            self._inside += 1
        try:
            yield
        finally:
            with self._changed:
                self._inside -= 1
                self._changed.notify_all()

    @property
    def _first(self) -> _Entrant:
        return min(self._waiting, key=lambda one: one.place)
