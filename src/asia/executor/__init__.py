"""Where evaluations run. Results come back in the order of the jobs."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol, TypeVar

__all__ = ["Executor", "LocalExecutor"]

T = TypeVar("T")


class Executor(Protocol):
    """Runs independent jobs; an exception of a job is raised after all have ended."""

    def run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        """Results in the order of `jobs`."""
        ...


class LocalExecutor:
    """Jobs on the local cores. Threads suffice: the work is done in sandboxed processes."""

    def __init__(self, workers: int | None = None) -> None:
        self._workers = workers or len(os.sched_getaffinity(0))

    def run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        """Results in the order of `jobs`."""
        if len(jobs) == 1:
            return [jobs[0]()]
        with ThreadPoolExecutor(max_workers=self._workers) as pool:
            futures = [pool.submit(job) for job in jobs]
        return [future.result() for future in futures]
