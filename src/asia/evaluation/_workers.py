"""Workers of one search: opened, kept ready, tried once more, and ended with it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

from asia._stopwatch import Activity, Stopwatch
from asia.errors import CandidateError, Reason, SandboxError, UserError
from asia.executor import Executor, carrier_of
from asia.sandbox import Isolation, Limits, ReadyWorkers, Worker, WorkerKilledError, open_worker

T = TypeVar("T")

_MOST_LEFT_BEHIND = 3


class WorkerRunner:
    """Runs jobs that open sandboxed workers."""

    def __init__(
        self, isolation: Isolation, limits: Limits, executor: Executor, most_ready: int
    ) -> None:
        """most_ready: how many workers are started before they are needed."""
        self.isolation = isolation
        self._limits = limits
        self._executor = executor
        self._most_ready = most_ready
        # Processes that the kernel does not let die, by pid: they keep their core and memory.
        self.left_behind: list[int] = []
        self._open: set[Worker] = set()
        self._interrupted = self._aborted = False
        self._runs, self._counting = 0, threading.Lock()
        self._ready: ReadyWorkers | None = None
        self.stopwatch = Stopwatch()

    @contextmanager
    def ready_workers(self) -> Generator[None]:
        """Start workers before they are needed, until this is closed."""
        with ReadyWorkers(self.isolation, self._limits, self._most_ready) as self._ready:
            try:
                yield
            finally:
                self._ready = None

    def _run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        """Results of the jobs; one whose worker fails for no fault of the candidate is tried once
        more. Raises CandidateError when somebody ended the worker both times. Several threads may
        run jobs; workers still open when the last of them ends are those of an interrupted run."""
        with self._counting:
            self._runs += 1
        try:
            tries = [partial(self._with_one_retry, job) for job in jobs]
            return self.stopwatch.run(self._executor.run, tries)
        except BaseException as error:
            if not isinstance(error, Exception):
                self._cancel_elsewhere()
            raise
        finally:
            with self._counting:
                self._runs -= 1
                last = self._runs == 0
            if last:
                self._interrupted = self._aborted or bool(self._open)
                self._abort_open()

    def abort(self) -> None:
        """End all workers, for good, from another thread than those that run jobs: these end with
        an error."""
        self._interrupted = self._aborted = True
        self._cancel_elsewhere()
        self._abort_open()

    def _cancel_elsewhere(self) -> None:
        carrier = carrier_of(self._executor)
        if carrier is not None:
            carrier.cancel()

    def _abort_open(self) -> None:
        for worker in list(self._open):
            worker.abort()

    def _with_one_retry(self, job: Callable[[], T]) -> T:
        try:
            return job()
        except SandboxError:
            if self._interrupted:
                raise
        try:
            return job()
        except WorkerKilledError as error:
            if self._interrupted:
                raise
            raise CandidateError(
                Reason.MEMORY, f"{error}, twice, as a machine does whose memory has run out"
            ) from None

    @contextmanager
    def _worker(self, libraries: frozenset[str] = frozenset()) -> Generator[Worker]:
        if len(self.left_behind) >= _MOST_LEFT_BEHIND:
            pids = ", ".join(str(pid) for pid in self.left_behind)
            raise UserError(
                f"worker processes {pids} cannot be ended: restart the machine, and give the same "
                "command again, which goes on from here"
            )
        with self.stopwatch.activity(Activity.START):
            ready = self._ready
            waiting = ready.take(libraries) if ready else None
            worker = waiting or open_worker(self.isolation, self._limits)
        try:
            with worker:
                self._open.add(worker)
                try:
                    if self._interrupted:
                        raise SandboxError("the search was interrupted")
                    yield worker
                    worker.count_compiling()
                finally:
                    self._open.discard(worker)
        finally:
            for activity, (wall, processor) in worker.spent.items():
                self.stopwatch.add(activity, wall, processor)
            if worker.left_behind is not None:
                self.left_behind.append(worker.left_behind)
