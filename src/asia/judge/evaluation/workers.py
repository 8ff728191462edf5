"""Workers and background evaluations of one search: priorities, standby workers, cancellation."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from typing import TypeVar

from asia._timer import Activity, ActivityTimer
from asia.candidate import imported_libraries, trains_network
from asia.errors import CandidateError, Reason, SandboxError, UserError
from asia.judge.evaluation.background import BackgroundJob, CancelFlag, JobSettings
from asia.judge.executors import Executor, SequentialExecutor, local_cores, remote_executor_of
from asia.judge.sandbox.availability import open_worker
from asia.judge.sandbox.standby import StandbyWorkers
from asia.judge.sandbox.types import Isolation, Limits, WorkerKilledError
from asia.judge.sandbox.worker.worker import Worker

T = TypeVar("T")

_MOST_LEFT_BEHIND = 3


class WorkerRunner:
    """Runs jobs that open sandboxed workers."""

    def __init__(
        self,
        isolation: Isolation,
        limits: Limits,
        executor: Executor,
        most_ready: int,
        *,
        gpu: bool = False,
    ) -> None:
        """most_ready: how many workers are started before they are needed; gpu: whether those that
        train networks compute on the GPU."""
        self.isolation = isolation
        self._gpu = gpu
        self._limits = limits
        self._executor = executor
        self._most_ready = most_ready
        # Processes that the kernel does not let die, by pid: they keep their core and memory.
        self.left_behind: list[int] = []
        self._open: set[Worker] = set()
        self._interrupted = self._aborted = False
        self._runs, self._counting = 0, threading.Lock()
        self._ready: StandbyWorkers | None = None
        self._here = threading.local()
        # With remote folds the executor does not limit the remaining local work.
        remote = remote_executor_of(executor) is not None
        self._own = threading.BoundedSemaphore(local_cores()) if remote else nullcontext()
        self.stopwatch = ActivityTimer()

    @property
    def settings(self) -> JobSettings:
        """Settings of the jobs that this thread gives."""
        found: JobSettings | None = getattr(self._here, "settings", None)
        return JobSettings() if found is None else found

    @contextmanager
    def with_settings(self, settings: JobSettings) -> Generator[None]:
        """Use these settings in this thread until this is closed."""
        before = self.settings
        self._here.settings = settings
        try:
            yield
        finally:
            self._here.settings = before

    def cancellable(self, cancel: CancelFlag, job: Callable[[], T]) -> T:
        """Do a job whose workers `cancel` ends."""
        with self.with_settings(replace(self.settings, cancel=cancel)):
            return job()

    @contextmanager
    def ready_workers(self, at_once: int = 1) -> Generator[None]:
        """Start workers before they are needed, until this is closed.

        Args:
            at_once: experiments in flight
        """
        most = self._most_ready * at_once
        with StandbyWorkers(self.isolation, self._limits, most) as self._ready:
            try:
                yield
            finally:
                self._ready = None

    @property
    def is_sequential(self) -> bool:
        """Whether no two workers may run at once."""
        return isinstance(self._executor, SequentialExecutor)

    @contextmanager
    def background(
        self, job: Callable[[], T], settings: JobSettings | None = None
    ) -> Generator[BackgroundJob[T]]:
        """Run `job` in a background thread; it is cancelled when this is closed, unless it has
        ended. Not where no two workers may run at once."""
        chosen = settings or JobSettings()

        def with_settings() -> T:
            with self.with_settings(chosen):
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

    def _run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        """Run the jobs and return their results; a job whose worker fails through no fault of the
        candidate is tried once more.

        Several threads may run jobs; workers still open when the last of them ends belong to an
        interrupted run.

        Raises:
            CandidateError: when another process ended the worker both times
        """
        settings = self.settings

        def with_settings(job: Callable[[], T]) -> T:
            settings.on_begin()
            with self.with_settings(settings):
                return self._with_one_retry(job)

        with self._counting:
            self._runs += 1
        try:
            return self.stopwatch.run(
                self._executor.run, [partial(with_settings, job) for job in jobs]
            )
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
        carrier = remote_executor_of(self._executor)
        if carrier is not None:
            carrier.cancel()

    def _abort_open(self) -> None:
        for worker in list(self._open):
            worker.abort()

    def _with_one_retry(self, job: Callable[[], T]) -> T:
        cancel = self.settings.cancel
        try:
            return job()
        except SandboxError:
            if self._interrupted or cancel.cancelled:
                raise
        try:
            return job()
        except WorkerKilledError as error:
            if self._interrupted or cancel.cancelled:
                raise
            raise CandidateError(
                Reason.MEMORY, f"{error}, twice, as a machine does whose memory has run out"
            ) from None

    def limits_for(self, source: str) -> Limits:
        """Those of workers that run a candidate."""
        return replace(self._limits, gpu=True) if self.on_gpu(source) else self._limits

    def on_gpu(self, source: str) -> bool:
        """Return whether workers that run a candidate compute on the GPU."""
        return self._gpu and trains_network(source)

    def _worker_for(self, source: str, *, fitting: bool) -> AbstractContextManager[Worker]:
        return self._worker(imported_libraries(source, fitting=fitting), self.limits_for(source))

    @contextmanager
    def _worker(self, libraries: frozenset[str], limits: Limits) -> Generator[Worker]:
        if len(self.left_behind) >= _MOST_LEFT_BEHIND:
            pids = ", ".join(str(pid) for pid in self.left_behind)
            raise UserError(
                f"worker processes {pids} cannot be ended: restart the machine, and give the same "
                "command again, which goes on from here"
            )
        cancel = self.settings.cancel
        if cancel.cancelled:
            raise SandboxError("the result of this fit is not wanted any more")
        with self._own:
            yield from self._opened(libraries, limits, cancel)

    def _opened(
        self, libraries: frozenset[str], limits: Limits, cancel: CancelFlag
    ) -> Generator[Worker]:
        with self.stopwatch.activity(Activity.START):
            ready = self._ready if limits == self._limits else None
            waiting = ready.take(libraries) if ready else None
            worker = waiting or open_worker(self.isolation, limits)
        try:
            with worker:
                self._open.add(worker)
                try:
                    if self._interrupted:
                        raise SandboxError("the search was interrupted")
                    with cancel.on_cancel(worker.abort):
                        yield worker
                    worker.count_compiling()
                finally:
                    self._open.discard(worker)
        finally:
            for activity, (wall, processor) in worker.spent.items():
                self.stopwatch.add(activity, wall, processor)
            if worker.left_behind is not None:
                self.left_behind.append(worker.left_behind)
