"""Standby workers: each waits inside its sandbox, with its libraries loaded, for a candidate, and
is used once."""

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
    """A worker that has been asked nothing, once it has been started."""

    libraries: frozenset[str]
    worker: Future[Worker]


class StandbyWorkers:
    """Pool of standby workers, used as a context manager.

    A few workers wait for each of the last two requested sets of libraries. A worker has loaded
    nothing that its candidate, or the library functions it may call, would not load, so that its
    use changes no number; only a fit at its memory limit may notice.
    """

    def __init__(self, level: Isolation, limits: Limits, most: int) -> None:
        """most: how many are needed at once; no more wait for each set of libraries than there are
        cores, and few on any machine."""
        self._open: Callable[[frozenset[str]], Worker] = lambda libraries: open_worker(
            level, limits, libraries=libraries
        )
        self._most = min(most, os.cpu_count() or 1, _MOST_WAITING)
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

    def take(self, libraries: frozenset[str]) -> Worker | None:
        """Return a standby worker for a candidate that loads these libraries, or None, and start
        those needed next."""
        with self._lock:
            fitting = [one for one in self._waiting if one.libraries <= libraries]
            found = max(fitting, key=lambda one: len(one.libraries), default=None)
            if found is not None:
                self._waiting.remove(found)
            if not self._closed and libraries not in self._failed:
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
        for one in [one for one in self._waiting if one.libraries not in self._wanted]:
            self._waiting.remove(one)
            self._starter.submit(_end, one.worker)
        for _ in range(self._most - sum(one.libraries == libraries for one in self._waiting)):
            started = self._starter.submit(self._open, libraries)
            self._waiting.append(_Waiting(libraries, started))


def _end(worker: Future[Worker]) -> None:
    """End a worker that will receive no request."""
    if not worker.cancelled() and worker.exception() is None:
        worker.result().close()
