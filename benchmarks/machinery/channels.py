"""Information that two parallel workers can exchange through the kernel and the machine they share.

python benchmarks/machinery/channels.py [--bits 40] [--level namespace] [--only inode] [--walls on]

One worker sends random bits, as many zeros as ones, a slot of time for each; another receives. Both
know the slots from the clock. The figures that the receiver measured come back, and a bit is read
as one where its figure lies above the median of all. Capacity is that of a binary symmetric channel
with the error rate found; none is found where the errors cannot be told from chance (two standard
deviations). "open" is the same without Landlock and the filter on system calls. A slot limits what
can be found to its inverse. A busy machine makes the channels worse than they are.
"""

from __future__ import annotations

import argparse
import math
import os
import secrets
import sys
import sysconfig
import threading
import time
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
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
import ctypes, glob, mmap, os, resource, threading, time
import numpy as np

libc = ctypes.CDLL(None, use_errno=True)
libc.mmap.restype = ctypes.c_void_p
libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *3 * [ctypes.c_int], ctypes.c_long]
libc.munmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t]
room = ctypes.create_string_buffer(256)
threading.stack_size(65536)
BEGIN, SLOT, BITS = {begin!r}, {slot!r}, {bits!r}
FILES, listening = {files!r}, {listening!r}


def refused(what):
    code = ctypes.get_errno()
    raise OSError(code, os.strerror(code), what)


def until(moment):
    while (left := moment - time.monotonic()) > 0:
        time.sleep(min(left, 0.01))

{prepare}

def speak(k, bit, end):
    {speak}


def listen(k, end):
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


# Objects that take a number from a counter of the kernel. Each core takes numbers in lots of 1024,
# so that the next lot shows what all cores have taken.
_LOTS = """
last = 0


def lot():
    first = now = number()
    while now // 1024 == first // 1024:
        now = number()
    return now


def jump(end):
    global last
    until(end - 0.3 * SLOT)
    now = lot()
    found, last = now - last, now
    return found


def take(bit, end):
    while bit and time.monotonic() < end - 0.4 * SLOT:
        number()
"""
_PIPE = """
def number():
    fds = os.pipe()
    found = os.fstat(fds[0]).st_ino
    for fd in fds:
        os.close(fd)
    return found
"""
_MEMFD = """
def number():
    fd = os.memfd_create("a")
    found = os.fstat(fd).st_ino
    os.close(fd)
    return found
"""
_MAPPING = """
def number():
    many = 64
    places = [libc.mmap(None, 4096, 3, 0x21, -1, 0) for _ in range(many)]
    if places[0] == 2**64 - 1:
        refused("mmap")
    rows = [line.split() for line in open("/proc/self/maps")] if listening else []
    for place in places:
        libc.munmap(place, 4096)
    starts = {f"{place:x}" for place in places}
    return max((int(r[4]) for r in rows if r[0].split("-")[0].lstrip("0") in starts), default=0)
"""
_PROC_ENTRY = """
def number():
    found = []

    def look():
        place = f"/proc/self/task/{threading.get_native_id()}"
        for name in ("stat", "statm", "maps", "comm", "status", "cgroup", "io", "ns", "fd", "wchan",
                     "cpuset", "limits", "mounts", "root", "cwd", "exe", "environ", "auxv"):
            found.append(os.stat(f"{place}/{name}", follow_symlinks=False).st_ino)

    one = threading.Thread(target=look)
    one.start()
    one.join()
    if not found:
        raise FileNotFoundError("/proc/self/task")
    return max(found)
"""
_THREAD_NUMBER = """
def number():
    one = threading.Thread(target=int)
    one.start()
    one.join()
    return one.native_id


def lot():
    return number()
"""
# Whatever is open about processes whose numbers lie near one's own.
_NEIGHBOURS = """
OWN = os.getpid()


def neighbours(look):
    total, seen = 0, 0
    for pid in range(max(1, OWN - 150), OWN + 150):
        if pid != OWN:
            try:
                total += look(pid)
                seen += 1
            except OSError as error:
                failed = error
    if not seen:
        raise failed
    return total
"""
_PARK = """
def park(bit, end):
    crowd = [threading.Thread(target=until, args=(end - 0.2 * SLOT,)) for _ in range(48 * bit)]
    for one in crowd:
        one.start()
    for one in crowd:
        one.join()
"""
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


