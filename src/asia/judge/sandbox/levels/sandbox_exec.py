"""Isolation on macOS through sandbox-exec; written from its documentation, not tested.

The profile denies by default. It allows no network and no new process, reading the system's
libraries and the code that every worker reads, and writing to devices that store nothing. Apple
calls sandbox-exec deprecated and still ships it. A supervisor ends remaining processes.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Collection, Sequence

from asia.errors import SandboxError
from asia.judge.sandbox.layers.environment import code_folders, interpreter, run_trial
from asia.judge.sandbox.level import Level
from asia.judge.sandbox.types import Isolation, Layer, Limits
from asia.judge.sandbox.worker.process import WorkerProcess, start_kept

_PROGRAM = "sandbox-exec"
_SYSTEM = ("/usr/lib", "/usr/share", "/System", "/Library/Frameworks", "/private/var/db/dyld")
_DEVICES = ("/dev/null", "/dev/zero", "/dev/random", "/dev/urandom")


class SandboxExec(Level):
    """A process under a profile of macOS."""

    isolation = Isolation.SANDBOX_EXEC
    layers = (Layer.PROFILE, Layer.RLIMITS)
    system = "darwin"
    caveat = "written from its documentation, not tested"

    def why_not(self) -> str | None:
        if sys.platform != "darwin":
            return "sandbox-exec needs macOS"
        program = shutil.which(_PROGRAM)
        if program is None:
            return "the program sandbox-exec was not found"
        command = [program, "-p", profile(), interpreter(), "-I", "-S", "-c", "pass"]
        try:
            trial = run_trial(command)
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"sandbox-exec did not start: {error}"
        if trial.returncode != 0:
            return f"sandbox-exec could not start Python: exit code {trial.returncode}"
        return None

    def remedy(self) -> str:
        return "use the sandbox-exec that macOS ships in /usr/bin"

    def open(
        self, limits: Limits, layers: Collection[Layer], libraries: Collection[str]
    ) -> WorkerProcess:
        program = shutil.which(_PROGRAM)
        if program is None:
            raise SandboxError("the program sandbox-exec was not found")
        inside = [program, "-p", profile()] if Layer.PROFILE in layers else []
        return start_kept(limits, layers, libraries, inside)


def profile() -> str:
    """Return the permissions of a worker in the language of sandbox-exec."""
    program = interpreter()
    code = [*_SYSTEM, *(place for _, place in code_folders()), *(p for p, _ in code_folders())]
    return "\n".join(
        (
            "(version 1)",
            "(deny default)",
            f"(allow process-exec {_each('literal', [program, os.path.realpath(program)])})",
            "(allow sysctl-read)",
            "(allow file-read-metadata)",
            f"(allow file-read* {_each('subpath', code)} {_each('literal', _DEVICES)})",
            f"(allow file-write-data {_each('literal', _DEVICES[:2])})",
            "(deny network*)",
            "(deny process-fork)",
        )
    )


def _each(kind: str, places: Sequence[str]) -> str:
    quoted = (place.replace("\\", "\\\\").replace('"', '\\"') for place in places)
    return " ".join(f'({kind} "{place}")' for place in dict.fromkeys(quoted))
