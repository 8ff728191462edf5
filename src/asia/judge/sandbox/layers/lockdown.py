"""Lockdown of a process: no capabilities, then Landlock, then the filter on system calls.

Called by the worker before it imports modules that start threads, because Landlock binds the
calling thread only. Also a script that tests whether all layers hold here. Arguments of the script:
the layers, then a folder to read.
"""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import os
import signal
import struct
import sys
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from asia.judge.sandbox.layers import landlock, seccomp
else:
    # Imported as neighbours: their package imports modules that only the parent needs.
    sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
    import landlock
    import seccomp

    del sys.path[0]

NAMESPACES, LANDLOCK, SECCOMP, RLIMITS = "namespaces", "landlock", "seccomp", "rlimits"
WRITABLE = ("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom")
_CAPABILITY_VERSION_3 = 0x20080522
_PR_SET_PDEATHSIG = 1
_CLONE_VM = 0x100
_AF_UNIX, _SOCK_STREAM = 1, 1


def confine(layers: Collection[str], readable: Sequence[str]) -> None:
    """Apply these layers permanently.

    The process also ends with its parent from here on, which it cannot undo under the filter.

    Raises:
        OSError, RuntimeError: where a thread would stay out
    """
    if LANDLOCK not in layers and SECCOMP not in layers:
        return
    libc = ctypes.CDLL(None, use_errno=True)
    if not _is_alone(libc):
        raise RuntimeError("several threads run already; Landlock would bind one of them")
    head = struct.pack("@Ii", _CAPABILITY_VERSION_3, 0)
    if libc.capset(head, bytes(24)) != 0:
        raise OSError(ctypes.get_errno(), "capabilities could not be dropped")
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if LANDLOCK in layers:
        landlock.restrict(readable, WRITABLE)
    if SECCOMP in layers:
        seccomp.install()


def _is_alone(libc: ctypes.CDLL) -> bool:
    """Whether this process has one thread. Some containers deny the question, and they show
    /proc."""
    try:
        return len(os.listdir("/proc/self/task")) == 1
    except FileNotFoundError:
        return libc.unshare(_CLONE_VM) == 0


def holds(layers: Collection[str], folder: str) -> str | None:
    """None if this process, once confined, is stopped where it must be and only there."""
    try:
        os.listdir(folder)
    except OSError as error:
        return f"{folder} cannot be read inside: {error.strerror}"
    if LANDLOCK in layers:
        try:
            os.listdir("/")
            return "Landlock is in force and stops nothing"
        except PermissionError:
            pass
    if SECCOMP in layers:
        if ctypes.CDLL(None).socket(_AF_UNIX, _SOCK_STREAM, 0) >= 0:
            return "the filter on system calls is in force and stops nothing"
        with contextlib.suppress(OSError):
            mmap.mmap(-1, mmap.PAGESIZE, mmap.MAP_SHARED).close()
            return "memory can be shared with other processes"
    if LANDLOCK in layers:
        with contextlib.suppress(OSError), open("/proc/self/maps", "rb"):
            return "files of /proc other than cpuinfo can be read"
    if NAMESPACES in layers and os.path.exists("/proc/self"):
        return "/proc shows processes"
    return None


if __name__ == "__main__":
    _layers = sys.argv[1].split(",")
    try:
        confine(_layers, [sys.argv[2]])
        sys.exit(holds(_layers, sys.argv[2]))
    except (OSError, RuntimeError) as _error:
        sys.exit(str(_error))
