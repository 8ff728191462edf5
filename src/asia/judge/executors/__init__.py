"""Executors of evaluations; results come back in the order of the jobs."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextvars import Context, copy_context
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar, cast, runtime_checkable

from asia._plugins import parts_of
from asia._progress import tracked
from asia._text import suggestion
from asia.errors import UserError

__all__ = [
    "EXECUTORS",
    "Executor",
    "LocalExecutor",
    "RemoteExecutor",
    "SequentialExecutor",
    "executor_names",
    "local_cores",
    "make_executor",
    "remote_executor_of",
]

_GROUP = "asia.executors"

T = TypeVar("T")


class Executor(Protocol):
    """Runner of independent jobs, safe for calls from several threads.

    An exception of a job is raised after all have ended. An interrupt is raised at once: the caller
    ends its jobs itself.
    """

    def run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        """Results in the order of `jobs`."""
        ...


@runtime_checkable
class RemoteExecutor(Protocol):
    """An executor that has the folds fitted on other machines."""

    def carry(
        self,
        answer: Callable[[bytes, bytes, Callable[[], bool]], bytes],
        request: bytes,
        digest: str,
        data: bytes,
    ) -> bytes:
        """Call `answer(request, data, unwanted)` on one of the machines, where the package is
        installed.

        `unwanted()` is True there once the caller no longer waits. A machine that dies is replaced
        by another one.

        Args:
            digest: sha256 of `data`, which are sent to a machine once

        Raises:
            SandboxError: where no machine answers, or after `cancel` and `forget`
            UserError: where the machines or the scheduler must be started first
        """
        ...

    def forget(self, request: bytes) -> None:
        """End the work on this request, from another thread; its caller gets a SandboxError."""
        ...

    def ask_each(
        self, describe: Callable[[bytes], bytes], request: bytes
    ) -> dict[str, tuple[bytes, float, float]]:
        """Call `describe(request)` on every worker; return the results by its name, with their
        duration in seconds and the `time.time()` of the request."""
        ...

    def cancel(self) -> None:
        """End all running work; its callers get a SandboxError."""
        ...


class LocalExecutor:
    """Jobs on the local cores, first come, first served, no more at once than there are workers.
    Threads suffice: the work is done in sandboxed processes."""

    def __init__(self, workers: int | None = None) -> None:
        self._pool = ThreadPoolExecutor(workers or local_cores(), "evaluation")

    def run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        """Results in the order of `jobs`."""
        # Loops of a single job are the progress of the command that waits for it.
        context = copy_context() if len(jobs) == 1 else Context()
        futures = [self._pool.submit(context.copy().run, job) for job in jobs]
        try:
            for future in tracked(futures, "job") if len(jobs) > 1 else futures:
                wait([future])
        finally:
            for future in futures:
                future.cancel()
        return [future.result() for future in futures]


@dataclass(frozen=True)
class SequentialExecutor:
    """Another executor that is given one job at a time: no two workers of ours run at once."""

    executor: Executor

    def run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        """Results in the order of `jobs`."""
        results: list[T] = []
        errors: list[Exception] = []
        for job in jobs:
            try:
                results += self.executor.run([job])
            except Exception as error:  # noqa: BLE001 - raised below, once all have run
                errors.append(error)
        if errors:
            raise errors[0]
        return results


def _local(setting: str) -> LocalExecutor:
    if setting and not (setting.isdecimal() and int(setting) > 0):
        raise UserError(
            f"--executor local:{setting}: expected a number of workers, such as local:4"
        )
    return LocalExecutor(int(setting) if setting else None)


def remote_executor_of(executor: Executor | None) -> RemoteExecutor | None:
    """Return the transport to other machines; None for an executor that fits folds here."""
    if isinstance(executor, SequentialExecutor):
        return remote_executor_of(executor.executor)
    return executor if isinstance(executor, RemoteExecutor) else None


def _dask(setting: str) -> Executor:
    from asia.judge.executors.dask import DaskExecutor

    if not setting.strip("/"):
        raise UserError(
            "--executor dask: expected dask://HOST:PORT, or dask:FILE with the scheduler's file"
        )
    return DaskExecutor(f"tcp:{setting}" if setting.startswith("//") else setting)


def _dask_slurm(setting: str) -> Executor:
    from asia.judge.executors.dask import SlurmExecutor

    return SlurmExecutor(Path(setting) if setting else None)


EXECUTORS: dict[str, Callable[[str], Executor]] = {
    "local": _local,
    "dask": _dask,
    "dask-slurm": _dask_slurm,
}
"""Built-in executors by name; each receives the text after the colon of its setting."""


def executor_names() -> tuple[str, ...]:
    """The built-in executors, then those of installed packages."""
    return (*EXECUTORS, *(part.name for part in parts_of(_GROUP) if part.name not in EXECUTORS))


def make_executor(name: str) -> Executor:
    """The executor of that name, with its own settings: `local:N` with N workers,
    `dask://HOST:PORT` or `dask:FILE` on a Dask cluster, `dask-slurm` or `dask-slurm:FILE` on
    workers that Slurm starts.

    Raises:
        UserError: when there is none, or an installed package brings something else by that
            name
    """
    built_in, _, setting = name.partition(":")
    if built_in in EXECUTORS:
        return EXECUTORS[built_in](setting)
    for part in parts_of(_GROUP):
        if part.name == name:
            make = part.load()
            found = make() if callable(make) else None
            if not callable(getattr(found, "run", None)):
                raise UserError(
                    f"{part.target} of package {part.package} {part.version} is {make!r}, expected "
                    "a class or function without arguments that gives an "
                    "asia.judge.executors.Executor"
                )
            return cast("Executor", found)
    raise UserError(
        f"there is no executor '{name}'{suggestion(name, executor_names())} (installed are "
        f"{', '.join(executor_names())}): install the package that brings it"
    )


def local_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
