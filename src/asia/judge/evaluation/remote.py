"""Fits of folds, here or on other machines: requests and replies as bytes."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Collection, Generator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from functools import cache, partial
from itertools import chain
from typing import Protocol

import numpy as np

from asia._timer import Activity
from asia.candidate import Context, imported_libraries
from asia.errors import CandidateError, SandboxError, UserError
from asia.judge.evaluation.findings import FoldFit
from asia.judge.evaluation.machines import check_installation, installation
from asia.judge.evaluation.relations import SuspicionKind
from asia.judge.evaluation.requests import side_by_side, simulate_each, simulate_training
from asia.judge.evaluation.results import derive_seed
from asia.judge.evaluation.transport import (
    FoldAttempt,
    FoldData,
    FoldWork,
    decode_answer,
    decode_data,
    decode_work,
    encode_answer,
    encode_data,
    encode_trouble,
    encode_work,
    fold_data,
    installation_of,
)
from asia.judge.evaluation.validation_score import Oracle
from asia.judge.evaluation.workers import OnLoss, WorkerRunner
from asia.judge.sandbox.availability import layers_in_force, open_worker, why_not
from asia.judge.sandbox.programs import program_store
from asia.judge.sandbox.standby import StandbyWorkers
from asia.judge.sandbox.types import Isolation, Limits
from asia.judge.sandbox.worker.worker import Worker
from asia.problem.folds import Fold, whole
from asia.problem.protocol import ProtocolRule

_LOOK_SECONDS = 0.5
_KEPT_SECONDS = 60.0
# Processor time of a simulation of the training records from which on it is not repeated.
_SLOW_SECONDS = 2.0


class OpenWorker(Protocol):
    """Opener of workers for a candidate."""

    def __call__(self, source: str, *, fitting: bool) -> AbstractContextManager[Worker]:
        """Open one, to fit it or to load its models."""
        ...


def fit_fold(
    work: FoldWork,
    data: FoldData,
    open_worker: OpenWorker,
    oracle: Oracle | None = None,
    on_loss: OnLoss | None = None,
) -> FoldFit[bytes]:
    """Fit in one worker, which reports its parameters before it receives a case, and simulate there
    and in fresh ones.

    Args:
        oracle: scores the model on the held-out part during the fit, where the protocol allows
            it; it has the held-out outputs, so it exists only on the search's own machine
        on_loss: called while the fit runs

    Raises:
        CandidateError: with what the candidate printed
        SandboxError: for a failure that the candidate did not cause
    """
    printed = ""
    try:
        with open_worker(work.source, fitting=True) as worker:
            context = replace(work.context, deadline=time.monotonic() + work.limits.fit_seconds)
            try:
                with oracle or nullcontext():
                    shown = on_loss and partial(on_loss, work.source, work.fold)
                    curve, _, seconds = worker.fit(
                        work.source, data.train, context, oracle, program_store(), shown
                    )
            finally:
                printed = worker.printed
            parameters, model = worker.parameters(), worker.dump()
            # Before the first case: later a candidate could let held-out values decide on them.
            memory, compiling = worker.peak_memory_mb, worker.compile_seconds()
            numbers = worker.numbers()
            # Before the held-out cases too: the residuals on the training records are reported.
            inside = whole(data.train, data.rule)
            train_y_hat = simulate_training(worker.simulate_known, inside, data.rule.horizon)
            first = simulating = worker.spent[Activity.SIMULATE][1]
            # The first one also compiles and loads: a second one shows the time of a sample.
            if first < _SLOW_SECONDS:
                simulate_training(worker.simulate_known, inside, data.rule.horizon)
                simulating = worker.spent[Activity.SIMULATE][1] - first
            blocks, (first, *others) = data.held_out, data.sessions
            together = side_by_side(work.source, data.rule)
            found = simulate_each(worker, blocks, first, data.secret, together=together)
        for session in others:
            with open_worker(work.source, fitting=False) as fresh:
                fresh.load(work.source, model, context)
                found |= simulate_each(fresh, blocks, session, data.secret, together=together)
    except CandidateError as error:
        raise CandidateError(error.reason, error.detail, printed) from error
    return FoldFit(
        model=model,
        curve=curve,
        printed=printed,
        seconds=seconds,
        parameters=parameters,
        y_hat=tuple(np.ascontiguousarray(found[i], "<f8") for i in range(len(data.held_out))),
        train_y_hat=tuple(np.ascontiguousarray(one, "<f8") for one in train_y_hat),
        memory_mb=memory,
        compile_seconds=compiling,
        numbers=numbers,
        simulate_seconds=simulating,
    )


class StandbyPool:
    """Workers that a remote machine starts before there is a fold for them.

    One waits for each of the last sets of libraries, as in a search on its own machine. Those of a
    search that has sent nothing for a minute are ended.
    """

    def __init__(self, seconds: float = _KEPT_SECONDS) -> None:
        self._seconds = seconds
        self._lock = threading.Lock()
        self._kept: dict[tuple[Isolation, Limits], StandbyWorkers] = {}
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
                ready = self._kept[key] = StandbyWorkers(isolation, limits, 1)
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
def standby_pool() -> StandbyPool:
    """The pool of this process, which fits folds for remote searches."""
    return StandbyPool()


def answer(request: bytes, data: bytes, unwanted: Callable[[], bool] = lambda: False) -> bytes:
    """Answer a request on a worker machine.

    Args:
        data: the bytes that the request names
        unwanted: polled; once it is True the worker is ended
    """
    machine = socket.gethostname()
    try:
        check_installation(installation_of(request), machine)
        work = decode_work(request)
        _check_isolation(work.isolation, work.layers, machine)
        spent: list[Worker] = []

        @contextmanager
        def opened(source: str, *, fitting: bool) -> Generator[Worker]:
            with _open(work, imported_libraries(source, fitting=fitting)) as worker:
                spent.append(worker)
                with _watched(worker, unwanted):
                    yield worker
                    worker.count_compiling()

        found: FoldAttempt
        try:
            found = fit_fold(work, decode_data(data, work.data), opened)
            found = replace(found, machine=machine, isolation=work.isolation.value)
        except CandidateError as error:
            found = error
        return encode_answer(found, {k: v for worker in spent for k, v in worker.spent.items()})
    except (SandboxError, UserError) as error:
        return encode_trouble(error)


def _open(work: FoldWork, libraries: frozenset[str]) -> AbstractContextManager[Worker]:
    if work.alone:
        return open_worker(work.isolation, work.limits, libraries=libraries)
    return standby_pool().worker(work.isolation, work.limits, libraries)


@cache
def _check_isolation(isolation: Isolation, layers: tuple[str, ...], machine: str) -> None:
    reason = why_not(isolation)
    if reason is None:
        lost = sorted({*layers} - {layer.value for layer in layers_in_force(isolation)})
        reason = f"it lacks {', '.join(lost)}" if lost else None
    if reason is not None:
        raise UserError(
            f"worker machine {machine} cannot isolate candidates as the search does "
            f"({isolation.value}): {reason}. Run asia doctor on that machine, or begin the "
            "search with an --isolation that all machines have"
        )


@contextmanager
def _watched(worker: Worker, unwanted: Callable[[], bool]) -> Generator[None]:
    over = threading.Event()

    def look() -> None:
        while not over.wait(_LOOK_SECONDS):
            if unwanted():
                worker.abort()
                return

    watch = threading.Thread(target=look, daemon=True)
    watch.start()
    try:
        yield
    finally:
        over.set()
        watch.join()


class FoldFitter:
    """Fits the folds of one search on this machine or on remote ones."""

    def __init__(
        self,
        rule: ProtocolRule,
        context: Context,
        workers: WorkerRunner,
        problem: str,
        without: Collection[SuspicionKind] = (),
    ) -> None:
        """Prepare the folds of a search.

        Args:
            rule: protocol of the problem
            context: part of the context that is the same for all folds
            workers: runs the fits
            problem: sha256 of the run's lock file
            without: as in `EvaluatorOptions`

        Raises:
            UserError: where folds are fitted on other machines and candidates may ask for their
                score, which takes the held-out outputs to the machine that fits
        """
        if workers.remote is not None and rule.early_stopping != "inner":
            raise UserError(
                "validation early stopping needs the held-out outputs where a candidate is fitted, "
                "and other machines do not get them: use --executor local"
            )
        self._rule, self._context = rule, context
        self._workers, self._problem, self._without = workers, problem, without
        self._data: dict[int, tuple[FoldData, str, bytes]] = {}

    def fit(self, source: str, fold: Fold, start: int, oracle: Oracle | None) -> FoldFit[bytes]:
        """Fit `source` on a fold; start: another one has another seed. The cancel flag of this
        thread ends it on a remote machine too. Raises CandidateError and SandboxError, and
        UserError where a machine is not fit for the work."""
        workers, carrier = self._workers, self._workers.remote
        if fold.index not in self._data:
            data = fold_data(fold, self._rule)
            if SuspicionKind.LOOK_AHEAD in self._without:
                data = replace(data, secret=None)
            if SuspicionKind.STRANGERS in self._without:
                data = replace(data, sessions=(tuple(chain(*data.sessions)),))
            digest, raw = ("", b"") if carrier is None else encode_data(data)
            self._data[fold.index] = data, digest, raw
        data, digest, raw = self._data[fold.index]
        work = FoldWork(
            problem=self._problem,
            data=digest,
            fold=fold.index + 1,
            source=source,
            context=replace(self._context, seed=derive_seed(self._context.seed, fold.index, start)),
            limits=workers.limits,
            isolation=workers.isolation,
            layers=tuple(layer.value for layer in layers_in_force(workers.isolation)),
            alone=workers.is_sequential,
        )
        if carrier is None:
            return fit_fold(work, data, workers.open_for, oracle, workers.on_loss)
        request = encode_work(work, installation())
        with workers.settings.cancel.on_cancel(partial(carrier.forget, request)):
            reply = carrier.carry(answer, request, digest, raw)
        train = [(b.y.shape[0], b.y.shape[1]) for b in whole(fold.train, self._rule)]
        found, spent = decode_answer(reply, data, train)
        for activity, (wall, processor) in spent.items():
            workers.stopwatch.add(activity, wall, processor)
        if isinstance(found, CandidateError):
            raise found
        return found
