"""Timer and memory meter of one worker, measured by the parent."""

from __future__ import annotations

import math
import os
import struct
import sys
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from asia._stopwatch import Activity, Seconds, add_seconds
from asia.sandbox.worker.wire import COMPILED, COMPILED_BYTES

# Activity of a compiling request without its compilation.
_COUNTED_AS = {"fit": Activity.FIT, "load": Activity.IMPORT, "simulate": Activity.SIMULATE}
_OF_A_PROCESS = 2
_LOOK_SECONDS = 0.2


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
            self._processor = max(self._processor, self._now())
            add_seconds(self.spent, activity, time.monotonic() - begin, self._processor - before)

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
        numbers = struct.unpack(f"<{2 * len(COMPILED)}d", said)
        for place, request in enumerate(COMPILED):
            activity = _COUNTED_AS[request]
            for part, seconds in zip(
                (Activity.TRACE, Activity.COMPILE), numbers[2 * place :], strict=False
            ):
                wall, processor = self.spent.get(activity, (0.0, 0.0))
                if not (math.isfinite(seconds) and seconds > 0 and wall > 0):
                    continue
                share = min(1.0, seconds / wall)
                moved = share * wall, share * processor
                add_seconds(self.spent, part, *moved)
                self.spent[activity] = (wall - moved[0], processor - moved[1])

    def _now(self) -> float:
        """Processor seconds that the worker has used; 0 where the system does not say."""
        if sys.platform != "linux":
            return 0.0
        with suppress(OSError):
            self._pid = self._pid or self._find()
            if self._pid is not None:
                return time.clock_gettime(~self._pid << 3 | _OF_A_PROCESS)
        return 0.0


def first_child(pid: int) -> int | None:
    """The oldest child of a process that has one thread; None without one."""
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text("ascii").split()
    except OSError:
        return None
    return int(children[0]) if children else None


def peak_memory_mb(pid: int | None) -> float | None:
    """The largest address space that a process has had, MB; None where the system does not say."""
    with suppress(OSError, ValueError, IndexError):
        text = Path(f"/proc/{pid}/status").read_text("ascii", "replace")
        return int(text.split("VmPeak:")[1].split()[0]) / 1024
    return None


class MemoryWatch:
    """Looks at a process until it has more than so many MB in memory, and ends it then: for one
    that a limit on its address space would break."""

    def __init__(
        self, find: Callable[[], int | None], most_mb: int, end: Callable[[], None]
    ) -> None:
        """find: its process id."""
        self.exceeded = False
        self._find, self._most, self._end = find, most_mb * 1024 * 1024, end
        self._over = threading.Event()
        threading.Thread(target=self._look, name="memory", daemon=True).start()

    def close(self) -> None:
        """Look no more."""
        self._over.set()

    def _look(self) -> None:
        while not self._over.wait(_LOOK_SECONDS):
            if resident_bytes(self._find()) > self._most:
                self.exceeded = True
                self._end()
                return


def resident_bytes(pid: int | None) -> int:
    """Return the resident memory of a process; 0 where the system does not report it."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text("ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")
