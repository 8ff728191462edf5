"""Limit on the threads and processes of a worker.

A cgroup refuses more of them where this process may make one. Else RLIMIT_NPROC does inside a user
namespace, where Linux (5.14 and newer) counts the worker alone; root is exempt from it. Else a
watcher in the parent counts them and ends the worker, so that more can run for a moment.
"""

import itertools
import os
import re
import subprocess
import sys
import time
from contextlib import suppress
from enum import StrEnum
from functools import cache
from pathlib import Path

_PREFIX = "asia-"
_NUMBERS = itertools.count()
_REMOVE_SECONDS = 1.0


class PidsMechanism(StrEnum):
    """Mechanism that holds the limit, strongest first."""

    CGROUP = "cgroup"
    RLIMIT = "RLIMIT_NPROC"
    WATCHER = "watcher"


REMEDY = (
    "for a limit that the kernel holds: systemd-run --user --scope -p Delegate=yes asia run ..., "
    "or level namespace as an ordinary user on Linux 5.14 or newer"
)
"""Advice where a watcher holds the limit."""


def most_pids() -> int:
    """The most threads and processes of one worker. A fit with JAX has 16, whatever the machine."""
    return 256 + 8 * (os.cpu_count() or 1)


class PidsCgroup:
    """A cgroup that refuses to hold more than `most` threads and processes."""

    def __init__(self, most: int) -> None:
        """Raises OSError where it cannot be made."""
        above = _writable_cgroup()
        if above is None:
            raise FileNotFoundError("no cgroup with the pids controller can be written")
        self._place = above / f"{_PREFIX}{os.getpid()}-{next(_NUMBERS)}"
        self._place.mkdir()
        try:
            kind = self._place / "cgroup.type"
            if kind.exists():
                # A cgroup above that holds processes can divide their number alone.
                kind.write_text("threaded")
            (self._place / "pids.max").write_text(str(most))
        except OSError:
            self.close()
            raise

    def add(self, pid: int) -> None:
        """Move a process with all its threads; what it starts later is in it too. Raises
        OSError."""
        (self._place / "cgroup.procs").write_text(str(pid))

    @property
    def exceeded(self) -> bool:
        """Whether a thread or a process was refused."""
        with suppress(OSError):
            found = re.search(r"max (\d+)", (self._place / "pids.events").read_text())
            return found is not None and int(found[1]) > 0
        return False

    def close(self) -> None:
        """Remove it, once its processes have ended."""
        end = time.monotonic() + _REMOVE_SECONDS
        while True:
            try:
                self._place.rmdir()
                return
            except FileNotFoundError:
                return
            except OSError:
                if time.monotonic() > end:
                    return  # the next search removes it
                time.sleep(0.005)


@cache
def cgroup_works() -> bool:
    """Whether a process of this machine can be put into a cgroup with a limit, by trying it."""
    above = _writable_cgroup()
    if above is None:
        return False
    _remove_old(above)
    try:
        group = PidsCgroup(16)
    except OSError:
        return False
    try:
        with subprocess.Popen(["/bin/cat"], stdin=subprocess.PIPE, env={}, cwd="/") as process:
            try:
                group.add(process.pid)
                lines = Path(f"/proc/{process.pid}/cgroup").read_text()
                return f"/{_PREFIX}{os.getpid()}-" in lines
            finally:
                process.kill()
    except OSError:
        return False
    finally:
        group.close()


def _remove_old(above: Path) -> None:
    """Remove the cgroups of searches that were killed."""
    for place in above.glob(f"{_PREFIX}*-*"):
        pid = place.name.removeprefix(_PREFIX).partition("-")[0]
        if not Path("/proc", pid).exists():
            with suppress(OSError):
                place.rmdir()


@cache
def _writable_cgroup() -> Path | None:
    """The cgroup of this process, where it has the pids controller and this process may divide
    it."""
    if sys.platform != "linux":
        return None
    with suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            version = 2 if controllers == "" else 1
            if version == 1 and "pids" not in controllers.split(","):
                continue
            place = _mounted(version, path)
            if place is None or not os.access(place, os.W_OK):
                continue
            if version == 1 or _is_delegated(place, path):
                return place
    return None


def _mounted(version: int, path: str) -> Path | None:
    """Folder of a cgroup, None where its hierarchy is not mounted."""
    kind = "cgroup2" if version == 2 else "cgroup"
    for line in Path("/proc/self/mountinfo").read_text().splitlines():
        fields, _, rest = line.partition(" - ")
        root, point = fields.split()[3:5]
        filesystem, _, options = rest.split()[:3]
        if filesystem != kind or (version == 1 and "pids" not in options.split(",")):
            continue
        with suppress(ValueError):
            return Path(point) / Path(path).relative_to(root)
    return None


def _is_delegated(place: Path, path: str) -> bool:
    """Whether a cgroup of version 2 is this user's to divide: systemd marks such ones
    (`Delegate=yes`), and the one at the top of a container is."""
    marked = path == "/"
    for name in ("user.delegate", "trusted.delegate"):
        with suppress(OSError):
            marked = marked or os.getxattr(place, name) == b"1"
    try:
        if not marked or "pids" not in (place / "cgroup.controllers").read_text().split():
            return False
        enabled = place / "cgroup.subtree_control"
        if "pids" not in enabled.read_text().split():
            enabled.write_text("+pids")
        return True
    except OSError:
        return False


def count_tasks(pids: list[int]) -> int:
    """Number of threads of these processes; 0 where the system does not report it."""
    count = 0
    for pid in pids:
        with suppress(OSError, ValueError, IndexError):
            text = Path(f"/proc/{pid}/stat").read_text("ascii", "replace")
            count += int(text.rpartition(")")[2].split()[17])
    return count
