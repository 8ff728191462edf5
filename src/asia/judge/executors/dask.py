"""Folds on the machines of a Dask cluster: an engine that others keep."""

import hashlib
import itertools
import os
import sys
import threading
import time
import tomllib
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from inspect import signature
from pathlib import Path
from typing import Any, TypeVar

from asia._plugins import is_installed, library
from asia._text import say, suggestion
from asia.errors import SandboxError, UserError

T = TypeVar("T")

_CONNECT_SECONDS = 10
_ATTEMPTS = 3
# A machine that starts again is back by then; for longer a search is better begun again later.
_NO_WORKERS_SECONDS = 600.0
_LOOK_SECONDS = 20.0
_POLL_SECONDS = 0.1
_COUNT_SECONDS = 1.0

Answer = Callable[[bytes, bytes, Callable[[], bool]], bytes]


class DaskExecutor:
    """Executor of folds on a Dask cluster, as many at once as it has threads.

    Other folds wait here, by priority, so that none waits for one worker while another one is idle.
    Scoring stays here. A cluster runs the code that its clients send: run it in a private network.

    Raises:
        UserError: without the extra `dask`, or where no scheduler answers
    """

    def __init__(self, where: str) -> None:
        """where: `tcp://HOST:PORT`, or the path of a scheduler file."""
        if not is_installed("distributed"):
            raise UserError(
                "--executor dask needs the package distributed: "
                "pip install '.[dask]' in a clone of ASIA"
            )
        self._client: Any = _connected(where)
        self._where = where
        self._numbers = itertools.count()
        self._sent: dict[str, Any] = {}
        self._lock = threading.Lock()
        self._under_way: dict[Any, bytes] = {}
        self._forgotten: set[bytes] = set()
        self._cancelled = False
        self._places, self._taken = threading.Condition(), 0
        self._threads, self._counted = 0, float("-inf")

    def run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        """Run the jobs and return their results in order; the jobs wait here for remote fits."""
        if not jobs:
            return []
        pool = ThreadPoolExecutor(max_workers=len(jobs), thread_name_prefix="fold")
        try:
            futures = [pool.submit(job) for job in jobs]
            wait(futures)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
        return [future.result() for future in futures]

    def carry(self, answer: Answer, request: bytes, digest: str, data: bytes) -> bytes:
        """Implement `RemoteExecutor.carry`."""
        trouble: Exception | None = None
        try:
            with self._place():
                for _ in range(_ATTEMPTS):
                    self._check_wanted(request)
                    try:
                        self._await_workers()
                        return self._answered(answer, request, self._data(digest, data))
                    except UserError:
                        raise
                    # Whatever the engine raises: a machine died, and perhaps the data with it.
                    except Exception as error:  # noqa: BLE001
                        self._check_wanted(request)
                        trouble = error
                        with self._lock:
                            self._sent.pop(digest, None)
                        self._check_scheduler()
        finally:
            with self._lock:
                self._forgotten.discard(request)
        raise SandboxError(
            f"no machine of the cluster at {self._where} has fitted a fold in {_ATTEMPTS} attempts "
            f"({type(trouble).__name__}: {trouble}): see the output of its workers, then give the "
            "same command again"
        )

    def ask_each(
        self, describe: Callable[[bytes], bytes], request: bytes
    ) -> dict[str, tuple[bytes, float, float]]:
        """Implement `RemoteExecutor.ask_each`; the first call imports the package there and is not
        timed."""
        found: dict[str, tuple[bytes, float, float]] = {}
        workers: dict[str, Any] = self._client.scheduler_info(n_workers=-1)["workers"]
        for address in sorted(workers):
            self._client.run(describe, request, workers=[address])
            begin = time.monotonic()
            self._client.run(_nothing, workers=[address])
            seconds = time.monotonic() - begin
            asked = time.time()
            answers: dict[str, bytes] = self._client.run(describe, request, workers=[address])
            found[address] = answers[address], seconds, asked
        return found

    def forget(self, request: bytes) -> None:
        """Implement `RemoteExecutor.forget`: the sandbox of the worker ends within a second."""
        with self._lock:
            self._forgotten.add(request)
            under_way = [one for one, what in self._under_way.items() if what == request]
        self._end(under_way)

    def cancel(self) -> None:
        """Implement `RemoteExecutor.cancel`: the sandboxes of the workers end within a second."""
        self._cancelled = True
        with self._lock:
            under_way = list(self._under_way)
        self._end(under_way)

    def _end(self, under_way: Sequence[Any]) -> None:
        # A scheduler that is gone has forgotten them.
        if under_way and self._client.status == "running":
            self._client.cancel(under_way, force=True)

    def _check_wanted(self, request: bytes) -> None:
        """Raise SandboxError where the caller no longer waits for the answer."""
        if self._cancelled:
            raise SandboxError("the search was interrupted")
        if request in self._forgotten:
            raise SandboxError("the result of this fit is not wanted any more")

    @contextmanager
    def _place(self) -> Generator[None]:
        """Wait for a free thread of the cluster, so that no fold waits for one machine while
        another one is idle."""
        with self._places:
            while self._taken >= self._room():
                self._places.wait(_COUNT_SECONDS)
            self._taken += 1
        try:
            yield
        finally:
            with self._places:
                self._taken -= 1
                self._places.notify()

    def _room(self) -> int:
        """Threads of the cluster, counted anew now and then. All may enter where there are none:
        each of them waits for a worker then, or says that there is none."""
        now = time.monotonic()
        if now - self._counted > _COUNT_SECONDS and self._client.status == "running":
            self._counted = now
            workers: dict[str, Any] = self._client.scheduler_info(n_workers=-1)["workers"]
            self._threads = sum(int(worker["nthreads"]) for worker in workers.values())
        return self._threads or sys.maxsize

    def close(self) -> None:
        """Leave the cluster."""
        self._client.close()

    def _data(self, digest: str, data: bytes) -> Any:
        """The data on the cluster, sent once; machines pass them on among themselves."""
        with self._lock:
            if digest not in self._sent:
                key = f"asia-data-{digest}-{next(self._numbers)}"
                self._sent[digest] = self._client.scatter({key: data})[key]
            return self._sent[digest]

    def _answered(self, answer: Answer, request: bytes, data: Any) -> bytes:
        key = f"asia-fold-{hashlib.sha256(request).hexdigest()}-{next(self._numbers)}"
        future = self._client.submit(_task, answer, request, data, key=key, pure=False)
        with self._lock:
            self._under_way[future] = request
        try:
            # For one that was forgotten before it was under way.
            self._check_wanted(request)
            while True:
                try:
                    return future.result(_LOOK_SECONDS)
                except TimeoutError:
                    if future.done():
                        raise
                    self._await_workers()
        finally:
            with self._lock:
                self._under_way.pop(future, None)

    def _await_workers(self) -> None:
        """Wait for a worker; raise UserError where none appears in time."""
        end = time.monotonic() + _NO_WORKERS_SECONDS
        while not self._client.scheduler_info(n_workers=1)["workers"] and not self._cancelled:
            self._check_scheduler()
            if time.monotonic() > end:
                raise UserError(
                    f"the scheduler at {self._where} has had no workers for "
                    f"{_NO_WORKERS_SECONDS:.0f} s: start some, then give the same command again, "
                    "which goes on from here"
                )
            time.sleep(_POLL_SECONDS)

    def _check_scheduler(self) -> None:
        """Wait while the engine looks for a scheduler that it has lost; raise UserError where it
        does not find it."""
        while self._client.status in ("connecting", "closing"):
            time.sleep(_POLL_SECONDS)
        if self._client.status != "running":
            raise UserError(
                f"the scheduler at {self._where} is gone: start it again with its workers, then "
                "give the same command again, which goes on from here"
            )


