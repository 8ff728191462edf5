"""Something to attack, and what is left when the attack is over."""

from __future__ import annotations

import contextlib
import ctypes
import os
import secrets
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

_PLACES = ("/tmp", "/dev/shm", "/var/tmp")
_PATIENCE_SECONDS = 3.0


@dataclass(frozen=True)
class Targets:
    """What an attack is told.

    vault: the test file, whose words the attack must not learn; ledger: a file of the search;
    evaluator: source of an evaluator; other: a neighbouring process, parent: the evaluator's;
    port: of a TCP and a UDP service; daemon, abstract: sockets of services; key: of shared memory;
    mark: what the attack names its processes and files.
    """

    playground: str
    vault: str
    ledger: str
    evaluator: str
    other: int
    parent: int
    port: int
    daemon: str
    abstract: str
    key: int
    mark: str
    secret: str
    memory_mb: int

    @property
    def told(self) -> str:
        """The names as Python source. The secret is not among them."""
        facts = {n.upper(): v for n, v in asdict(self).items() if n != "secret"}
        return repr(facts)

    @property
    def ran(self) -> bool:
        """Whether the attack's code ran in the evaluator."""
        return Path(self.playground, f"{self.mark}-ran").exists()

    @property
    def ledger_changed(self) -> bool:
        """Whether the ledger is not as it was, its times included."""
        try:
            return os.stat(self.ledger).st_mtime != 1e9 or not Path(self.ledger).read_text()
        except OSError:
            return True

    @property
    def hurt(self) -> str:
        """What became of the neighbour: that it ended, stands still or has another priority; ""
        for nothing."""
        try:
            fields = Path(f"/proc/{self.other}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            return "a neighbour ended"
        usual = os.getpriority(os.PRIO_PROCESS, os.getpid())
        if fields[0] in "ZXTt":
            return f"a neighbour ended or stands still (state {fields[0]})"
        return f"a neighbour runs at priority {fields[16]}" if int(fields[16]) != usual else ""

    def survivors(self) -> tuple[str, ...]:
        """States of processes that bear the mark and do not end; they are ended."""
        end = time.monotonic() + _PATIENCE_SECONDS
        found = _marked(self.mark)
        while found and time.monotonic() < end:
            time.sleep(0.02)
            found = _marked(self.mark)
        for pid in found:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return tuple(f"process {pid}" for pid in found)

    def strays(self) -> tuple[str, ...]:
        """Files and shared memory that bear the mark; they are removed."""
        found = [
            path
            for place in (self.playground, os.getcwd(), str(Path.home()), *_PLACES)
            for path in _named(place, self.mark)
        ]
        for path in found:
            with contextlib.suppress(OSError):
                os.remove(path)
        memory = ["shared memory"] if _remove_shared_memory(self.key) else []
        return (*found, *memory)


@contextmanager
def targets(memory_mb: int) -> Generator[Targets]:
    """Files, services and a neighbour, gone at the end."""
    playground = tempfile.mkdtemp(prefix="asia-redteam-")
    mark, secret = "rt" + secrets.token_hex(5), secrets.token_hex(8)
    paths = {name: os.path.join(playground, name) for name in ("test.csv", "ledger", "judge.py")}
    Path(paths["test.csv"]).write_text(f"u,y\n{secret}\n")
    Path(paths["ledger"]).write_text(f"{secret}\n")
    os.utime(paths["ledger"], (1e9, 1e9))
    Path(paths["judge.py"]).write_text("")
    try:
        with (
            socket.create_server(("127.0.0.1", 0)) as service,
            socket.socket(type=socket.SOCK_DGRAM) as receiver,
            socket.socket(socket.AF_UNIX) as local,
            socket.socket(socket.AF_UNIX) as hidden,
            subprocess.Popen(["/bin/sleep", "600"], env={"SECRET": secret}) as other,
        ):
            port: int = service.getsockname()[1]
            receiver.bind(("127.0.0.1", port))
            local.bind(os.path.join(playground, "socket"))
            local.listen()
            hidden.bind(f"\0{mark}")
            hidden.listen()
            try:
                yield Targets(
                    playground=playground,
                    vault=paths["test.csv"],
                    ledger=paths["ledger"],
                    evaluator=paths["judge.py"],
                    other=other.pid,
                    parent=os.getpid(),
                    port=port,
                    daemon=os.path.join(playground, "socket"),
                    abstract=f"\0{mark}",
                    key=secrets.randbits(24) + 1,
                    mark=mark,
                    secret=secret,
                    memory_mb=memory_mb,
                )
            finally:
                other.kill()
    finally:
        shutil.rmtree(playground, ignore_errors=True)


def _marked(mark: str) -> list[int]:
    found: list[int] = []
    for place in Path("/proc").glob("[0-9]*/comm"):
        with contextlib.suppress(OSError):
            if place.read_text().strip() == mark:
                found.append(int(place.parent.name))
    return found


def _named(place: str, mark: str) -> list[str]:
    try:
        return [entry.path for entry in os.scandir(place) if mark in entry.name]
    except OSError:
        return []


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
