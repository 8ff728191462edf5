"""Isolation without namespaces: a worker that locks itself in by Landlock and a system call filter.

For containers and for systems that keep namespaces from users. The worker reads the interpreter,
the environment, this package and the packages of parts, and writes nowhere. It stays one process:
ending it ends all. It can still learn that a file exists, its size and its age.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Collection

from asia.errors import SandboxError
from asia.sandbox._level import Level
from asia.sandbox._types import Isolation, Layer, Limits
from asia.sandbox.walls.own_layers import layer_remedy
from asia.sandbox.walls.surroundings import child_command, environment, interpreter, package_folder
from asia.sandbox.walls.trial import START_SECONDS, last_line, run_trial
from asia.sandbox.worker.process import PipePairs, WorkerProcess, parent_ends, start

_NOWHERE = "/"


class Landlock(Level):
    """Level of a process that restricts itself, with Landlock and the system call filter."""

    isolation = Isolation.LANDLOCK
    layers = (Layer.LANDLOCK, Layer.SECCOMP, Layer.RLIMITS)

    def why_not(self) -> str | None:
        absent = self.missing()
        if absent:
            return "; ".join(absent.values())
        script = package_folder() / "sandbox" / "walls" / "lockdown.py"
        walls = f"{Layer.LANDLOCK},{Layer.SECCOMP}"
        command = [interpreter(), "-I", "-S", "-B", str(script), walls, str(package_folder())]
        try:
            trial = run_trial(command)
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"a trial did not end within {START_SECONDS:g} s: {error}"
        return None if trial.returncode == 0 else last_line(trial, "a trial failed silently")

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
        pipes = PipePairs(os.pipe(), os.pipe())
        command = child_command(*pipes.child_ends, limits, layers, libraries)
        process = start(command, pipes, env=environment(_NOWHERE, gpu=limits.gpu), cwd=_NOWHERE)
        return WorkerProcess(
            process=process,
            pipes=parent_ends(process, pipes),
            kill=process.kill,
            force=process.kill,
            tidy=_nothing,
            beyond_reach=False,
            find=lambda: process.pid,
        )


def _nothing() -> None:
    """Do nothing: there is no folder and no other process besides the worker."""
