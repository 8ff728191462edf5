"""Process of a coding agent: start, output, deadline and end."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import threading
import time
from collections.abc import Callable

from asia.drive.command.rules import StopCause
from asia.drive.command.stream import Stream

_TICK_SECONDS = 0.2
_GRACE_SECONDS = 2.0
_JOIN_SECONDS = 10.0
_FLUSH_SECONDS = 5.0
_READ_BYTES = 64 * 1024
_CHUNK_BYTES = 256 * 1024
_LINE_BYTES = 4 * 1024 * 1024
_LAST_READS = 64


class Session:
    """A process, with a thread of its own that alone reads its output, until it is over.

    keep: given the output in whole lines, every few seconds; judge: asked all the time for a reason
    to kill it. `stopped` is that reason, `error` what went wrong in the thread.
    """

    def __init__(
        self,
        process: subprocess.Popen[bytes],
        stream: Stream,
        number: int,
        experiments: int,
        keep: Callable[[int, bytes], None],
        judge: Callable[[Stream], StopCause | None],
    ) -> None:
        self.process, self.stream = process, stream
        self.number, self.experiments = number, experiments
        self.stopped: StopCause | None = None
        self.error: Exception | None = None
        self._keep, self._judge = keep, judge
        self._last_words = ""
        self._rest, self._whole = b"", bytearray()
        self._kept = time.monotonic()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._attend, daemon=True)
        self._thread.start()

    @property
    def ended(self) -> bool:
        """Return whether the process has ended."""
        return self.process.poll() is not None

    def wait(self, seconds: float) -> None:
        """Wait for the end of the process, at most `seconds`."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(seconds)

    def kill(self) -> None:
        """End the process and all of its group."""
        for sign in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, sign)
            self.wait(_GRACE_SECONDS)

    def end(self) -> str:
        """Kill it, read what it has left; how it ended. A child that escaped its group may hold the
        output open: it is not waited for."""
        has_ended = self.ended
        self.kill()
        self._over.set()
        self._thread.join(_JOIN_SECONDS)
        if self.stream.outcome:
            return self.stream.outcome
        if self.stopped is not None:
            return f"stopped: {self.stopped.detail}"
        how = f"exit code {self.process.returncode}" if has_ended else "stopped with the search"
        return f"{how}: {self._last_words}" if self._last_words else how

    def _attend(self) -> None:
        output = self.process.stdout
        assert output is not None
        try:
            with output:
                self._follow(output.fileno())
        except Exception as error:  # noqa: BLE001 - the thread's border: the search raises it
            self.error = error
            self.kill()

    def _follow(self, output: int) -> None:
        os.set_blocking(output, False)
        poller = select.poll()
        poller.register(output, select.POLLIN)
        more = True
        while more or not self.ended:
            if self._over.is_set():
                for _ in range(_LAST_READS):
                    more = more and self._read(output)
                break
            if not more:
                self._over.wait(_TICK_SECONDS)
            elif poller.poll(1000 * _TICK_SECONDS):
                more = self._read(output)
            self._flush()
            if self.stopped is None:
                self.stopped = self._judge(self.stream)
                if self.stopped is not None:
                    self.kill()
        if self._rest:
            self._take_line(self._rest)
        self._flush(at_once=True)

    def _read(self, output: int) -> bool:
        """Read the available output; return False at its end."""
        try:
            data = os.read(output, _READ_BYTES)
        except BlockingIOError:
            return True
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self._take_line(line + b"\n")
        if len(self._rest) > _LINE_BYTES:
            self._take_line(self._rest)
            self._rest = b""
        return bool(data)

    def _take_line(self, line: bytes) -> None:
        self._whole += line
        text = line.decode("utf-8", "replace")
        self._last_words = text.strip() or self._last_words
        self.stream.feed(text)

    def _flush(self, *, at_once: bool = False) -> None:
        late = time.monotonic() - self._kept > _FLUSH_SECONDS
        if self._whole and (at_once or late or len(self._whole) > _CHUNK_BYTES):
            data, self._whole = bytes(self._whole), bytearray()
            self._kept = time.monotonic()
            self._keep(self.number, data)
