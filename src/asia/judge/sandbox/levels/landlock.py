"""Isolation without namespaces: a worker that locks itself in by Landlock and a system call filter.

For containers and for systems that keep namespaces from users. The worker reads the interpreter,
the environment, this package and the packages of parts, and writes nowhere. It stays one process:
ending it ends all. It can still learn that a file exists, its size and its age.
"""

import subprocess
from collections.abc import Collection

from asia.errors import SandboxError
from asia.judge.sandbox.layers.environment import (
    START_SECONDS,
    child_command,
    environment,
    layer_remedy,
)
from asia.judge.sandbox.level import Level
from asia.judge.sandbox.types import Isolation, Layer, Limits
from asia.judge.sandbox.worker.process import WorkerProcess, start


class Landlock(Level):
    """Level of a process that restricts itself, with Landlock and the system call filter."""

    isolation = Isolation.LANDLOCK
    layers = (Layer.LANDLOCK, Layer.SECCOMP, Layer.RLIMITS, Layer.PIDS)

    def why_not(self) -> str | None:
        absent = self.missing()
        if absent:
            return "; ".join(absent.values())
        try:
            return self.trial()
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"a trial did not end within {START_SECONDS:g} s: {error}"

    def remedy(self) -> str:
        steps = [layer_remedy(layer) for layer in self.missing()]
        return "; ".join(steps) or "run a Python and a package that this user may read"

    def open(
        self, limits: Limits, layers: Collection[Layer], libraries: Collection[str]
    ) -> WorkerProcess:
        absent = self.missing()
        if absent:
            reasons = "; ".join(absent.values())
            raise SandboxError(f"isolation level '{self.isolation}' cannot run here: {reasons}")
        process, pipes = start(
            lambda requests, replies: child_command(requests, replies, limits, layers, libraries),
            env=environment("/"),
            cwd="/",
        )
        return WorkerProcess(
            process=process,
            pipes=pipes,
            kill=process.kill,
            force=process.kill,
            # There is no folder and no other process besides the worker.
            tidy=lambda: None,
            beyond_reach=False,
            find=lambda: process.pid,
        )
