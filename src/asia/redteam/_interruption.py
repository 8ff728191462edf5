"""To end early what runs in other threads."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager

from asia.sandbox import Worker


class Interruption:
    """Whether all is to end, and the workers that are ended with it."""

    def __init__(self) -> None:
        self.begun = False
        self._workers: set[Worker] = set()

    def begin(self) -> None:
        """End the workers that work, and those that are about to."""
        self.begun = True
        for worker in list(self._workers):
            worker.abort()

    @contextmanager
    def ends(self, worker: Worker) -> Generator[None]:
        """The worker is one of them while this is open."""
        self._workers.add(worker)
        try:
            if self.begun:
                worker.abort()
            yield
        finally:
            self._workers.discard(worker)
