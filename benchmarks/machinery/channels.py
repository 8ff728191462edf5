"""Information that two parallel workers can exchange through the machine that they share.

python benchmarks/machinery/channels.py [--bits 64] [--level namespace]

One worker speaks random bits, as many zeros as ones, a slot of time for each; another listens. Both
know the slots from the clock. What the listener measured comes back, and a bit is read as one where
its figure lies above the median of all. Capacity is that of a binary symmetric channel with the
errors found. "open" is the same without the filter on system calls. A busy machine makes the
channels worse than they are.
"""

from __future__ import annotations

import argparse
import math
import secrets
import sys
import threading
import time
from dataclasses import dataclass
from statistics import median

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.errors import CandidateError
from asia.judge.sandbox.availability import machine, open_worker, why_not
from asia.judge.sandbox.types import Isolation, Layer, Limits

LIMITS = Limits(300.0, 60.0, 4096)
# Both workers have started by then.
_BEGIN_SECONDS = 8.0
_FRAME = """
import ctypes, os, threading, time
import numpy as np

libc = ctypes.CDLL(None, use_errno=True)
room = ctypes.create_string_buffer(256)
BEGIN, SLOT, BITS = {begin!r}, {slot!r}, {bits!r}


def until(moment):
    while (left := moment - time.monotonic()) > 0:
        time.sleep(min(left, 0.01))

{prepare}

def speak(bit, end):
    {speak}


def listen(start, end):
    {listen}


class Model:
    def simulate(self, past_u, past_y, u):
        return u


def fit(trajectories, context):
    if time.monotonic() > BEGIN:
        raise RuntimeError("too late")
    for k, bit in enumerate(BITS):
        start, end = BEGIN + k * SLOT, BEGIN + (k + 1) * SLOT
        until(start)
        {role}
    return Model()
"""


@dataclass(frozen=True)
class Channel:
    """One way to tell a bit."""

    name: str
    """For the table."""
    slot: float
    """Seconds for each bit."""
    speak: str
    """Send a one, until `end`."""
    listen: str
    """Listen, and return a number that is larger after a one."""
    prepare: str = ""
    """Definitions of both."""


_WORK = """
matrix = np.ones((160, 160))


def work(end):
    rounds = 0
    while time.monotonic() < end:
        matrix @ matrix
        rounds += 1
    return rounds


def together(end, many):
    done = []
    crowd = [threading.Thread(target=lambda: done.append(work(end))) for _ in range(many)]
    for one in crowd:
        one.start()
    for one in crowd:
        one.join()
    return sum(done)
"""
_THREADS = """
    crowd = [threading.Thread(target=until, args=(end - 0.2 * SLOT,)) for _ in range(48 * bit)]
    for one in crowd:
        one.start()
    for one in crowd:
        one.join()
"""
_SHORT_LIVED = """
    for _ in range(300 * bit):
        one = threading.Thread(target=int)
        one.start()
        one.join()
"""
_SYSINFO = """
    until((start + end) / 2)
    if libc.sysinfo(room):
        raise PermissionError("sysinfo")
    return int.from_bytes(room.raw[80:82], "little")
"""
_PIPES = """
    for _ in range(1500 * bit):
        for fd in os.pipe():
            os.close(fd)
"""
_INODE = """
    global last
    until(end - 0.1 * SLOT)
    seen = []
    for _ in range(2):
        fds = os.pipe()
        seen.append(os.fstat(fds[0]).st_ino)
        for fd in fds:
            os.close(fd)
    jump, last = max(seen) - last, max(seen)
    return jump
"""
_THREAD_NUMBER = """
    global last
    until(end - 0.1 * SLOT)
    one = threading.Thread(target=int)
    one.start()
    jump, last = one.native_id - last, one.native_id
    one.join()
    return jump
"""
CHANNELS = (
    Channel("thread count (sysinfo)", 0.1, _THREADS, _SYSINFO),
    Channel("inode numbers of pipes", 0.1, _PIPES, _INODE, "last = 0"),
    Channel("numbers of threads", 0.1, _SHORT_LIVED, _THREAD_NUMBER, "last = 0"),
    Channel(
        "load of the processor",
        0.2,
        "if bit:\n        together(end - 0.02, 4)",
        "return -together(end - 0.02, 2)",
        _WORK,
    ),
)


def main() -> int:
    """Measure every channel, with and without the filter; print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bits", type=int, default=64)
    parser.add_argument("--level", choices=[level.value for level in Isolation])
    options = parser.parse_args()
    here = machine()
    print(f"{here.system}, {here.cores} cores, Python {here.python}\n")
    print("| level | channel | filter | bit/s | wrong | capacity, bit/s |")
    print("|---|---|---|---|---|---|")
    for level in (Isolation.NAMESPACE, Isolation.LANDLOCK):
        if options.level not in (None, level.value) or why_not(level) is not None:
            continue
        for channel in CHANNELS:
            for layer in (Layer.SECCOMP, None):
                words = measure(channel, level, layer, options.bits)
                print(f"| {level} | {channel.name} | {'open' if layer else 'on'} | {words} |")
                sys.stdout.flush()
    return 0


def measure(channel: Channel, level: Isolation, without: Layer | None, bits: int) -> str:
    """Bits a second, share of wrong ones and capacity, or why nothing comes through."""
    sent = [0, 1] * (bits // 2)
    secrets.SystemRandom().shuffle(sent)
    begin = time.monotonic() + _BEGIN_SECONDS
    heard: list[float] = []
    failed: list[str] = []

    def run(role: str) -> None:
        source = _FRAME.format(
            begin=begin, slot=channel.slot, bits=sent, prepare=channel.prepare, role=role,
            speak=channel.speak.strip(), listen=channel.listen.strip(),
        )  # fmt: skip
        record = Trajectory([0.0, 1.0], [0.0, 1.0], 1.0)
        context = Context((Signal("u"),), (Signal("y"),), 1.0, 1, 1)
        leave_out = () if without is None else (without,)
        try:
            with open_worker(level, LIMITS, without=leave_out) as worker:
                curve = worker.fit(source, [record], context).curve
                heard.extend(curve[:, 1].tolist())
        except CandidateError as error:
            failed.append(error.detail.strip().splitlines()[-1])

    roles = ("speak(bit, end)", "context.log(k, listen(start, end))")
    threads = [threading.Thread(target=run, args=(role,)) for role in roles]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failed:
        return f"- | - | 0 ({failed[0]})"
    middle = median(heard[1:])
    wrong = sum(
        (value > middle) != bool(bit) for value, bit in zip(heard[1:], sent[1:], strict=True)
    )
    share = wrong / (len(sent) - 1)
    rate = 1 / channel.slot
    return f"{rate:.0f} | {share:.0%} | {rate * (1 - entropy(share)):.1f}"


def entropy(share: float) -> float:
    """Capacity of one bit that is wrong with this probability, in bits."""
    if share in (0.0, 1.0):
        return 0.0
    return -share * math.log2(share) - (1 - share) * math.log2(1 - share)


if __name__ == "__main__":
    sys.exit(main())
