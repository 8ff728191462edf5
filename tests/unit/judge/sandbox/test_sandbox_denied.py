"""System calls denied to a worker beyond files, by which two workers could communicate."""

import json
import os

import pytest

from asia.judge.sandbox.availability import open_worker, why_not
from asia.judge.sandbox.layers.seccomp import numbers
from asia.judge.sandbox.types import Isolation, Layer, Limits

WALLED = [
    pytest.param(level, marks=pytest.mark.skipif(reason is not None, reason=str(reason)))
    for level in (Isolation.NAMESPACE, Isolation.LANDLOCK)
    for reason in [why_not(level)]
]
# By name and arguments; `fd` is a library's file, null pointers make each fail without the filter.
CALLS = {
    "flock": "fd, 1",
    "mincore": "page, 4096, NULL",
    "fadvise64": "fd, 0, 0, -1",
    "readahead": "page, 0, 0",
    "preadv2": "fd, NULL, -1, 0, 0, 8",
    "pwritev2": "fd, NULL, -1, 0, 0, 8",
    "futex_waitv": "NULL, 0, -1, NULL, 0",
    "io_setup": "0, NULL",
    "sysinfo": "room",
    "pipe2": "room, 0",
    "eventfd2": "0, 0",
    "epoll_create1": "0",
    "timerfd_create": "1, 0",
    "signalfd4": "-1, room, 8, 0",
    "statfs": "b'/', room",
    "mmap shared": "NULL, 4096, 3, 0x21, -1, 0",
    "mmap shared and checked": "NULL, 4096, 1, 0x3, fd, 0",
    "mmap of /dev/zero": "NULL, 4096, 1, 0x1, os.open('/dev/zero', 0), 0",
    "mmap huge": "NULL, 4096, 3, 0x44022, -1, 0",
    "memfd_create": "b'a', 0",
    "capget": "room, NULL",
    "clock_gettime of 1": "~1 << 3 | 2, room",
    "clock_nanosleep of 1": "~1 << 3 | 2, 0, NULL, NULL",
    "madvise MADV_MERGEABLE": "page, 4096, 12",
    "madvise MADV_COLD": "page, 4096, 20",
    "madvise MADV_PAGEOUT": "page, 4096, 21",
    "fstatfs": "fd, room",
    "membarrier": "0, 0, 0",
    "getpgid": "1",
    "getsid": "1",
    "getpriority": "0, 1",
    "sched_getscheduler": "1",
    "sched_getparam": "1, room",
    "sched_rr_get_interval": "1, room",
    "get_robust_list": "1, room, room",
    "semop": "-1, NULL, 1",
    "semtimedop": "-1, NULL, 1, NULL",
    "msgsnd": "-1, NULL, 1, 0",
    "msgrcv": "-1, NULL, 1, 0, 0",
    **{
        f"fcntl {name}": f"fd, {command}, NULL"
        for name, command in {
            "F_GETLK": 5,
            "F_SETLK": 6,
            "F_SETLKW": 7,
            "F_OFD_GETLK": 36,
            "F_OFD_SETLK": 37,
            "F_OFD_SETLKW": 38,
            "F_SETLEASE": 1024,
            "F_GETLEASE": 1025,
            "F_NOTIFY": 1026,
            "F_SETPIPE_SZ": 1031,
        }.items()
    },
    **{
        f"ioctl {name}": f"fd, {request}, NULL"
        for name, request in {
            "FS_IOC_SETFLAGS": 0x40086602,
            "FS_IOC32_SETFLAGS": 0x40046602,
            "FS_IOC_FSSETXATTR": 0x401C5820,
            "FS_IOC_SETVERSION": 0x40087602,
            "FICLONE": 0x40049409,
            "FIOASYNC": 0x5452,
        }.items()
    },
    "futex CMP_REQUEUE": "page, 4, 0, 0, page, 0",
}
SHORT_WAIT = "page, OPERATION, word, ctypes.byref((ctypes.c_long * 2)(0, 1000)), NULL, -1"
WAITS = {
    "futex WAIT": SHORT_WAIT.replace("OPERATION", "0"),
    "futex WAIT_BITSET": SHORT_WAIT.replace("OPERATION", "9"),
}
ALLOWED = {
    "fcntl F_GETFL": "fd, 3, NULL",
    "ioctl FIOCLEX": "fd, 0x5451, NULL",
    "futex WAKE": "page, 1, 1",
    "futex WAKE_PRIVATE": "page, 129, 1",
}
TRY_ALL = """
import ctypes, errno, json, mmap, os, numpy as np
libc = ctypes.CDLL(None, use_errno=True)
libc.mmap.restype, libc.syscall.restype = ctypes.c_void_p, ctypes.c_long
fd, NULL = os.open(np.__file__, os.O_RDONLY), None
room = ctypes.create_string_buffer(512)
page = libc.mmap(NULL, ctypes.c_long(4096), mmap.PROT_READ, mmap.MAP_PRIVATE, fd, ctypes.c_long(0))
word = ctypes.c_uint.from_address(page).value

def call(number, *words):
    whole = [ctypes.c_long(w) if isinstance(w, int) else w for w in words]
    result = libc.syscall(ctypes.c_long(number), *whole)
    return errno.errorcode[ctypes.get_errno()] if result < 0 else "done"

def opened(path):
    try:
        return open(path, "rb").read(1) and "done"
    except OSError as error:
        return errno.errorcode[error.errno]

def fit(trajectories, context):
    ends = {n: eval(f"call({NUMBERS[n.split()[0]]}, {w})") for n, w in CALLS.items()}
    ends |= {path: opened(path) for path in (*PLACES, "/proc/cpuinfo")}
    timer = ctypes.c_void_p()
    ends["timer"] = "done" if libc.timer_create(0, NULL, ctypes.byref(timer)) == 0 else "refused"
    thread, short = ctypes.c_ulong(), ctypes.c_void_p(20_000)
    libc.pthread_create(ctypes.byref(thread), NULL, libc.usleep, short)
    ends["join"] = libc.pthread_join(thread, NULL)
    print(json.dumps(ends))
    return Model()

class Model:
    def simulate(self, past_u, past_y, u):
        return u
"""
PLACES = (
    *(f"/proc/self/{n}" for n in ("status", "net/dev", "maps", "stat", "statm", "wchan")),
    *(f"/proc/{n}" for n in ("stat", "meminfo", "loadavg", "vmstat", "sys/fs/inode-nr")),
)


