"""Something to attack."""

from __future__ import annotations

import os
import secrets
import shutil
import socket
import tempfile
from collections.abc import Generator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, fields
from pathlib import Path

from asia.errors import SandboxError
from asia.redteam.evidence.traces import Neighbour, Traces, neighbour

_WITHHELD = ("secret", "traces", "neighbour")
_PORTS_TRIED = 50


@dataclass(frozen=True)
class Targets:
    """Targets of an attack. It receives neither the secret nor the watched traces."""

    playground: str
    """A folder made for the attack."""
    vault: str
    """The test file, whose words the attack must not learn."""
    ledger: str
    """A file of the search."""
    evaluator: str
    """The source of an evaluator."""
    other: int
    """The process id of a neighbour."""
    parent: int
    """The process id of the evaluator."""
    port: int
    """The port of a TCP and of a UDP service."""
    daemon: str
    """The socket file of a service."""
    abstract: str
    """The abstract socket of a service."""
    key: int
    """The key of shared memory."""
    mark: str
    """Marker in the names of its processes and files."""
    memory_mb: int
    """The memory of its worker."""
    secret: str
    """Secret in the test file and in the neighbour's environment."""
    traces: Traces
    """State before the attack."""
    neighbour: Neighbour
    """The neighbour, to see whether it was changed."""

    @property
    def source(self) -> str:
        """Data of the attack, as Python source."""
        names = [one.name for one in fields(self) if one.name not in _WITHHELD]
        return repr({name.upper(): getattr(self, name) for name in names})

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


def _serve(services: ExitStack) -> int:
    """The port of a TCP and of a UDP service, open as long as `services`."""
    for _ in range(_PORTS_TRIED):
        service = socket.create_server(("127.0.0.1", 0))
        receiver = services.enter_context(socket.socket(type=socket.SOCK_DGRAM))
        port: int = services.enter_context(service).getsockname()[1]
        with suppress(OSError):  # UDP has another user there
            receiver.bind(("127.0.0.1", port))
            return port
    raise SandboxError(f"none of {_PORTS_TRIED} free TCP ports of this machine is free for UDP too")


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
            ExitStack() as services,
            socket.socket(socket.AF_UNIX) as local,
            socket.socket(socket.AF_UNIX) as hidden,
            neighbour(secret) as other,
        ):
            port = _serve(services)
            local.bind(os.path.join(playground, "socket"))
            local.listen()
            hidden.bind(f"\0{mark}")
            hidden.listen()
            key = secrets.randbits(24) + 1
            yield Targets(
                playground=playground,
                vault=paths["test.csv"],
                ledger=paths["ledger"],
                evaluator=paths["judge.py"],
                other=other.process.pid,
                parent=os.getpid(),
                port=port,
                daemon=os.path.join(playground, "socket"),
                abstract=f"\0{mark}",
                key=key,
                mark=mark,
                memory_mb=memory_mb,
                secret=secret,
                traces=Traces(mark, key, playground),
                neighbour=other,
            )
    finally:
        shutil.rmtree(playground, ignore_errors=True)
