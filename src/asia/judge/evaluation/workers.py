"""Workers and background evaluations of one search: priorities, standby workers, cancellation."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Generic, TypeAlias, TypeVar

from asia._timer import Activity, ActivityTimer, Lane
from asia.candidate import imported_libraries, library_only
from asia.errors import CandidateError, Reason, SandboxError, UserError
from asia.judge.executors import Executor, SequentialExecutor, local_cores, remote_executor_of
from asia.judge.sandbox.availability import open_worker
from asia.judge.sandbox.standby import StandbyWorkers
from asia.judge.sandbox.types import Isolation, Limits, WorkerKilledError
from asia.judge.sandbox.worker.closed_loop import ClosedLoop
from asia.judge.sandbox.worker.worker import Worker
from asia.problem.budget import Budget

T = TypeVar("T")

_MOST_LEFT_BEHIND = 3

OnLoss: TypeAlias = Callable[[str, int, float, float], None]
"""Called with the source of a candidate, the number of the fold, a step and its loss."""


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


class WorkerRunner:
    """Runs jobs that open sandboxed workers."""

    def __init__(
        self,
        isolation: Isolation,
        budget: Budget,
        executor: Executor,
        *,
        standby: int = 1,
    ) -> None:
        """standby: how many workers are started before they are needed."""
        self.isolation = isolation
        self.fit_seconds = budget.fit_seconds
        self.remote = remote_executor_of(executor)
        self.is_sequential = isinstance(executor, SequentialExecutor)
        """Whether no two workers may run at once."""
        self.stopwatch = ActivityTimer()
        # Processes that the kernel does not let die, by pid: they keep their core and memory.
        self.left_behind: list[int] = []
        self.closed_loop: ClosedLoop | None = None
        """Loop in which candidates are simulated; None where they are models."""
        self.on_loss: OnLoss | None = None
        """Called from any thread while folds are fitted on this machine."""
        self.limits = Limits(budget.fit_seconds, budget.fit_seconds, budget.memory_mb)
        self._executor = executor
        self._standby = standby
        self._open: set[Worker] = set()
        self._interrupted = self._aborted = False
        self._runs, self._counting = 0, threading.Lock()
        self._ready: StandbyWorkers | None = None
        self._here = threading.local()
        # With remote folds the executor does not limit the remaining local work.
        self._own = threading.BoundedSemaphore(local_cores()) if self.remote else nullcontext()

    @property
    def settings(self) -> JobSettings:
        """Settings of the jobs that this thread gives."""
        return getattr(self._here, "settings", None) or JobSettings()

    @contextmanager
    def _with_settings(self, settings: JobSettings) -> Generator[None]:
        before = self.settings
        self._here.settings = settings
        try:
            yield
        finally:
            self._here.settings = before

    @contextmanager
    def fresh_workers(self) -> Generator[None]:
        """Start each worker of this thread's jobs when it is needed, and not beside an earlier fit,
        which could slow down its start."""
        with self._with_settings(replace(self.settings, standby=False)):
            yield

    @contextmanager
    def ready_workers(self, at_once: int = 1) -> Generator[None]:
        """Start workers before they are needed, until this is closed.

        Args:
            at_once: experiments in flight
        """
        most = self._standby * at_once
        with StandbyWorkers(self.isolation, self.limits, most) as self._ready:
            try:
                yield
            finally:
                self._ready = None

    @contextmanager
    def background(
        self, job: Callable[[], T], settings: JobSettings | None = None
    ) -> Generator[BackgroundJob[T]]:
        """Run `job` in a background thread; it is cancelled when this is closed, unless it has
        ended. Not where no two workers may run at once."""
        chosen = settings or JobSettings()

        def with_settings() -> T:
            with self._with_settings(chosen):
                return job()

        thread = ThreadPoolExecutor(1, "background")
        one = BackgroundJob(chosen.cancel, self.stopwatch, thread, with_settings)
        try:
            yield one
        except BaseException as error:
            if not isinstance(error, Exception):
                self.abort()
            raise
        finally:
            one.cancel()
            thread.shutdown(wait=False)

    def run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        """Run the jobs and return their results; a job whose worker fails through no fault of the
        candidate is tried once more.

        Several threads may run jobs; workers still open when the last of them ends belong to an
        interrupted run.

        Raises:
            CandidateError: when another process ended the worker both times
        """
        settings = self.settings

        def with_one_retry(job: Callable[[], T]) -> T:
            settings.on_begin()
            with self._with_settings(settings):
                try:
                    return job()
                except SandboxError:
                    if self._interrupted or settings.cancel.cancelled:
                        raise
                try:
                    return job()
                except WorkerKilledError as error:
                    if self._interrupted or settings.cancel.cancelled:
                        raise
                    raise CandidateError(
                        Reason.MEMORY,
                        f"{error}, twice, as a machine does whose memory has run out",
                    ) from None

        with self._counting:
            self._runs += 1
        try:
            return self.stopwatch.run(
                self._executor.run, [partial(with_one_retry, job) for job in jobs]
            )
        except BaseException as error:
            if self.remote is not None and not isinstance(error, Exception):
                self.remote.cancel()
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
        if self.remote is not None:
            self.remote.cancel()
        self._abort_open()

    def _abort_open(self) -> None:
        for worker in list(self._open):
            worker.abort()

    @contextmanager
    def open_for(self, source: str, *, fitting: bool, plant: bool = False) -> Generator[Worker]:
        """Open a worker for a candidate, to fit it or to load its models: a standby one where one
        fits, which waits again afterwards where the candidate calls the library alone. `abort` and
        the cancel flag end it.

        Args:
            plant: whether it is for the plant of the closed loop
        """
        if len(self.left_behind) >= _MOST_LEFT_BEHIND:
            pids = ", ".join(str(pid) for pid in self.left_behind)
            raise UserError(
                f"worker processes {pids} cannot be ended: restart the machine, and give the same "
                "command again, which goes on from here"
            )
        cancel = self.settings.cancel
        if cancel.cancelled:
            raise SandboxError("the result of this fit is not wanted any more")
        libraries = imported_libraries(source, fitting=fitting)
        ready = self._ready if self.settings.standby else None
        trusted = ready is not None and library_only(source)
        with self._own:
            with self.stopwatch.activity(Activity.START):
                waiting = ready.take(libraries, library_only=trusted) if ready else None
                worker = waiting or open_worker(self.isolation, self.limits)
            again = False
            try:
                self._open.add(worker)
                try:
                    if self._interrupted:
                        raise SandboxError("the search was interrupted")
                    worker.closed_loop = None if plant else self.closed_loop
                    with cancel.on_cancel(worker.abort):
                        yield worker
                    worker.count_compiling()
                    again = trusted and waiting is not None
                finally:
                    self._open.discard(worker)
            finally:
                if not again:
                    worker.close()
                for activity, (wall, processor) in worker.spent.items():
                    self.stopwatch.add(activity, wall, processor)
                if not (again and ready and worker.renew() and ready.give_back(worker, libraries)):
                    worker.close()
                if worker.left_behind is not None:
                    self.left_behind.append(worker.left_behind)
