"""Early end of work in other threads."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager

from asia.sandbox import Worker


class Interruption:
    """Flag that ends the run and its workers."""

    def __init__(self) -> None:
        self.begun = False
        self._workers: set[Worker] = set()

    def begin(self) -> None:
        """End the workers that run, and those that start later."""
        self.begun = True
        for worker in list(self._workers):
            worker.abort()

    @contextmanager
    def ends(self, worker: Worker) -> Generator[None]:
        """While this is open, the worker is ended with the run."""
        self._workers.add(worker)
        try:
            if self.begun:
                worker.abort()
            yield
        finally:
            self._workers.discard(worker)
