"""Landlock: restrict this process to the listed files. Linux 5.13 and later.

All rights that the running kernel knows are taken away; reading below some folders and writing to a
few devices is allowed again. Besides files: TCP (ABI 4), abstract sockets and signals to processes
outside (ABI 6), and the memory and environment of other processes. Not covered: whether a file
exists and how large it is, its attributes, UDP, new processes; the system call filter has the rest.
Only the standard library is imported here.
"""

import ctypes
import errno
import os
import stat
import struct
from collections.abc import Iterable

# The same numbers on every architecture.
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_VERSION, _PATH_BENEATH = 1, 1
_WRITE_FILE, _READ_FILE, _READ_DIR = 1 << 1, 1 << 2, 1 << 3
_ALL_OF_ABI_1 = (1 << 13) - 1
_RENAME_ACROSS, _TRUNCATE, _DEVICE_CONTROL = 1 << 13, 1 << 14, 1 << 15  # since ABI 2, 3, 5
_TCP, _SCOPES = 0b11, 0b11
_PR_SET_NO_NEW_PRIVS = 38


def abi() -> int:
    """Version of the kernel's Landlock. Raises OSError where there is none that can be used."""
    return _call(_CREATE_RULESET, 0, 0, _VERSION)


def why_not() -> str | None:
    """None if the kernel offers Landlock to this process, else the reason in plain words."""
    try:
        abi()
    except OSError as error:
        match error.errno:
            case errno.ENOSYS:
                return "this kernel has no Landlock (it came with Linux 5.13)"
            case errno.EOPNOTSUPP:
                return "Landlock is switched off at boot"
            case _:
                return f"Landlock was refused: {error.strerror}"
    return None


def restrict(readable: Iterable[str], writable: Iterable[str]) -> None:
    """Bind the calling thread and all that it starts; threads that run already stay free.

    Missing paths are left out.

    Args:
        readable: files, and folders with all below them
        writable: files to read and write

    Raises:
        OSError: if the kernel refuses
    """
    version = abi()
    files = _ALL_OF_ABI_1
    files |= _RENAME_ACROSS if version >= 2 else 0
    files |= _TRUNCATE if version >= 3 else 0
    files |= _DEVICE_CONTROL if version >= 5 else 0
    attributes = struct.pack("@Q", files)
    attributes += struct.pack("@Q", _TCP) if version >= 4 else b""
    attributes += struct.pack("@Q", _SCOPES) if version >= 6 else b""
    ruleset = _call(_CREATE_RULESET, attributes, len(attributes), 0)
    try:
        for place in readable:
            _allow(ruleset, place, _READ_FILE | _READ_DIR)
        for place in writable:
            _allow(ruleset, place, _READ_FILE | _WRITE_FILE)
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) != 0:
            raise OSError(ctypes.get_errno(), "no_new_privs was refused")
        _call(_RESTRICT_SELF, ruleset, 0)
    finally:
        os.close(ruleset)


def _allow(ruleset: int, place: str, rights: int) -> None:
    try:
        fd = os.open(place, os.O_PATH | os.O_CLOEXEC)
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return
    try:
        if not stat.S_ISDIR(os.fstat(fd).st_mode):
            rights &= ~_READ_DIR
        _call(_ADD_RULE, ruleset, _PATH_BENEATH, struct.pack("=Qi", rights, fd), 0)
    finally:
        os.close(fd)


def _call(number: int, *arguments: int | bytes) -> int:
    libc = ctypes.CDLL(None, use_errno=True)
    words = [ctypes.c_long(a) if isinstance(a, int) else a for a in arguments]
    result = int(libc.syscall(ctypes.c_long(number), *words))
    if result < 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))
    return result
