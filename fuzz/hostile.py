"""A worker that answers whatever a fuzzer likes, and the parent's end of it."""

from __future__ import annotations

import os
from unittest import mock

import numpy as np

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.judge.sandbox.types import Limits
from asia.judge.sandbox.worker import process as channel
from asia.judge.sandbox.worker.process import Pipes, WorkerProcess
from asia.judge.sandbox.worker.worker import Worker

_TOKEN = b"\xa5sesame\x5a"
_SOURCE = "def fit(trajectories, context):\n    return None\n"


def parse_frames(data: bytes) -> None:
    """The parent's end of a worker, all requests in turn."""
    signals = (Signal("u"),), (Signal("y"),)
    context = Context(*signals, 0.5, 1, 1)
    record = Trajectory(np.zeros((12, 1)), np.zeros((12, 1)), 0.5, "r")
    past, u = np.zeros((2, 1, 1)), np.zeros((2, 3, 1))
    mode, script = data[:1] or b"\0", data[1:]
    with (
        mock.patch.object(channel.secrets, "token_bytes", lambda size: _TOKEN * (size // 8)),
        mock.patch.object(channel, "_SLICE_SECONDS", 0.001),
    ):
        hostile = _Hostile(script)
        try:
            if mode[0] % 2:
                hostile.worker.load(_SOURCE, b"model", context)
            else:
                score = (lambda model, deadline: float(len(model))) if mode[0] & 2 else None
                hostile.worker.fit(_SOURCE, [record], context, score)
                hostile.worker.dump()
            y = hostile.worker.simulate(past, past, u)
            assert y.shape == (2, 3, 1)
            assert np.isfinite(y).all()
            hostile.worker.count_compiling()
            assert all(0 <= s < np.inf for pair in hostile.worker.spent.values() for s in pair)
        finally:
            hostile.close()


def seeds() -> tuple[bytes, ...]:
    part = b"\xff\xff"
    begun, done = b"\1\1\0", b"\1\0\0"
    curve, model = bytes(32), b"model"
    words = b"\1\4\0Traceback: ValueError"
    shape = b"\1\7\0" + np.array([2, 3, 9], "<i8").tobytes()
    frame = b"\xfe\xfe"
    fitted = begun + frame + done + curve
    asks = b"\1\x08\0" + model
    # A model with steps answers samples, one without them a request for each prefix.
    steps = part.join([done + b"\1", frame.join([done + bytes(16)] * 3)])
    y = part.join([done + b"\0", *[done + bytes(48)] * 3])
    return (
        b"\0" + part.join([fitted, done + model, steps]),
        b"\2" + part.join([begun + frame + asks, done + curve, done + model, y]),
        b"\1" + part.join([done, steps, done + bytes(48)]),
        b"\1" + part.join([done, y, done + bytes(48)]),
        b"\1" + part.join([done, done + b"\1", shape]),
        b"\1" + part.join([done, done + b"\0", words]),
        b"\0" + part.join([words]),
        b"\0" + part.join([begun + frame + b"\1\0\1" + b"\xfd" * 8]),
    )


class _Ended:
    """A process that is no more."""

    pid = 0
    returncode = 1

    def poll(self) -> int:
        return 1

    def wait(self, timeout: float | None = None) -> int:
        return 1


class _Hostile:
    """A worker that answers from a script: each order is answered with the next part of it.

    Parts are split at ff ff, the frames of one at fe fe.
    """

    def __init__(self, script: bytes) -> None:
        self._parts = script.split(b"\xff\xff")
        ends = [os.pipe() for _ in range(3)]
        self._orders, (self._in, self._out), (output, self._print) = ends[0], *ends[1:]
        pipes = Pipes(self._orders[1], self._in, output)

        def nothing() -> None:
            pass

        started = WorkerProcess(
            _Ended(), pipes, nothing, nothing, nothing, beyond_reach=True, find=lambda: None  # type: ignore[arg-type]
        )  # fmt: skip
        self.worker = Worker(started, Limits(0.5, 0.5, 4096, model_mb=1))
        self.worker._channel.send = self._answer  # type: ignore[method-assign]
        # No candidate is there before this: a start that fails is nobody's.
        os.write(self._out, bytes([1]) + bytes(16))

    def _answer(self, body: bytes, deadline: float) -> None:
        if not self._parts or self._out < 0:
            self._end()
            return
        for part in self._parts.pop(0)[:60_000].split(b"\xfe\xfe"):
            os.write(self._out, _framed(part))
            os.write(self._print, part[:1000])
        if not self._parts:
            self._end()

    def _end(self) -> None:
        if self._out >= 0:
            os.close(self._out)
            self._out = -1

    def close(self) -> None:
        """Free all pipes."""
        self.worker.close()
        self._end()
        for fd in (*self._orders[:1], self._print):
            os.close(fd)


def _framed(part: bytes) -> bytes:
    """Raw after an even byte; after an odd one with the right token, the status in the next byte
    and a length that is told as it is or, after one more odd byte, in the next eight."""
    if not part or part[0] % 2 == 0:
        return part[1:]
    status, lies, body = part[1:2] or b"\0", len(part) > 2 and part[2] % 2, part[3:]
    told = body[:8].ljust(8, b"\0") if lies else len(body).to_bytes(8, "little")
    return status + _TOKEN + told + body
