"""Where evaluations run. Results come back in the order of the jobs."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Protocol, TypeVar

__all__ = ["Executor", "LocalExecutor"]

T = TypeVar("T")


class Executor(Protocol):
    """Runs independent jobs; an exception of a job is raised after all have ended. An interrupt
    is raised at once: whoever gave the jobs ends what they started."""

    def run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        """Results in the order of `jobs`."""
        ...


class LocalExecutor:
    """Jobs on the local cores. Threads suffice: the work is done in sandboxed processes."""

    def __init__(self, workers: int | None = None) -> None:
        self._workers = workers or _cores()

    def run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        """Results in the order of `jobs`."""
        if len(jobs) == 1:
            return [jobs[0]()]
        pool = ThreadPoolExecutor(max_workers=self._workers)
        try:
            futures = [pool.submit(job) for job in jobs]
            wait(futures)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
        return [future.result() for future in futures]


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
