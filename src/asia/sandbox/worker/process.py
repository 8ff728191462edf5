"""One started worker process, as every level of isolation gives it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Callable
from dataclasses import dataclass

from asia.errors import SandboxError

_EXIT_SECONDS = 0.5
_KILLED = 128 + signal.SIGKILL
_PATIENCE_SECONDS = (2.0, 5.0)


@dataclass(frozen=True)
class Pipes:
    """The parent's ends."""

    requests: int
    """File descriptor for writing requests."""
    replies: int
    """File descriptor for reading replies."""
    output: int
    """File descriptor for reading the worker's output."""


@dataclass(frozen=True)
class Ending:
    """End of a worker, by itself or by another process."""

    code: int | None
    """Exit code, 128 + n for signal n; None if unknown."""
    outside: int | None
    """Signal from another process; None for an end of its own."""


@dataclass(frozen=True)
class WorkerProcess:
    """A running worker: its pipes, the process to wait for and the way to end it."""

    process: subprocess.Popen[bytes]
    """The process to wait for: the worker, or one that ends with it."""
    pipes: Pipes
    """The way to speak to the worker."""
    kill: Callable[[], None]
    """Ends the candidate with everything it started."""
    force: Callable[[], None]
    """Callback for a process that `kill` did not end in time."""
    tidy: Callable[[], None]
    """Callback that frees the level's other resources."""
    beyond_reach: bool
    """Whether `process` is a guard of the worker that no candidate can signal."""
    find: Callable[[], int | None]
    """The process id of the worker itself, None where it is not known."""

    def running(self) -> bool:
        """Return whether the worker is still there."""
        return self.process.poll() is None

    def ending(self) -> Ending:
        """Describe the end of a worker that has just gone, and that this process did not end."""
        if not self._ended(_EXIT_SECONDS):
            return Ending(None, None)
        code = self.process.returncode
        if code >= 0:
            # A guard of bubblewrap's ends with 128 + n where signal n ended the worker. The filter
            # on system calls keeps a candidate from choosing that code itself for SIGKILL.
            outside = self.beyond_reach and code == _KILLED
            return Ending(code, signal.SIGKILL if outside else None)
        outside = self.beyond_reach or code == -signal.SIGKILL
        return Ending(128 - code, -code if outside else None)

    def end(self) -> bool:
        """End everything and wait; whether it ended. The kernel does not let a process die that
        waits for a device or a file server: it is left behind."""
        try:
            self.kill()
            if self._ended(_PATIENCE_SECONDS[0]):
                return True
            self.force()
            return self._ended(_PATIENCE_SECONDS[1])
        finally:
            self.tidy()

    def _ended(self, seconds: float) -> bool:
        try:
            self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            return False
        return True


@dataclass(frozen=True)
class PipePairs:
    """Both ends of the two pipes of a worker about to start."""

    requests: tuple[int, int]
    """(the child reads, the parent writes)."""
    replies: tuple[int, int]
    """(the parent reads, the child writes)."""

    @property
    def child_ends(self) -> tuple[int, int]:
        """(requests to read, replies to write)."""
        return self.requests[0], self.replies[1]

    def close_child_ends(self) -> None:
        """The parent must not hold them: end of file is how each side learns of the other's end."""
        for fd in self.child_ends:
            os.close(fd)

    def close_parent_ends(self) -> None:
        """Close the parent's ends of the pipes when the worker could not be started."""
        os.close(self.requests[1])
        os.close(self.replies[0])


def start(
    command: list[str],
    pipes: PipePairs,
    *,
    env: dict[str, str],
    cwd: str,
    also_pass: tuple[int, ...] = (),
    program: str | None = None,
) -> subprocess.Popen[bytes]:
    """Start `command` in a session of its own, with the child's pipe ends and nothing else.

    Raises SandboxError.

    Args:
        program: file to run, where it is not the first word
    """
    try:
        return subprocess.Popen(
            command,
            executable=program,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            pass_fds=(*pipes.child_ends, *also_pass),
            start_new_session=True,
            bufsize=0,
            env=env,
            cwd=cwd,
        )
    except OSError as error:
        pipes.close_parent_ends()
        raise SandboxError(f"a worker process could not be started: {error}") from error
    finally:
        pipes.close_child_ends()


def parent_ends(process: subprocess.Popen[bytes], pipes: PipePairs) -> Pipes:
    """The parent's ends, taken out of `process` so that one owner closes them."""
    assert process.stdout is not None
    output = os.dup(process.stdout.fileno())
    process.stdout.close()
    return Pipes(pipes.requests[1], pipes.replies[0], output)


def kill_quietly(pid: int) -> None:
    """SIGKILL; a process that has ended already is no error."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
