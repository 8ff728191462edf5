"""Isolation without namespaces: a worker that locks itself in by Landlock and a system call filter.

For containers and for systems that keep namespaces from users. The worker reads the interpreter,
the environment and this package, and writes nowhere. It stays one process: ending it ends all.
What it can still learn is that a file exists, how large and how old it is.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Collection

from asia.sandbox._types import Layer, Limits
from asia.sandbox.walls import landlock, seccomp
from asia.sandbox.walls.surroundings import child_command, environment, interpreter, package_folder
from asia.sandbox.worker.cell import Cell, PipePairs, parent_ends, start

_NOWHERE = "/"
_START_SECONDS = 20.0


def missing() -> dict[Layer, str]:
    """Which layers a worker cannot put on itself here, and why."""
    if sys.platform != "linux":
        return {Layer.LANDLOCK: "Landlock needs Linux", Layer.SECCOMP: "seccomp needs Linux"}
    reasons = {Layer.LANDLOCK: landlock.why_not(), Layer.SECCOMP: seccomp.why_not()}
    return {layer: reason for layer, reason in reasons.items() if reason is not None}


def why_not() -> str | None:
    """None if a Python that locks itself in is stopped where it must be, else the reason."""
    absent = missing()
    if absent:
        return "; ".join(absent.values())
    script = package_folder() / "sandbox" / "walls" / "lockdown.py"
    layers = f"{Layer.LANDLOCK},{Layer.SECCOMP}"
    try:
        trial = subprocess.run(
            [interpreter(), "-I", "-S", "-B", str(script), layers, str(package_folder())],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env={},
            cwd=_NOWHERE,
            timeout=_START_SECONDS,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"a trial did not end: {error}"
    if trial.returncode != 0:
        return (trial.stdout.strip().splitlines() or ["a trial failed without a message"])[-1][:200]
    return None


def open_cell(limits: Limits, layers: Collection[Layer]) -> Cell:
    """Start a worker that applies these layers to itself. Raises SandboxError."""
    pipes = PipePairs(os.pipe(), os.pipe())
    command = child_command(*pipes.child_ends, limits, layers)
    process = start(command, pipes, env=environment(_NOWHERE), cwd=_NOWHERE)
    return Cell(
        process=process,
        pipes=parent_ends(process, pipes),
        kill=process.kill,
        force=process.kill,
        tidy=_nothing,
        beyond_reach=False,
    )


def _nothing() -> None:
    """There is no folder and no other process beside the worker."""
