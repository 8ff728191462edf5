"""A started worker process: pipes, clock, supervision."""

from __future__ import annotations

import fcntl
import math
import os
import pickle
import re
import secrets
import select
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from asia._text import printable
from asia._timer import Activity, Seconds, add_seconds
from asia.errors import SandboxError
from asia.judge.sandbox.layers.environment import (
    child_command,
    environment,
    interpreter,
    package_folder,
)
from asia.judge.sandbox.types import Layer, Limits
from asia.judge.sandbox.worker.keeper import descendants
from asia.judge.sandbox.worker.wire import (
    COMPILED,
    COMPILED_BYTES,
    FRAME_HEAD,
    LARGE_BYTES,
    LENGTH,
    REPLY_HEAD,
    REQUEST_HEAD,
    TOKEN_BYTES,
    ReplyKind,
)

_EXIT_SECONDS = 0.5
_KILLED = 128 + signal.SIGKILL
_PATIENCE_SECONDS = (2.0, 5.0)


@dataclass(frozen=True)
class Pipes:
    """File descriptors of the parent's ends: to write requests, to read replies and output."""

    requests: int
    replies: int
    output: int


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
    guard: int | None = None
    """The process below which a worker's own processes are; None where it can start none."""

    def pids(self) -> list[int]:
        """Processes of the worker."""
        if self.guard is not None:
            return descendants(self.guard, alive=True)
        found = self.find()
        return [] if found is None else [found]

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


def start(
    command: Callable[[int, int], list[str]],
    *,
    env: dict[str, str],
    cwd: str,
    also_pass: tuple[int, ...] = (),
    program: str | None = None,
) -> tuple[subprocess.Popen[bytes], Pipes]:
    """Start a command in a session of its own, with its ends of two pipes and nothing else.

    Raises SandboxError.

    Args:
        command: its words, for the file descriptors to read requests from and write replies to
        program: file to run, where it is not the first word
    """
    read_requests, requests = os.pipe()
    replies, write_replies = os.pipe()
    try:
        process = subprocess.Popen(
            command(read_requests, write_replies),
            executable=program,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            pass_fds=(read_requests, write_replies, *also_pass),
            start_new_session=True,
            bufsize=0,
            env=env,
            cwd=cwd,
        )
    except BaseException as error:
        os.close(requests)
        os.close(replies)
        if not isinstance(error, OSError):
            raise
        raise SandboxError(f"a worker process could not be started: {error}") from error
    finally:
        # End of file is how each side learns of the other's end.
        os.close(read_requests)
        os.close(write_replies)
    # Taken out of `process`, so that one owner closes it.
    assert process.stdout is not None
    output = os.dup(process.stdout.fileno())
    process.stdout.close()
    return process, Pipes(requests, replies, output)


def kill_quietly(pid: int) -> None:
    """SIGKILL; a process that has ended already is no error."""
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


# The parent's end of a worker's pipes: framed, bounded, and under one deadline.

_KEPT_BEGINNING = 16 * 1024
# With the line between them all stays within 64 KiB.
_KEPT_END = 48 * 1024 - 64
_LARGEST_OUTPUT = 4 * 1024 * 1024
_SLICE_SECONDS = 0.1
# Messages of libraries about a system call that the sandbox denies; not from a candidate.
_OF_THE_SANDBOX = re.compile(r"^\[mutex\.cc : \d+\] RAW: .*\n?", re.MULTILINE)
_PIPE_BYTES = 1024 * 1024


class LateError(Exception):
    """The deadline has passed."""


class GoneError(Exception):
    """The worker closed its end or ended."""


class UnsolicitedError(Exception):
    """Bytes that answer no request."""


@dataclass(frozen=True)
class Head:
    """Start of a reply: its kind and the number of bytes that follow."""

    status: ReplyKind
    length: int


