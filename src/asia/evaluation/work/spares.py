"""Workers that a worker machine starts before there is a fold for them."""

from __future__ import annotations

import threading
from collections.abc import Generator
from contextlib import contextmanager
from functools import cache

from asia.sandbox import Isolation, Limits, ReadyWorkers, Worker, open_worker

_KEPT_SECONDS = 60.0


class SpareWorkers:
    """One waits for each of the last sets of libraries, as in a search on its own machine. Those of
    a search that has sent nothing for a minute are ended."""

    def __init__(self, seconds: float = _KEPT_SECONDS) -> None:
        self._seconds = seconds
        self._lock = threading.Lock()
        self._kept: dict[tuple[Isolation, Limits], ReadyWorkers] = {}
        # A worker ends with the thread that started it: none is closed while one of its is used.
        self._used: dict[tuple[Isolation, Limits], int] = {}
        self._end = threading.Timer(0.0, self._end_unused)

    @contextmanager
    def worker(
        self, isolation: Isolation, limits: Limits, libraries: frozenset[str]
    ) -> Generator[Worker]:
        """One that waits, or a fresh one. Raises SandboxError."""
        key = isolation, limits
        with self._lock:
            self._end.cancel()
            ready = self._kept.get(key)
            if ready is None:
                ready = self._kept[key] = ReadyWorkers(isolation, limits, 1)
            self._used[key] = self._used.get(key, 0) + 1
        try:
            with ready.take(libraries) or open_worker(
                isolation, limits, libraries=libraries
            ) as worker:
                yield worker
        finally:
            with self._lock:
                self._used[key] -= 1
                self._end.cancel()
                self._end = threading.Timer(self._seconds, self._end_unused)
                self._end.daemon = True
                self._end.start()

    def _end_unused(self) -> None:
        with self._lock:
            unused = [self._kept.pop(key) for key in list(self._kept) if not self._used[key]]
        for ready in unused:
            ready.close()


@cache
def spare_workers() -> SpareWorkers:
    """Those of this process, which fits folds for searches elsewhere."""
    return SpareWorkers()
