"""Standby workers: each waits inside its sandbox, with its libraries loaded, for a candidate. One
that ran the library alone waits again, for the next source of the library alone."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass

from asia.errors import SandboxError
from asia.judge.sandbox.availability import open_worker
from asia.judge.sandbox.types import Isolation, Limits
from asia.judge.sandbox.worker.worker import Worker

_MOST_SETS = 2
_MOST_WAITING = 4


@dataclass(frozen=True)
class _Waiting:
    """A worker, once it has been started."""

    libraries: frozenset[str]
    worker: Future[Worker]
    used: bool = False
    """It ran sources of the library alone; else it has been asked nothing."""


class StandbyWorkers:
    """Pool of standby workers, used as a context manager.

    A few workers wait for each of the last two requested sets of libraries. A fresh worker has
    loaded nothing that its candidate, or the library functions it may call, would not load, so that
    its use changes no number; only a fit at its memory limit may notice. A used worker still holds
    what it was given before: no code but the library's ever runs in it.
    """

    def __init__(self, level: Isolation, limits: Limits, most: int) -> None:
        """most: how many are needed at once; no more wait for each set of libraries than there are
        cores, and few on any machine."""
        self._open: Callable[[frozenset[str]], Worker] = lambda libraries: open_worker(
            level, limits, libraries=libraries
        )
        self._cores = min(os.cpu_count() or 1, _MOST_WAITING)
        self._most = min(most, self._cores)
        self._lock = threading.Lock()
        self._waiting: list[_Waiting] = []
        self._wanted: list[frozenset[str]] = []
        self._failed: set[frozenset[str]] = set()
        self._closed = False
        # One thread for all, which ends last: a worker ends with the thread that started it.
        self._starter = ThreadPoolExecutor(1, "ready-workers")

    def __enter__(self) -> StandbyWorkers:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def take(self, libraries: frozenset[str], *, library_only: bool = False) -> Worker | None:
        """Return a standby worker for a candidate that loads these libraries, or None, and start
        those needed next.

        Args:
            library_only: the candidate calls the library alone: a used worker will do, one is
                started where none waits, and none is started for the next, which gets this one
        """
        with self._lock:
            startable = not (self._closed or libraries in self._failed)
            used = [one for one in self._waiting if one.used and one.libraries >= libraries]
            fresh = [o for o in self._waiting if not o.used and o.libraries <= libraries]
            if library_only and used:
                found = min(used, key=lambda one: len(one.libraries))
            else:
                found = max(fresh, key=lambda one: len(one.libraries), default=None)
            if found is not None:
                self._waiting.remove(found)
            elif library_only and startable:
                found = self._started(libraries)
            if startable and not library_only:
                self._start_next(libraries)
        if found is None:
            return None
        if found.worker.exception() is None:
            with suppress(SandboxError):
                found.worker.result().wait()
                return found.worker.result()
        with self._lock:
            self._failed.add(found.libraries)
        return None

    def give_back(self, worker: Worker, libraries: frozenset[str]) -> bool:
        """Keep a worker from here that has run the library alone and is `Worker.renew`ed; return
        False where enough of them wait."""
        done: Future[Worker] = Future()
        done.set_result(worker)
        with self._lock:
            alike = sum(one.used and one.libraries == libraries for one in self._waiting)
            if not self._closed and alike < self._cores:
                self._waiting.append(_Waiting(libraries, done, used=True))
                return True
        return False

    def close(self) -> None:
        """End all that wait, then the thread that started those which were taken."""
        with self._lock:
            self._closed = True
            waiting, self._waiting = self._waiting, []
        for one in waiting:
            one.worker.cancel()
        wait([one.worker for one in waiting])
        for one in waiting:
            _end(one.worker)
        self._starter.shutdown()

    def _start_next(self, libraries: frozenset[str]) -> None:
        self._wanted = [libraries, *(s for s in self._wanted if s != libraries)][:_MOST_SETS]
        fresh = [one for one in self._waiting if not one.used]
        for one in [one for one in fresh if one.libraries not in self._wanted]:
            self._waiting.remove(one)
            self._starter.submit(_end, one.worker)
        for _ in range(self._most - sum(one.libraries == libraries for one in fresh)):
            self._waiting.append(self._started(libraries))

    def _started(self, libraries: frozenset[str]) -> _Waiting:
        return _Waiting(libraries, self._starter.submit(self._open, libraries))


def _end(worker: Future[Worker]) -> None:
    """End a worker that will receive no request."""
    if not worker.cancelled() and worker.exception() is None:
        worker.result().close()
