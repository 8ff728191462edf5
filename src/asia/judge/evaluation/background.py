"""Run evaluations in background threads, with a cancel flag."""

import threading
import time
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from asia._timer import ActivityTimer, Lane
from asia.errors import SandboxError

T = TypeVar("T")


class CancelFlag:
    """Ends the fits that are under way with it, and lets none begin any more. Results that are
    there already stay."""

    def __init__(self) -> None:
        self.cancelled = False
        self._lock = threading.Lock()
        self._callbacks: list[Callable[[], None]] = []

    @contextmanager
    def on_cancel(self, callback: Callable[[], None]) -> Generator[None]:
        """Call `callback` if `cancel` is called while this is open. Raises SandboxError if it was
        called before."""
        with self._lock:
            if self.cancelled:
                raise SandboxError("the result of this fit is not wanted any more")
            self._callbacks.append(callback)
        try:
            yield
        finally:
            # Wait for a running cancellation: its worker still exists.
            with self._lock:
                self._callbacks.remove(callback)

    def cancel(self) -> None:
        """End the fits from another thread. May be called again."""
        with self._lock:
            self.cancelled = True
            for callback in self._callbacks:
                callback()


@dataclass(frozen=True)
class JobSettings:
    """Settings for the jobs of one thread of the search."""

    cancel: CancelFlag = field(default_factory=CancelFlag)
    on_begin: Callable[[], None] = lambda: None
    """Called as each of them begins."""
    standby: bool = True
    """Whether they may use workers that started before them, beside other fits."""


class BackgroundJob(Generic[T]):
    """A job that gives others to the executor, in a thread of its own."""

    def __init__(
        self,
        cancel: CancelFlag,
        watch: ActivityTimer,
        thread: ThreadPoolExecutor,
        job: Callable[[], T],
    ) -> None:
        """cancel: ends the jobs that it gives to the executor."""
        self._cancel, self._watch = cancel, watch

        def run() -> tuple[T, Lane]:
            with watch.aside() as lane:
                return job(), lane

        self._future: Future[tuple[T, Lane]] = thread.submit(run)

    def result(self) -> T:
        """Wait for the result of the job, and return it; raise the exception of the job."""
        begin = time.monotonic()
        found, lane = self._future.result()
        self._watch.waited(lane, time.monotonic() - begin)
        return found

    def cancel(self) -> None:
        """End the running work; its result is not needed."""
        self._cancel.cancel()
