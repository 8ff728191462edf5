"""The process behind a desk: what it was asked for, and how it is started."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from pydantic import TypeAdapter

from asia.errors import UserError
from asia.ledger import in_use, write_whole

_POLL = 0.05
_START_SECONDS = 60.0
_MESSAGE_LENGTH = 300
_VARIABLES = (
    "PATH", "HOME", "USER", "LOGNAME", "LANG", "LC_ALL", "LC_CTYPE", "TZ", "TMPDIR", "PYTHONPATH",
    "LD_LIBRARY_PATH", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_RUNTIME_DIR", "OMP_NUM_THREADS",
)  # fmt: skip


@dataclass(frozen=True)
class SearchRequest:
    """Arguments of a search that empties a queue; kept in its run directory."""

    problem: str
    """Built-in name or path of the problem."""
    agent: str
    """Interface that submits candidates: `workspace` or `mcp`."""
    seed: int
    """Seed of the search."""
    experiments: int | None
    """Candidates to evaluate; None for the problem's number."""
    hours: float | None
    """Hours of evaluation; None for the problem's number."""
    early_stopping: str | None
    """RunSettings in place of the problem's own."""
    isolation: str | None
    """Level asked for; None for the strongest that works."""
    isolation_strict: bool = False
    """True to fit the folds of a candidate sequentially."""
    retests: int | None = None
    """Fits from other seeds of a candidate about to be kept; None for the problem's number."""
    records: int = 0
    """Lines that the ledger had when this was asked for."""
    settings: dict[str, str] = field(default_factory=dict[str, str])
    """Recorded settings of the interface besides its name: the jail."""

    def save(self, directory: Path) -> None:
        """Write it, with the number of lines the ledger has now: a request made after a stop
        takes the search up again. The path of a problem is made absolute, for the search runs
        elsewhere."""
        path = Path(self.problem)
        found = path.is_file() or (path / "problem.toml").is_file()
        ledger = directory / "ledger.jsonl"
        request = replace(
            self,
            problem=str(path.resolve()) if found else self.problem,
            records=ledger.read_bytes().count(b"\n") if ledger.is_file() else 0,
        )
        write_whole(_request_path(directory), json.dumps(asdict(request)).encode())

    @classmethod
    def find(cls, directory: Path) -> SearchRequest | None:
        """The last one made; None for a run that no workspace or server began. Raises UserError
        where it cannot be read."""
        path = _request_path(directory)
        try:
            return _requests.validate_json(path.read_bytes(), strict=True)
        except FileNotFoundError:
            return None
        except ValueError:
            raise UserError(
                f"{path} is damaged: repeat the command that started the search"
            ) from None

    @classmethod
    def load(cls, directory: Path) -> SearchRequest:
        """Read the request, see `find`.

        Raises:
            UserError: there is none.
        """
        request = cls.find(directory)
        if request is None:
            raise UserError(
                f"{directory.name} accepts no submissions: it was not started by asia agent "
                "workspace or asia agent mcp"
            )
        return request


_requests = TypeAdapter(SearchRequest)


def _request_path(directory: Path) -> Path:
    return directory / "control" / "order.json"


def log_path(directory: Path) -> Path:
    """Return the log file of the search's process."""
    return directory / "control" / "search.log"


def start_search(directory: Path) -> None:
    """Start the process that empties the queue, unless one does; returns once its ledger has begun.
    Raises UserError with the last line it wrote when it fails at once; it may also find nothing to
    do."""
    directory = directory.resolve()
    if _ready(directory):
        return
    (directory / "control").mkdir(parents=True, exist_ok=True)
    with (directory / "control" / "start.lock").open("wb") as one_at_a_time:
        fcntl.flock(one_at_a_time, fcntl.LOCK_EX)
        if not _ready(directory):
            _start(directory, log_path(directory))


def _start(directory: Path, log: Path) -> None:
    with log.open("ab") as stream:
        before = stream.tell()
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "asia.drive", str(directory)],
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=stream,
            start_new_session=True,
            cwd="/",
            env=_environment(),
        )
    # Its end is waited for, so that it does not stay behind as a zombie.
    threading.Thread(target=process.wait, daemon=True).start()
    end = time.monotonic() + _START_SECONDS
    while not _ready(directory):
        code = process.poll()
        if code == 0:
            return
        if code is not None and not runs(directory):
            text = log.read_bytes()[before:].decode("utf-8", "replace").strip().splitlines()
            last = text[-1].removeprefix("asia: ") if text else f"exit code {code}"
            raise UserError(f"the search did not start: {last[:_MESSAGE_LENGTH]}")
        if time.monotonic() > end:
            raise UserError(f"the search did not start in {_START_SECONDS:g} s; see {log}")
        time.sleep(_POLL)


def _environment() -> dict[str, str]:
    """Return the environment of a search, without the keys that this process may hold and without
    relative paths, which would mean another place there.
    """
    kept = {name: os.environ[name] for name in _VARIABLES if name in os.environ}
    given = os.environ.get("ASIA_DATA_DIR")
    return {**kept, **({"ASIA_DATA_DIR": os.path.abspath(given)} if given else {})}


def _ready(directory: Path) -> bool:
    return runs(directory) and has_begun(directory)


def runs(directory: Path) -> bool:
    """Return whether the search is running."""
    ledger = directory / "ledger.jsonl"
    return ledger.is_file() and in_use(ledger)


@contextmanager
def attending(directory: Path) -> Generator[None]:
    """While the search's process is there, also where no search holds the ledger: between one
    request and the next. The lock is free again however the process ends."""
    path = _presence_path(directory)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as stream:
        fcntl.flock(stream, fcntl.LOCK_SH)
        yield


def attended(directory: Path) -> bool:
    """Return whether a process serves the queue, or a search of another command runs."""
    if runs(directory):
        return True
    with contextlib.suppress(FileNotFoundError), _presence_path(directory).open("rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return True
    return False


def _presence_path(directory: Path) -> Path:
    return directory / "control" / "presence.lock"


def has_begun(directory: Path) -> bool:
    """Return whether the ledger has its first line."""
    try:
        with (directory / "ledger.jsonl").open("rb") as stream:
            return stream.readline().endswith(b"\n")
    except FileNotFoundError:
        return False
