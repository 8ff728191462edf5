"""A worker below a keeper, which ends all that the worker leaves behind. For levels that let a
candidate start processes."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Collection, Sequence

from asia.sandbox._types import Layer, Limits
from asia.sandbox.walls.surroundings import child_command, environment, interpreter, package_folder
from asia.sandbox.worker.clock import first_child
from asia.sandbox.worker.keeper import descendants
from asia.sandbox.worker.process import (
    PipePairs,
    WorkerProcess,
    kill_quietly,
    parent_ends,
    start,
)


def start_kept(
    limits: Limits,
    layers: Collection[Layer],
    libraries: Collection[str],
    inside: Sequence[str] = (),
) -> WorkerProcess:
    """Start a worker below a keeper. libraries: to load ahead; inside: words put before its command
    line. Raises SandboxError."""
    home = tempfile.mkdtemp(prefix="asia-worker-")
    pipes = PipePairs(os.pipe(), os.pipe())
    requests, replies = pipes.child_ends
    keeper = str(package_folder() / "sandbox" / "worker" / "keeper.py")
    command = [interpreter(), "-I", "-S", "-B", keeper, str(requests), str(replies), home]
    command += [*inside, *child_command(requests, replies, limits, layers, libraries)]
    try:
        process = start(command, pipes, env=environment(home, gpu=limits.gpu), cwd=home)
    except BaseException:
        shutil.rmtree(home, ignore_errors=True)
        raise
    return WorkerProcess(
        process=process,
        pipes=parent_ends(process, pipes),
        kill=_closing_is_enough,
        force=lambda: _force(process),
        tidy=lambda: shutil.rmtree(home, ignore_errors=True),
        beyond_reach=False,
        find=lambda: first_child(process.pid),
    )


def _closing_is_enough() -> None:
    """The keeper ends the worker when the request pipe closes, also if this process is killed."""


def _force(process: subprocess.Popen[bytes]) -> None:
    """Kill the process when the supervisor does not respond: a candidate can stop it, as both have
    one user."""
    while process.poll() is None and (offspring := descendants(process.pid, alive=True)):
        for pid in offspring:
            kill_quietly(pid)
    kill_quietly(process.pid)