def ends(case, level: Isolation, *without: Layer) -> dict[str, str | int]:
    """Return the result of each call by its name."""
    given = {
        "NUMBERS": numbers(os.uname().machine),
        "CALLS": CALLS | WAITS | ALLOWED,
        "PLACES": PLACES,
    }
    source = "\n".join(f"{name} = {value!r}" for name, value in given.items()) + TRY_ALL
    with open_worker(level, Limits(30.0, 30.0, 2048), without=without) as worker:
        return json.loads(worker.fit(source, case.trajectories, case.context)[1])


@pytest.mark.parametrize("level", WALLED)
def test_calls_between_workers_are_refused(case, level):
    found = ends(case, level)
    assert {name for name in CALLS if found[name] != "EPERM"} == set()
    # No wait that another worker could end; the first comes back as a number, the call's own on
    # x86-64, after a sleep, the second at once.
    assert [found[name] for name in WAITS] == ["done", "EAGAIN"]
    assert {found[name] for name in ALLOWED} == {"done"}
    refusal = "ENOENT" if level is Isolation.NAMESPACE else "EACCES"
    assert {found[place] for place in PLACES} == {refusal}
    assert found["/proc/cpuinfo"] == "done"
    assert found["timer"] == "refused"
    assert found["join"] == 0


@pytest.mark.parametrize("level", WALLED)
def test_nothing_but_the_layers_refuses_them(case, level):
    """Namespaces alone allow these calls; the files of /proc do not exist in them."""
    found = ends(case, level, Layer.LANDLOCK, Layer.SECCOMP, Layer.RLIMITS)
    # Whose list this is the kernel itself asks.
    assert {name for name in CALLS if found[name] == "EPERM"} <= {"get_robust_list"}
    assert [found[name] for name in WAITS] == ["ETIMEDOUT", "ETIMEDOUT"]
    refusal = "ENOENT" if level is Isolation.NAMESPACE else "done"
    assert {found[place] for place in PLACES} == {refusal}
    assert found["timer"] == "done"