class Channel:
    """Channel of requests and replies, which also drains the candidate's output.

    A reply counts only with the token of the request it answers, so bytes written beforehand on the
    reply pipe are always detected.
    """

    def __init__(self, pipes: Pipes, running: Callable[[], bool]) -> None:
        self._requests = pipes.requests
        self._replies = pipes.replies
        self._output: int | None = pipes.output
        self._running = running
        self._token = bytes(TOKEN_BYTES)
        self._beginning = bytearray()
        self._end = bytearray()
        self._printed_bytes = 0
        self._keep_output = True
        self._early = bytearray()
        self._pollers: dict[tuple[int, int], select.poll] = {}
        for fd in (pipes.requests, pipes.replies, pipes.output):
            os.set_blocking(fd, False)
        if sys.platform == "linux":
            for fd in (pipes.requests, pipes.replies):
                with suppress(OSError):
                    fcntl.fcntl(fd, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)

    def new_token(self) -> bytes:
        """Token for the next request. Raises UnsolicitedError, GoneError."""
        if self._early:
            raise UnsolicitedError
        if select_one(self._replies):
            raise UnsolicitedError if os.read(self._replies, 1) else GoneError
        self._token = secrets.token_bytes(TOKEN_BYTES)
        return self._token

    def send(self, request: object, deadline: float) -> None:
        """Send one request. Raises LateError, GoneError."""
        if not self._keep_output:
            self._printed_bytes = 0  # The limit on what is dropped is one on each request.
        arrays: list[memoryview] = []

        def in_pickle(buffer: pickle.PickleBuffer) -> bool:
            raw = buffer.raw()
            if raw.nbytes >= LARGE_BYTES:
                arrays.append(raw)
            return raw.nbytes < LARGE_BYTES

        body = pickle.dumps(request, protocol=5, buffer_callback=in_pickle)
        lengths = [LENGTH.pack(array.nbytes) for array in arrays]
        head = b"".join([REQUEST_HEAD.pack(len(body), len(arrays)), *lengths])
        for data in (memoryview(head), memoryview(body), *arrays):
            self._write(data, deadline)

    def exchange(self, frame: bytearray, token: bytes, answer: memoryview, deadline: float) -> Head:
        """Send one sample of a stream and wait for the reply with this token. Where it is OK and
        has the size of `answer`, that is filled. Raises LateError, GoneError, UnsolicitedError."""
        self._token = token
        self.send_frame(frame, deadline, goes_on=True)
        head = bytearray(REPLY_HEAD.size)
        count = 0
        while not count:
            try:
                count = os.readv(self._replies, [head, answer])
            except BlockingIOError:
                self._wait(self._replies, select.POLLIN, deadline)
                continue
            if not count:
                raise GoneError
        if count == len(head) + len(answer):
            status, token, length = REPLY_HEAD.unpack(head)
            if token == self._token and status == ReplyKind.OK and length == len(answer):
                return Head(ReplyKind.OK, length)
        self._early += (head + answer)[:count]
        found = self.receive_head(deadline)
        if found == Head(ReplyKind.OK, len(answer)):
            self.receive_into(answer, deadline)
        return found

    def send_frame(self, frame: bytearray, deadline: float, *, goes_on: bool) -> None:
        """Send a frame of a stream. Raises LateError, GoneError."""
        FRAME_HEAD.pack_into(frame, 0, self._token, goes_on)
        self._write(memoryview(frame), deadline)

    def _write(self, data: memoryview, deadline: float) -> None:
        done = 0
        while done < len(data):
            try:
                done += os.write(self._requests, data[done : done + _PIPE_BYTES])
            except BlockingIOError:
                self._wait(self._requests, select.POLLOUT, deadline)
            except BrokenPipeError as error:
                raise GoneError from error

    def receive_head(self, deadline: float) -> Head:
        """Wait for the next reply. Raises LateError, GoneError, UnsolicitedError."""
        status, token, length = REPLY_HEAD.unpack(self.receive(REPLY_HEAD.size, deadline))
        if token != self._token:
            raise UnsolicitedError
        try:
            return Head(ReplyKind(status), length)
        except ValueError as error:
            raise UnsolicitedError from error

    def receive(self, length: int, deadline: float) -> bytes:
        """Exactly `length` bytes. Raises LateError, GoneError."""
        data = bytearray(length)
        self.receive_into(memoryview(data), deadline)
        return bytes(data)

    def receive_into(self, data: memoryview, deadline: float) -> None:
        """Exactly as many bytes as there is room for. Raises LateError, GoneError."""
        done = min(len(self._early), len(data))
        data[:done] = self._early[:done]
        del self._early[:done]
        while done < len(data):
            try:
                count = os.readv(self._replies, [data[done : done + _PIPE_BYTES]])
            except BlockingIOError:
                self._wait(self._replies, select.POLLIN, deadline)
                continue
            if not count:
                raise GoneError
            done += count

    def take_output(self) -> str:
        """Return the output so far, its middle left out where it is long, without control
        characters; later output is dropped."""
        while self._output is not None and select_one(self._output):
            self._drain()
        self._keep_output = False
        left_out = self._printed_bytes - len(self._beginning) - len(self._end)
        between = f"\n... {left_out} bytes left out ...\n" if left_out else ""
        beginning, end = (p.decode("utf-8", "replace") for p in (self._beginning, self._end))
        whole = beginning.rpartition("\n")[0] + "\n" + end.partition("\n")[2]
        if left_out and not _OF_THE_SANDBOX.sub("", whole).strip() and "[mutex.cc" in whole:
            return ""  # The sandbox alone has written, more than was kept.
        return _OF_THE_SANDBOX.sub("", printable(f"{beginning}{between}{end}"))

    def keep_output(self) -> None:
        """Drop the output so far and keep what comes, as at first."""
        self.take_output()
        self._beginning.clear()
        self._end.clear()
        self._printed_bytes, self._keep_output = 0, True

    def close(self) -> None:
        """Close the parent's ends. The worker's keeper takes it as the order to end."""
        self._close_output()
        os.close(self._requests)
        os.close(self._replies)

    def _wait(self, fd: int, event: int, deadline: float) -> None:
        while True:
            left = deadline - time.monotonic()
            if left <= 0:
                raise LateError
            poller = self._pollers.get((fd, event))
            if poller is None:
                poller = self._pollers[fd, event] = select.poll()
                poller.register(fd, event)
                if self._output is not None:
                    poller.register(self._output, select.POLLIN)
            ready = {place for place, _ in poller.poll(min(left, _SLICE_SECONDS) * 1000)}
            if self._output in ready:
                self._drain()
            if fd in ready:
                return
            # A process that outlives the worker may hold its pipes: end of file never comes.
            if not ready and not self._running() and not select_one(fd, event):
                raise GoneError

    def _drain(self) -> None:
        assert self._output is not None
        try:
            part = os.read(self._output, _KEPT_END)
        except BlockingIOError:
            return
        self._printed_bytes += len(part)
        if self._keep_output:
            room = _KEPT_BEGINNING - len(self._beginning)
            self._beginning += part[:room]
            self._end += part[room:]
            del self._end[:-_KEPT_END]
        if not part or self._printed_bytes > _LARGEST_OUTPUT:
            self._close_output()

    def _close_output(self) -> None:
        if self._output is not None:
            os.close(self._output)
            self._output = None
            self._pollers.clear()