def _connected(where: str) -> Any:
    if "://" not in where and not Path(where).is_file():
        raise UserError(
            f"--executor dask:{where}: there is no such file; give the one that "
            "'dask scheduler --scheduler-file' wrote, or dask://HOST:PORT"
        )
    given: dict[str, Any] = {"address" if "://" in where else "scheduler_file": where}
    try:
        client: Any = _distributed().Client(**given, timeout=_CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UserError(
            f"--executor dask: no scheduler answers at {where} ({error}): start one with "
            "'dask scheduler', and workers with 'dask worker --nthreads 1'"
        ) from None
    if not client.scheduler_info(n_workers=-1)["workers"]:
        client.close()
        raise UserError(
            f"--executor dask: the scheduler at {where} has no workers: start one on each machine "
            "with 'dask worker --nthreads 1'"
        )
    return client


def _distributed() -> Any:
    """The engine, which an extra brings."""
    return library("distributed")


def _nothing() -> None:
    """Do nothing on a worker, to test the connection."""


def _task(answer: Answer, request: bytes, data: bytes) -> bytes:
    """Compute the answer on a worker, unless the scheduler has forgotten the client."""
    worker = _distributed().get_worker()
    key = worker.get_current_task()

    def unwanted() -> bool:
        state = worker.state.tasks.get(key)
        return state is None or state.state not in ("executing", "long-running")

    return answer(request, data, unwanted)


# A worker that has lost its search ends by then.
_DEATH_SECONDS = 60


class SlurmExecutor(DaskExecutor):
    """Folds on workers that Slurm starts.

    Raises:
        UserError: without the extra `slurm`, where a setting is wrong, and where Slurm takes no
            job
    """

    def __init__(self, file: Path | None) -> None:
        """Start the workers and return once the first one is ready.

        Args:
            file: a TOML file, `jobs` and arguments of `dask_jobqueue.SLURMCluster`; None for
                four jobs of one core and 5 GB each
        """
        for name in ("distributed", "dask_jobqueue"):
            if not is_installed(name):
                raise UserError(
                    f"--executor dask-slurm needs the package {name.replace('_', '-')}: "
                    "pip install '.[slurm]' in a clone of ASIA"
                )
        given: dict[str, Any] = {}
        try:
            given = {} if file is None else tomllib.loads(file.read_text("utf-8"))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise UserError(
                f"--executor dask-slurm:{file}: {getattr(error, 'strerror', None) or error}; "
                'expected a TOML file such as jobs = 8, memory = "5GB", walltime = "08:00:00"'
            ) from None
        jobs = given.pop("jobs", 4)
        if not isinstance(jobs, int) or jobs < 1:
            raise UserError(f"{file}: jobs = {jobs!r}: expected a number of Slurm jobs, 1 or more")
        settings = {"cores": 1, "processes": 1, "memory": "5GB"}
        # Kept: its jobs end with it.
        self._cluster: Any = _cluster(settings | given, file)
        _started(self._cluster, jobs)
        super().__init__(self._cluster.scheduler_address)

    def close(self) -> None:
        """Leave the cluster, and end its jobs."""
        super().close()
        self._cluster.close()


def _cluster(settings: dict[str, Any], file: Path | None) -> Any:
    make: Any = library("dask_jobqueue").SLURMCluster
    core: Any = library("dask_jobqueue.core")
    taken = (make.job_cls.__init__, core.Job.__init__, core.JobQueueCluster.__init__)
    known = {name for function in taken for name in signature(function).parameters}
    for name in settings.keys() - known:
        raise UserError(
            f"--executor dask-slurm:{file}: there is no setting '{name}'"
            f"{suggestion(name, sorted(known))}: expected jobs and arguments of "
            "dask_jobqueue.SLURMCluster, such as queue, account, cores, memory, walltime"
        )
    fixed = {"nanny": False, "death_timeout": _DEATH_SECONDS, "python": sys.executable}
    return make(**(fixed | settings))


def _started(cluster: Any, jobs: int) -> None:
    say(f"slurm    asked for {jobs} jobs; waiting for the first worker", file=sys.stderr)
    try:
        cluster.scale(jobs=jobs)
        while not cluster.scheduler_info["workers"]:
            if str(cluster.status) == "Status.failed":
                raise OSError("the cluster has failed")
            time.sleep(0.2)
    except (OSError, RuntimeError) as error:
        cluster.close()
        raise UserError(
            f"--executor dask-slurm: Slurm takes no job ({error}): try 'sbatch --version' and "
            f"'sinfo' here, in {os.getcwd()}"
        ) from None
    except BaseException:
        cluster.close()
        raise
