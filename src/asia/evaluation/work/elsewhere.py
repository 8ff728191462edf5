"""The same work on another machine: bytes in, bytes out."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import cache

from asia.errors import SandboxError, UserError
from asia.evaluation.work.fit import fit_fold
from asia.evaluation.work.installation import check_installation
from asia.evaluation.work.message import (
    FoldWork,
    decode_data,
    decode_work,
    encode_answer,
    encode_trouble,
    installation_of,
)
from asia.evaluation.work.spares import spare_workers
from asia.sandbox import Isolation, Limits, Worker, layers_in_force, open_worker, why_not

_LOOK_SECONDS = 0.5


def answer(request: bytes, data: bytes, unwanted: Callable[[], bool] = lambda: False) -> bytes:
    """The answer to a request. data: the bytes that it names. unwanted: asked all the time whether
    nobody waits for the answer any more; then the worker is ended."""
    machine = socket.gethostname()
    try:
        check_installation(installation_of(request), machine)
        work = decode_work(request)
        _check_isolation(work.isolation, work.layers, machine)
        spent: list[Worker] = []

        @contextmanager
        def opened(libraries: frozenset[str], limits: Limits) -> Generator[Worker]:
            with _open(work, libraries, limits) as worker:
                spent.append(worker)
                with _watched(worker, unwanted):
                    yield worker
                    worker.count_compiling()

        found = fit_fold(work, decode_data(data, work.data), opened)
        seconds = {k: v for worker in spent for k, v in worker.spent.items()}
        level = work.isolation.value
        return encode_answer(replace(found, machine=machine, isolation=level, spent=seconds))
    except (SandboxError, UserError) as error:
        return encode_trouble(error)


def _open(
    work: FoldWork, libraries: frozenset[str], limits: Limits
) -> AbstractContextManager[Worker]:
    if work.alone:
        return open_worker(work.isolation, limits, libraries=libraries)
    return spare_workers().worker(work.isolation, limits, libraries)


@cache
def _check_isolation(isolation: Isolation, layers: tuple[str, ...], machine: str) -> None:
    """Tried once in a process, where it works."""
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
    """End the worker once its answer is not wanted any more."""
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