def select_one(fd: int, event: int = select.POLLIN) -> bool:
    """Return whether `fd` has something to tell, end of file included."""
    poller = select.poll()
    poller.register(fd, event)
    return bool(poller.poll(0))


# Timer and memory meter of one worker, measured by the parent.


class WorkerClock:
    """Sum of wall and processor seconds of a worker by activity."""

    def __init__(self, find: Callable[[], int | None]) -> None:
        """find: the worker's process id, None where it is not known."""
        self.spent: Seconds = {}
        self._find = find
        self._pid: int | None = None
        self._processor = 0.0

    @contextmanager
    def activity(self, activity: Activity) -> Generator[None]:
        """Count the time spent in this context."""
        begin, before = time.monotonic(), self._processor
        try:
            yield
        finally:
            self._processor = max(self._processor, self._processor_seconds())
            add_seconds(self.spent, activity, time.monotonic() - begin, self._processor - before)

    def restart(self) -> None:
        """Begin anew with what the worker uses from now on."""
        self.spent, self._processor = {}, self._processor_seconds()

    @contextmanager
    def elsewhere(self, activity: Activity) -> Generator[None]:
        """Leave the wall seconds in this context out of the running `activity`."""
        begin = time.monotonic()
        try:
            yield
        finally:
            add_seconds(self.spent, activity, begin - time.monotonic(), 0.0)

    def count_compiling(self, said: bytes) -> None:
        """Move JAX's time for tracing and compiling out of the requests in which it occurred.

        Args:
            said: report of the worker, bounded by the time measured here
        """
        if len(said) != COMPILED_BYTES:
            return
        # The activities of compiling requests without their compilation.
        counted_as = {"fit": Activity.FIT, "load": Activity.IMPORT, "simulate": Activity.SIMULATE}
        for request, times in zip(COMPILED, struct.iter_unpack("<2d", said), strict=True):
            activity = counted_as[request]
            for part, seconds in zip((Activity.TRACE, Activity.COMPILE), times, strict=True):
                wall, processor = self.spent.get(activity, (0.0, 0.0))
                if not (math.isfinite(seconds) and seconds > 0 and wall > 0):
                    continue
                share = min(1.0, seconds / wall)
                moved = share * wall, share * processor
                add_seconds(self.spent, part, *moved)
                self.spent[activity] = (wall - moved[0], processor - moved[1])

    def _processor_seconds(self) -> float:
        """Processor seconds that the worker has used; 0 where the system does not say."""
        if sys.platform != "linux":
            return 0.0
        with suppress(OSError):
            self._pid = self._pid or self._find()
            if self._pid is not None:
                # The kernel's clock of the processor time of a process.
                return time.clock_gettime(~self._pid << 3 | 2)
        return 0.0


