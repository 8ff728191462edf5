"""Memory of large arrays goes back to the system when they are freed. Only the standard library is
imported here."""

import contextlib
import ctypes
import sys

LARGE_RECORDS = 4_000_000
"""Bytes of records from which this is worth its time."""


def give_back_large_arrays() -> None:
    """Let glibc return freed arrays of a few megabytes to the system.

    By default it keeps them, in each thread separately. Other systems are left as they are.
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            mmap_threshold, size = -3, 128 * 1024
            ctypes.CDLL(None).mallopt(mmap_threshold, size)
