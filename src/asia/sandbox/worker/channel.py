"""The parent's end of a worker's pipes: framed, bounded, and under one deadline."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pickle
import re
import secrets
import select
import time
from collections.abc import Callable
from dataclasses import dataclass

from asia._text import printable
from asia.sandbox.worker.process import Pipes
from asia.sandbox.worker.wire import (
    LARGE_BYTES,
    LENGTH,
    REPLY_HEAD,
    REQUEST_HEAD,
    TOKEN_BYTES,
    ReplyKind,
)

_KEPT_BEGINNING = 16 * 1024
# With the line between them all stays within 64 KiB.
_KEPT_END = 48 * 1024 - 64
_LARGEST_OUTPUT = 4 * 1024 * 1024
_SLICE_SECONDS = 0.1
# Messages of libraries about a system call that the sandbox denies; not from a candidate.
_OF_THE_SANDBOX = re.compile(r"^\[mutex\.cc : \d+\] RAW: .*\n?", re.MULTILINE)
_PIPE_BYTES = 1024 * 1024
_F_SETPIPE_SZ = getattr(fcntl, "F_SETPIPE_SZ", None)


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
        for fd in (pipes.requests, pipes.replies, pipes.output):
            os.set_blocking(fd, False)
        if _F_SETPIPE_SZ is not None:
            for fd in (pipes.requests, pipes.replies):
                with contextlib.suppress(OSError):
                    fcntl.fcntl(fd, _F_SETPIPE_SZ, _PIPE_BYTES)

    def new_token(self) -> bytes:
        """Token for the next request. Raises UnsolicitedError, GoneError."""
        if select_one(self._replies):
            raise UnsolicitedError if os.read(self._replies, 1) else GoneError
        self._token = secrets.token_bytes(TOKEN_BYTES)
        return self._token

    def send(self, request: object, deadline: float) -> None:
        """Send one request. Raises LateError, GoneError."""
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
            done = 0
            while done < len(data):
                self._wait(self._requests, select.POLLOUT, deadline)
                try:
                    done += os.write(self._requests, data[done : done + _PIPE_BYTES])
                except BlockingIOError:
                    continue
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
        done = 0
        while done < len(data):
            self._wait(self._replies, select.POLLIN, deadline)
            try:
                count = os.readv(self._replies, [data[done : done + _PIPE_BYTES]])
            except BlockingIOError:
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
        return _OF_THE_SANDBOX.sub("", printable(f"{beginning}{between}{end}"))

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
            poller = select.poll()
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


def select_one(fd: int, event: int = select.POLLIN) -> bool:
    """Return whether `fd` has something to tell, end of file included."""
    poller = select.poll()
    poller.register(fd, event)
    return bool(poller.poll(0))
