"""Cleanup of orphan processes of bubblewrap when this process is killed during the start of a
worker.

The inner half of bubblewrap waits for a word of the outer one before it ties its life to anything.
Where the outer one dies first, as it does with this process, nothing else would ever end the inner
one.
"""

from __future__ import annotations

import contextlib
import secrets
import subprocess

from asia.errors import SandboxError

# Both halves bear the mark as the first word of their command line. It comes over the pipe, so that
# no command line of the watch itself bears it. The pipe ends with us.
_WATCH = r"""
read -r mark
read -r nothing
for look in 1 2 3 4 5 6 7 8 9 10; do
  printf %s "$mark" | grep -lsFf - /proc/[0-9]*/cmdline | while IFS=/ read -r _ _ pid _; do
    kill -9 "$pid"
  done
  sleep 0.1
done
"""


class OrphanWatch:
    """Small process next to a worker that outlives this process by a second and ends all processes
    that bear `mark`."""

    def __init__(self) -> None:
        """Raise SandboxError where it cannot be started."""
        self.mark = f"bwrap-{secrets.token_hex(8)}"
        try:
            self._process = subprocess.Popen(
                ["/bin/sh", "-c", _WATCH],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
                bufsize=0,
                env={"PATH": "/usr/bin:/bin"},
                cwd="/",
            )
        except OSError as error:
            raise SandboxError(f"a worker's watch could not be started: {error}") from error
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(self.mark.encode() + b"\n")

    def dismiss(self) -> None:
        """The worker has ended with all of bubblewrap."""
        self._process.kill()
        self._end()

    def end_orphans(self) -> None:
        """The outer half has ended, and perhaps alone; takes a second."""
        self._end()

    def _end(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()
