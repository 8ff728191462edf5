"""A Dask cluster on this machine, for tests."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from asia.errors import UserError
from asia.judge.executors.dask import DaskExecutor

DASK = Path(sys.executable).with_name("dask")


@dataclass
class Cluster:
    """A scheduler and its workers, one fold each."""

    folder: Path
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def file(self) -> Path:
        return self.folder / "scheduler.json"

    def start(self, *words: str) -> None:
        log = (self.folder / f"{len(self.processes)}.log").open("wb")
        with log:
            started = subprocess.Popen(
                [DASK, *words, "--no-dashboard", "--scheduler-file", self.file],
                stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip
        self.processes.append(started)

    def add_worker(self) -> None:
        self.start("worker", "--nthreads", "1", "--no-nanny", "--death-timeout", "60")

    def connected(self, workers: int) -> DaskExecutor:
        end = time.monotonic() + 60.0
        while True:
            try:
                executor = DaskExecutor(str(self.file))
                if len(executor._client.scheduler_info()["workers"]) >= workers:
                    return executor
                executor.close()
            except UserError:
                pass
            assert time.monotonic() < end, "the cluster did not start"
            time.sleep(0.5)

    def close(self) -> None:
        for process in reversed(self.processes):
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@contextmanager
def two_workers(folder: Path) -> Iterator[Cluster]:
    """A scheduler and two workers, ended at the end."""
    made = Cluster(folder)
    made.start("scheduler", "--port", "0", "--host", "127.0.0.1")
    made.add_worker()
    made.add_worker()
    try:
        yield made
    finally:
        made.close()