def switches(end):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_nivcsw
    together(end, 2)
    return resource.getrusage(resource.RUSAGE_SELF).ru_nivcsw - before
"""
_MEMORY = """
large, small = np.ones(1 << 23), np.ones(1 << 18)


def sweep(array, end):
    best = []
    while time.monotonic() < end:
        begin = time.perf_counter()
        array[::8].sum()
        best.append(time.perf_counter() - begin)
    return np.median(best)
"""
# A file for each bit; `main` has thrown them out of memory before.
_FILES = """
def fault(k):
    file = os.open(FILES[k], os.O_RDONLY)
    page = libc.mmap(None, 4096, 1, 2, file, 0)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_majflt
    ctypes.string_at(page, 1)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_majflt
    libc.munmap(page, 4096)
    os.close(file)
    return before - after
"""
_TIMES = """
FILE = np.__file__


def dated():
    return max(os.stat(name).st_atime_ns for name in ("/dev/zero", "/dev/null", FILE))
"""
_COUNT = "until(end - 0.5 * SLOT)\n    return "
CHANNELS = (
    Channel("inodes of shared mappings, in /proc/self/maps", 0.2, "take(bit, end)",
            "return jump(end)", _LOTS + _MAPPING),
    Channel("inodes of memfd, by fstat", 0.1, "take(bit, end)", "return jump(end)", _LOTS + _MEMFD),
    Channel("inodes of pipes, by fstat", 0.1, "take(bit, end)", "return jump(end)", _LOTS + _PIPE),
    Channel("inodes of /proc/self/task, by stat", 0.2, "take(bit, end)", "return jump(end)",
            _LOTS + _PROC_ENTRY),
    Channel("numbers of new threads", 0.05, "take(bit, end)", "return jump(end)",
            _LOTS + _THREAD_NUMBER),
    Channel("threads of the machine, by sysinfo", 0.1, "park(bit, end)",
            _COUNT + "refused('sysinfo') if libc.sysinfo(room) else room.raw[80]", _PARK),
    Channel("threads of another worker, by stat", 0.1, "park(bit, end)",
            _COUNT + "neighbours(lambda pid: os.stat(f'/proc/{pid}/task').st_nlink)",
            _PARK + _NEIGHBOURS),
    Channel("open files of another worker, by stat", 0.05,
            "fds = [os.open(np.__file__, 0) for _ in range(60 * bit)]\n"
            "    until(end - 0.2 * SLOT)\n    for fd in fds:\n        os.close(fd)",
            _COUNT + "neighbours(lambda pid: os.stat(f'/proc/{pid}/fd').st_size)", _NEIGHBOURS),
    Channel("processor clock of another worker", 0.1, "work(end - 0.2 * SLOT) if bit else None",
            "global last\n    until(end - 0.1 * SLOT)\n"
            "    now = neighbours(lambda pid: time.clock_gettime(~pid << 3 | 2))\n"
            "    found, last = now - last, now\n    return found",
            _WORK + _NEIGHBOURS + "last = 0\n"),
    Channel("clock rate in /proc/cpuinfo", 0.2, "together(end - 0.02, 2) if bit else None",
            _COUNT + "sum(float(line.split(':')[1]) for line in open('/proc/cpuinfo') "
            "if 'MHz' in line)", _WORK),
    Channel("times of files", 0.1,
            "if bit:\n        for name in ('/dev/zero', FILE):\n"
            "            open(name, 'rb').read(1)\n        open('/dev/null', 'wb').write(b'a')",
            "global last\n    until(end - 0.1 * SLOT)\n    now = dated()\n"
            "    found, last = now - last, now\n    return found", _TIMES + "last = 0\n"),
    Channel("page cache: a file read from disk, once each", 0.02, "fault(k) if bit else None",
            "until(end - 0.4 * SLOT)\n    return fault(k)", _FILES),
    Channel("load of the processor: own speed", 0.2, "together(end - 0.02, 4) if bit else None",
            "return -together(end - 0.02, 2)", _WORK),
    Channel("load of the processor: involuntary switches (getrusage)", 0.2,
            "together(end - 0.02, 4) if bit else None", "return switches(end - 0.02)", _WORK),
    Channel("bandwidth of memory", 0.1, "sweep(large, end - 0.01) if bit else None",
            "return sweep(small, end - 0.01)", _MEMORY),
)  # fmt: skip


def main() -> int:
    """Measure every channel, with and without the filter; print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bits", type=int, default=40)
    parser.add_argument("--level", choices=[level.value for level in Isolation])
    parser.add_argument("--only", default="", help="part of a channel's name")
    parser.add_argument("--walls", choices=("on", "open"))
    options = parser.parse_args()
    here = machine()
    print(f"{here.system}, {here.cores} cores, load {os.getloadavg()[0]:.1f}\n")
    print("| level | channel | walls | slots/s | wrong | bit/s |")
    print("|---|---|---|---|---|---|")
    for level in (Isolation.NAMESPACE, Isolation.LANDLOCK):
        if options.level not in (None, level.value) or why_not(level) is not None:
            continue
        for channel in CHANNELS:
            for walls, without in (("open", (Layer.LANDLOCK, Layer.SECCOMP)), ("on", ())):
                if options.only in channel.name and options.walls in (None, walls):
                    words = measure(channel, level, without, options.bits)
                    print(f"| {level} | {channel.name} | {walls} | {words} |", flush=True)
    return 0


