"""Fits of folds on other machines: requests and answers as bytes.

A request is made by the search and may be unpickled there. An answer holds data made by a
candidate: it is JSON and raw numbers, which the search checks against its request.
"""

from __future__ import annotations

import hashlib
import json
import math
import pickle
import socket
import threading
from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any, TypeAlias

import numpy as np

from asia._timer import Activity, Seconds
from asia.candidate import Context, imported_libraries
from asia.data.trajectory import Array
from asia.errors import CandidateError, Reason, SandboxError, UserError
from asia.judge.evaluation.fold_fits import FoldData, FoldFit, FoldFitter, fit_fold
from asia.judge.evaluation.machines import check_installation, installation
from asia.judge.evaluation.relations import SuspicionKind
from asia.judge.evaluation.validation_score import Oracle
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import RemoteExecutor
from asia.judge.sandbox.availability import layers_in_force, open_worker, why_not
from asia.judge.sandbox.standby import StandbyWorkers
from asia.judge.sandbox.types import Isolation, Limits, WorkerKilledError
from asia.judge.sandbox.worker.worker import Worker
from asia.problem.folds import Fold, whole
from asia.problem.protocol import ProtocolRule

_LOOK_SECONDS = 0.5
_KEPT_SECONDS = 60.0
_HEAD_BYTES = 8

Blob: TypeAlias = bytes | memoryview
"""Raw bytes of a message."""
FoldAttempt: TypeAlias = FoldFit[bytes] | CandidateError
"""A fitted fold, or why there is none."""


@dataclass(frozen=True)
class FoldWork:
    """Work on a fold: everything that its outcome depends on, besides the data that it names."""

    problem: str
    """sha256 of the run's lock file; "" for an evaluation outside a run."""
    data: str
    """sha256 of the `FoldData` as bytes."""
    source: str = field(repr=False)
    context: Context = field(repr=False)
    """Context of the candidate, with its seed. The deadline is set on the machine that fits."""
    limits: Limits
    isolation: Isolation
    """The level that must keep the candidate in."""
    layers: tuple[str, ...]
    """The layers of this level that must be in force."""
    alone: bool = False
    """Whether no worker may be started while it runs, since it could tell that one something."""


def encode_data(data: FoldData) -> tuple[str, bytes]:
    """Digest and bytes."""
    raw = pickle.dumps(data, protocol=5)
    return hashlib.sha256(raw).hexdigest(), raw


def decode_data(raw: bytes, digest: str) -> FoldData:
    """The data of a search of our own. Raises SandboxError where they are not those."""
    if hashlib.sha256(raw).hexdigest() != digest:
        raise SandboxError("the data of a fold came as other bytes than the search sent")
    return pickle.loads(raw)


def encode_work(work: FoldWork, installation: Mapping[str, str]) -> bytes:
    """installation: of the search's own machine, compared before anything else is read."""
    body = pickle.dumps(work, protocol=5)
    return _packed({"installation": dict(installation)}, [body])


def installation_of(request: bytes) -> dict[str, str]:
    """That of the machine that sent the request."""
    return _unpacked(request)[0]["installation"]


def decode_work(request: bytes) -> FoldWork:
    """The work in a request of our own search."""
    return pickle.loads(_unpacked(request)[1][0])


def encode_answer(result: FoldAttempt, spent: Seconds) -> bytes:
    """Encode the texts of a candidate as JSON strings, its arrays as raw float64."""
    head: dict[str, Any] = {
        "printed": result.printed,
        "spent": {activity.value: seconds for activity, seconds in spent.items()},
    }
    if isinstance(result, CandidateError):
        return _packed({**head, "reason": result.reason.value, "detail": result.detail}, [])
    head |= {
        "machine": result.machine,
        "isolation": result.isolation,
        "seconds": result.seconds,
        "parameters": result.parameters,
        "memory_mb": result.memory_mb,
        "compile_seconds": result.compile_seconds,
        "numbers": result.numbers,
        "simulate_seconds": result.simulate_seconds,
        "train": len(result.train_y_hat),
    }
    raw = (
        np.ascontiguousarray(array, "<f8").reshape(-1).view(np.uint8).data
        for array in (result.curve, *result.y_hat, *result.train_y_hat)
    )
    return _packed(head, [result.model, *raw])


_TROUBLES: dict[str, type[SandboxError | UserError]] = {
    "user": UserError,
    "killed": WorkerKilledError,
    "sandbox": SandboxError,
}


def encode_trouble(error: SandboxError | UserError) -> bytes:
    """Encode an error in place of an answer: a worker that was killed, or a machine that cannot do
    the work."""
    kind = next(kind for kind, error_type in _TROUBLES.items() if isinstance(error, error_type))
    return _packed({"trouble": kind, "words": str(error)}, [])


