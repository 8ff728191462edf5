"""Fits whose result is not wanted any more, ended from another thread."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager

from asia.errors import SandboxError


class FitStop:
    """Ends the fits that are under way with it, and lets none begin any more. Results that are
    there already stay."""

    def __init__(self) -> None:
        self.stopped = False
        self._lock = threading.Lock()
        self._ends: list[Callable[[], None]] = []

    @contextmanager
    def ending(self, end: Callable[[], None]) -> Generator[None]:
        """Call `end` if the stop comes while this is open. Raises SandboxError where it has come
        already."""
        with self._lock:
            if self.stopped:
                raise SandboxError("the result of this fit is not wanted any more")
            self._ends.append(end)
        try:
            yield
        finally:
            # Waits for a stop under way: what it ends is still there.
            with self._lock:
                self._ends.remove(end)

    def stop(self) -> None:
        """May be called again."""
        with self._lock:
            self.stopped = True
            for end in self._ends:
                end()