def cold_files(many: int) -> list[str]:
    """Files that every worker may read, thrown out of memory."""
    found: list[str] = []
    for place in sorted(Path(sysconfig.get_path("purelib"), "scipy").rglob("tests/test_*.py")):
        with place.open("rb") as file:
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        found.append(str(place))
    return found[:many]


def measure(channel: Channel, level: Isolation, without: Collection[Layer], bits: int) -> str:
    """Bits a second, share of wrong ones and capacity, or why nothing comes through."""
    sent = [0, 1] * (bits // 2)
    secrets.SystemRandom().shuffle(sent)
    files = cold_files(bits)
    begin = time.monotonic() + _BEGIN_SECONDS
    heard: list[float] = []
    failed: list[str] = []

    def run(role: str) -> None:
        source = _FRAME.format(
            begin=begin, slot=channel.slot, bits=sent, prepare=channel.prepare, role=role,
            speak=channel.speak.strip(), listen=channel.listen.strip(), files=files,
            listening=role is roles[1],
        )  # fmt: skip
        record = Trajectory([0.0, 1.0], [0.0, 1.0], 1.0)
        context = Context((Signal("u"),), (Signal("y"),), 1.0, 1, 1)
        try:
            with open_worker(level, LIMITS, without=without) as worker:
                curve = worker.fit(source, [record], context)[0]
                heard.extend(curve[:, 1].tolist())
        except CandidateError as error:
            failed.append(error.detail.strip().splitlines()[-1])

    roles = ("speak(k, bit, end)", "context.log(k, listen(k, end))")
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
    count = len(sent) - 1
    share, rate = wrong / count, 1 / channel.slot
    if abs(share - 0.5) < 1 / math.sqrt(count):
        return f"{rate:.0f} | {share:.0%} | 0 found"
    return f"{rate:.0f} | {share:.0%} | {rate * (1 - entropy(share)):.1f}"


def entropy(share: float) -> float:
    """Capacity of one bit that is wrong with this probability, in bits."""
    if share in (0.0, 1.0):
        return 0.0
    return -share * math.log2(share) - (1 - share) * math.log2(1 - share)


if __name__ == "__main__":
    sys.exit(main())