def decode_answer(
    reply: bytes, data: FoldData, train: Sequence[tuple[int, int]]
) -> tuple[FoldAttempt, Seconds]:
    """Decode the answer to work on `data`: the fitted fold, and the time that it took.

    Args:
        train: (H, ny) of the blocks of its training records

    Raises:
        SandboxError: for an invalid answer
        UserError: as given to `encode_trouble`
    """
    try:
        head, blobs = _unpacked(reply)
        if "trouble" in head:
            raise _TROUBLES.get(head["trouble"], SandboxError)(str(head["words"]))
        return _answer(head, blobs, data, train)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise SandboxError(f"a worker machine answered what is no answer: {error}") from None


def _answer(
    head: dict[str, Any], blobs: Sequence[bytes], data: FoldData, train: Sequence[tuple[int, int]]
) -> tuple[FoldAttempt, Seconds]:
    result: FoldAttempt
    printed = str(head["printed"])
    if "reason" in head:
        result = CandidateError(Reason(head["reason"]), str(head["detail"]), printed)
    else:
        held_out = [one.y.shape for one in data.held_out]
        shapes = [*held_out, *train]
        if head["train"] != len(train) or len(blobs) != 2 + len(shapes):
            raise ValueError("another number of simulations")
        y_hat = [_floats(raw, shape) for raw, shape in zip(blobs[2:], shapes, strict=True)]
        curve = _floats(blobs[1], (len(blobs[1]) // 16, 2))
        memory = head["memory_mb"]
        result = FoldFit(
            model=bytes(blobs[0]),
            curve=curve,
            printed=printed,
            seconds=float(head["seconds"]),
            parameters=tuple((str(name), float(value)) for name, value in head["parameters"]),
            y_hat=tuple(y_hat[: len(held_out)]),
            train_y_hat=tuple(y_hat[len(held_out) :]),
            memory_mb=None if memory is None else float(memory),
            compile_seconds=float(head["compile_seconds"]),
            numbers=None if head["numbers"] is None else int(head["numbers"]),
            simulate_seconds=float(head["simulate_seconds"]),
            machine=str(head["machine"]),
            isolation=str(head["isolation"]),
        )
    spent = {Activity(k): (float(a), float(b)) for k, (a, b) in head["spent"].items()}
    return result, spent


def _floats(raw: bytes, shape: tuple[int, int]) -> Array:
    if len(raw) != 8 * math.prod(shape):
        raise ValueError(f"{len(raw)} bytes for an array {shape}")
    return np.frombuffer(raw, "<f8").astype(np.float64).reshape(shape)


def _packed(head: dict[str, Any], blobs: Sequence[Blob]) -> bytes:
    text = json.dumps({**head, "lengths": [len(blob) for blob in blobs]}).encode()
    return b"".join((len(text).to_bytes(_HEAD_BYTES, "little"), text, *blobs))


def _unpacked(raw: bytes) -> tuple[dict[str, Any], list[bytes]]:
    end = _HEAD_BYTES + int.from_bytes(raw[:_HEAD_BYTES], "little")
    head: dict[str, Any] = json.loads(raw[_HEAD_BYTES:end])
    blobs: list[bytes] = []
    for length in head["lengths"]:
        blobs.append(raw[end : end + length])
        end += length
    if end != len(raw):
        raise ValueError("its parts have other lengths")
    return head, blobs


# On a worker machine.


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
            found = fit_fold(
                work.source, work.context, decode_data(data, work.data), opened,
                work.limits.fit_seconds,
            )  # fmt: skip
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


# On the machine of the search.


class RemoteFoldFitter(FoldFitter):
    """Fits the folds of one search on other machines."""

    def __init__(
        self,
        rule: ProtocolRule,
        context: Context,
        workers: WorkerRunner,
        carrier: RemoteExecutor,
        problem: str,
        without: Collection[SuspicionKind] = (),
    ) -> None:
        """Prepare the folds of a search.

        Args:
            carrier: brings the work to the machines
            problem: sha256 of the run's lock file

        Raises:
            UserError: where candidates may ask for their score, which takes the held-out outputs to
                the machine that fits
        """
        if rule.early_stopping != "inner":
            raise UserError(
                "validation early stopping needs the held-out outputs where a candidate is fitted, "
                "and other machines do not get them: use --executor local"
            )
        super().__init__(rule, context, workers, without)
        self._carrier, self._problem = carrier, problem
        self._sent: dict[int, tuple[str, bytes]] = {}

    def _fit(
        self, source: str, context: Context, fold: Fold, oracle: Oracle | None
    ) -> FoldFit[bytes]:
        """As on this machine; raises also UserError where a machine is not fit for the work."""
        del oracle
        workers, carrier, data = self._workers, self._carrier, self._data[fold.index]
        if fold.index not in self._sent:
            self._sent[fold.index] = encode_data(data)
        digest, raw = self._sent[fold.index]
        work = FoldWork(
            problem=self._problem,
            data=digest,
            source=source,
            context=context,
            limits=workers.limits,
            isolation=workers.isolation,
            layers=tuple(layer.value for layer in layers_in_force(workers.isolation)),
            alone=workers.is_sequential,
        )
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