def first_child(pid: int) -> int | None:
    """The oldest child of a process that has one thread; None without one."""
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text("ascii").split()
    except OSError:
        return None
    return int(children[0]) if children else None


def peak_memory_mb(pid: int | str | None) -> float | None:
    """The largest address space that a process has had, MB; None where the system does not say.
    pid: or `self`."""
    with suppress(OSError, ValueError, IndexError):
        text = Path(f"/proc/{pid}/status").read_text("ascii", "replace")
        return int(text.split("VmPeak:")[1].split()[0]) / 1024
    return None


class ResourceWatch:
    """Measures a worker until it uses more than it may, and ends it then: for a resource that no
    limit of the kernel holds here."""

    def __init__(
        self, measure: Callable[[], int], most: int, end: Callable[[], None], seconds: float
    ) -> None:
        """seconds: between two measurements."""
        self.exceeded = False
        self._measure, self._most, self._end, self._seconds = measure, most, end, seconds
        self._over = threading.Event()
        threading.Thread(target=self._look, name="resources", daemon=True).start()

    def close(self) -> None:
        """Look no more."""
        self._over.set()

    def _look(self) -> None:
        while not self._over.wait(self._seconds):
            if self._measure() > self._most:
                self.exceeded = True
                self._end()
                return


# A worker below a keeper, which ends all that the worker leaves behind. For levels that let a
# candidate start processes.


def start_kept(
    limits: Limits,
    layers: Collection[Layer],
    libraries: Collection[str],
    inside: Sequence[str] = (),
) -> WorkerProcess:
    """Start a worker below a keeper. libraries: to load ahead; inside: words put before its command
    line. Raises SandboxError."""
    home = tempfile.mkdtemp(prefix="asia-worker-")
    keeper = str(package_folder() / "judge" / "sandbox" / "worker" / "keeper.py")

    def command(requests: int, replies: int) -> list[str]:
        own = [interpreter(), "-I", "-S", "-B", keeper, str(requests), str(replies), home]
        return [*own, *inside, *child_command(requests, replies, limits, layers, libraries)]

    try:
        process, pipes = start(command, env=environment(home), cwd=home)
    except BaseException:
        shutil.rmtree(home, ignore_errors=True)
        raise

    def force() -> None:
        # The keeper does not respond: a candidate can stop it, as both have one user.
        while process.poll() is None and (offspring := descendants(process.pid, alive=True)):
            for pid in offspring:
                kill_quietly(pid)
        kill_quietly(process.pid)

    return WorkerProcess(
        process=process,
        pipes=pipes,
        # The keeper ends the worker when the request pipe closes, also if this process is killed.
        kill=lambda: None,
        force=force,
        tidy=lambda: shutil.rmtree(home, ignore_errors=True),
        beyond_reach=False,
        find=lambda: first_child(process.pid),
        guard=process.pid,
    )


# Cleanup of orphan processes of bubblewrap when this process is killed during the start of a
# worker.
#
# The inner half of bubblewrap waits for a word of the outer one before it ties its life to
# anything. Where the outer one dies first, as it does with this process, nothing else would ever
# end the inner one.


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
        with suppress(BrokenPipeError):
            self._process.stdin.write(self.mark.encode() + b"\n")

    def dismiss(self) -> None:
        """The worker has ended with all of bubblewrap."""
        self._process.kill()
        self.end_orphans()

    def end_orphans(self) -> None:
        """The outer half has ended, and perhaps alone; takes a second."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()
