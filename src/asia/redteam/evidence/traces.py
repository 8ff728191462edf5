"""Traces of an attack: surviving processes, files, and a changed neighbour."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

_PLACES = ("/tmp", "/dev/shm", "/var/tmp")
# Names of the attacks' traps, where a mark in the name would reveal them: files that bear it
# inside, links, pipes and devices.
_TRAPS = frozenset(
    (*(name + ".py" for name in ("conftest", "sitecustomize", "usercustomize")),
     "log.txt", "pending.txt", "model.bin")
)  # fmt: skip
_PATIENCE_SECONDS = 3.0
_AGAIN_SECONDS = 0.1
_MARKED_BYTES = 4096


@dataclass(frozen=True)
class Traces:
    """Detector of traces, made before the attack."""

    mark: str
    """Marker in the names of its processes and files."""
    key: int
    """The key of its shared memory."""
    playground: str
    """Folder that nothing else writes to."""
    pids: frozenset[int] = field(default_factory=lambda: frozenset(_pids()))
    """The processes that ran before it."""
    paths: frozenset[str] = field(init=False)
    """The files that there were before it, of those that could be taken for its own."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "paths", frozenset(self._found()))

    def survivors(self) -> tuple[str, ...]:
        """Processes of the attack that do not end. Those that bear its mark are ended."""
        end = time.monotonic() + _PATIENCE_SECONDS
        found = self._alive()
        while found and time.monotonic() < end:
            time.sleep(0.02)
            found = self._alive()
        for pid in found:
            with contextlib.suppress(OSError):
                if _name(pid) == self.mark:
                    os.kill(pid, signal.SIGKILL)
        return tuple(f"process {pid}" for pid in found)

    def strays(self) -> tuple[str, ...]:
        """Files and shared memory of the attack. Those that bear its mark are removed."""
        found = [path for path in self._found() if path not in self.paths]
        for path in found:
            with contextlib.suppress(OSError):
                if self._marked(path):
                    os.remove(path)
        memory = ["shared memory"] if _remove_shared_memory(self.key) else []
        return (*found, *memory)

    def _alive(self) -> list[int]:
        found: list[int] = []
        for pid in _pids():
            with contextlib.suppress(OSError):  # it has just ended
                if _name(pid) == self.mark or (pid not in self.pids and _lost(pid)):
                    found.append(pid)
        return found

    def _found(self) -> Iterator[str]:
        """Yield all files of the playground; in other folders, where other programs write too,
        marked ones and traps."""
        for folder, folders, files in os.walk(self.playground):
            yield from (os.path.join(folder, name) for name in (*folders, *files))
        for place in {os.getcwd(), str(Path.home()), tempfile.gettempdir(), *_PLACES}:
            with contextlib.suppress(OSError):
                for path in (os.path.join(place, name) for name in os.listdir(place)):
                    if self._marked(path) or _is_odd_trap(path):
                        yield path

    def _marked(self, path: str) -> bool:
        name = os.path.basename(path)
        if self.mark in name or name not in _TRAPS or not os.path.isfile(path):
            return self.mark in name
        with contextlib.suppress(OSError), open(path, "rb") as file:
            return self.mark.encode() in file.read(_MARKED_BYTES)
        return False


@dataclass(frozen=True)
class Neighbour:
    """A process that waits, in a session of its own, so that signals to our session do not reach
    it."""

    process: subprocess.Popen[bytes]
    """The process."""
    nice: int
    """Priority at the start."""

    @property
    def hurt(self) -> str:
        """Description of its end, stop or changed priority, at two observations; "" for no harm."""
        if not self._changed():
            return ""
        time.sleep(_AGAIN_SECONDS)
        return self._changed()

    def _changed(self) -> str:
        code, pid = self.process.poll(), self.process.pid
        if code is not None:
            return f"a neighbour ended with exit code {code}"
        if _stat(pid)[0] in "Tt":
            return "a neighbour stands still"
        nice = os.getpriority(os.PRIO_PROCESS, pid)
        return f"a neighbour runs at priority {nice}" if nice != self.nice else ""


@contextmanager
def neighbour(secret: str) -> Generator[Neighbour]:
    """One with a secret in its environment, ended at the end; if this process is killed, by the end
    of its pipe."""
    with subprocess.Popen(
        "/bin/cat",
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={"SECRET": secret},
        start_new_session=True,
    ) as process:
        try:
            yield Neighbour(process, os.getpriority(os.PRIO_PROCESS, process.pid))
        finally:
            process.kill()


def _is_odd_trap(path: str) -> bool:
    special = os.path.islink(path) or (os.path.exists(path) and not os.path.isfile(path))
    return os.path.basename(path) in _TRAPS and special


def _lost(pid: int) -> bool:
    """Return whether it is a Python of ours behind a worker's filter, which nothing that a worker
    starts can take off, and no evaluator is above it."""
    if not (_confined(pid) and _ours(pid)):
        return False
    parent = _parent(pid)
    while parent > 1 and (_confined(parent) or _name(parent) == "bwrap"):
        parent = _parent(parent)
    return parent <= 1 or not _ours(parent)


def _pids() -> list[int]:
    return [int(name) for name in os.listdir("/proc") if name.isdigit()]


def _confined(pid: int) -> bool:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return {"Seccomp:\t2", "NoNewPrivs:\t1"} <= {*lines}


def _ours(pid: int) -> bool:
    """Return whether it runs this Python; unknown, and so False, for a process of another user."""
    try:
        return os.path.samefile(f"/proc/{pid}/exe", sys.executable)
    except OSError:
        return False


def _name(pid: int) -> str:
    return Path(f"/proc/{pid}/comm").read_text().strip()


def _parent(pid: int) -> int:
    return int(_stat(pid)[1])


def _stat(pid: int) -> list[str]:
    """Return the fields of the process status from the state on, which is the third field."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


def _remove_shared_memory(key: int) -> bool:
    """Remove the segment of this key; whether there was one."""
    try:
        rows = Path("/proc/sysvipc/shm").read_text().splitlines()[1:]
    except OSError:
        return False
    segments = [int(row.split()[1]) for row in rows if int(row.split()[0]) == key]
    for segment in segments:
        ctypes.CDLL(None).shmctl(segment, 0, None)
    return bool(segments)
