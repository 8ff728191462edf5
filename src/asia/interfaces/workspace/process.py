"""Process behind a submission server: its queue, start, search."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import secrets
import subprocess
import sys
import threading
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from pydantic import TypeAdapter

from asia.agents.view import Proposal, SubmittedAgent
from asia.errors import UserError
from asia.judge.sandbox.types import Isolation
from asia.ledger.chain import in_use, write_whole
from asia.ledger.events import Event, Proposed
from asia.ledger.run import open_run
from asia.ledger.view import SearchView
from asia.problem.held_back import GUARD_SHARE
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from asia.search.run import (
    Prepared,
    check_same_search,
    guard_share,
    prepare,
    run_name,
    search,
)
from asia.search.settings import SearchSettings

# The process behind a desk: what it was asked for, and how it is started.


_START_SECONDS = 60.0
_VARIABLES = (
    "PATH", "HOME", "USER", "LOGNAME", "LANG", "LC_ALL", "LC_CTYPE", "TZ", "TMPDIR", "PYTHONPATH",
    "LD_LIBRARY_PATH", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_RUNTIME_DIR", "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class SearchRequest(SearchSettings):
    """Arguments of a search that empties a queue; kept in its run directory."""

    problem: str
    """Built-in name or path of the problem."""
    agent: str
    """Interface that submits candidates: `workspace` or `mcp`."""
    records: int = 0
    """Lines that the ledger had when this was asked for."""
    settings: dict[str, str] = field(default_factory=dict[str, str])
    """Recorded settings of the interface besides its name: the jail."""
    guard: float | None = None
    """Share of the training records held back as guard records; None for the problem's own."""

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
        write_whole(directory / "control" / "order.json", json.dumps(asdict(request)).encode())

    @classmethod
    def find(cls, directory: Path) -> SearchRequest | None:
        """The last one made; None for a run that no workspace or server began. Raises UserError
        where it cannot be read."""
        path = directory / "control" / "order.json"
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


def log_path(directory: Path) -> Path:
    """Return the log file of the search's process."""
    return directory / "control" / "search.log"


def start_search(directory: Path) -> None:
    """Start the process that empties the queue, unless one does; returns once its ledger has begun.
    Raises UserError with the last line it wrote when it fails at once; it may also find nothing to
    do."""
    directory = directory.resolve()

    def ready() -> bool:
        return runs(directory) and has_begun(directory)

    if ready():
        return
    log = log_path(directory)
    log.parent.mkdir(parents=True, exist_ok=True)
    with (log.parent / "start.lock").open("wb") as one_at_a_time:
        fcntl.flock(one_at_a_time, fcntl.LOCK_EX)
        if not ready():
            start_process(["asia.interfaces.workspace", str(directory)], directory, log)


def start_process(module: Sequence[str], directory: Path, log: Path) -> None:
    """Start a module with arguments as a process of its own that searches in a run directory;
    returns once the search runs, or once the process has found nothing to do. Raises UserError with
    the last line it wrote when it fails at once."""
    # Without the keys that this process may hold and without relative paths, which would mean
    # another place there.
    environment = {name: os.environ[name] for name in _VARIABLES if name in os.environ}
    if data := os.environ.get("ASIA_DATA_DIR"):
        environment["ASIA_DATA_DIR"] = os.path.abspath(data)
    with log.open("ab") as stream:
        before = stream.tell()
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", *module],
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=stream,
            start_new_session=True,
            cwd="/",
            env=environment,
        )
    # Its end is waited for, so that it does not stay behind as a zombie.
    threading.Thread(target=process.wait, daemon=True).start()
    end = time.monotonic() + _START_SECONDS
    while not (runs(directory) and has_begun(directory)):
        code = process.poll()
        if code == 0:
            return
        if code is not None and not runs(directory):
            text = log.read_bytes()[before:].decode("utf-8", "replace").strip().splitlines()
            last = text[-1].removeprefix("asia: ") if text else f"exit code {code}"
            raise UserError(f"the search did not start: {last[:300]}")
        if time.monotonic() > end:
            raise UserError(
                f"the search did not start in {_START_SECONDS:g} s. Its process goes on: repeat "
                f"the command in a minute. Its log is {log}"
            )
        time.sleep(0.05)


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


# Candidates handed in from outside: files in the run directory, so that none is lost when a
# process dies, and any process can hand one in.


TITLE = 80
TEXT = 2000

# A ticket comes back from outside and is part of a file name.
_TICKET = re.compile(r"\d{20}-[0-9a-f]{8}")
_WAITING, _TAKEN = ".json", ".taken"
_proposals = TypeAdapter(Proposal)


@dataclass(frozen=True)
class Queue:
    """The `control/queue` folder of a run directory.

    TICKET.json waits; it becomes TICKET.taken when the search is about to record it, and is removed
    once the ledger has it.
    """

    directory: Path

    @property
    def folder(self) -> Path:
        """Folder of the queue."""
        return self.directory / "control" / "queue"

    @contextmanager
    def alone(self) -> Generator[None]:
        """Hold the lock for one submission at a time."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / ".lock").open("wb") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX)
            yield

    def put(self, proposal: Proposal) -> str:
        """Hand in; on return it is on the disk. The ticket, which comes after all that wait: a
        clock may be set back."""
        newest = max((int(t[:20]) for t in self.tickets()), default=-1)
        ticket = f"{max(time.time_ns(), newest + 1):020d}-{secrets.token_hex(4)}"
        body = json.dumps(asdict(replace(proposal, ticket=ticket)))
        write_whole(self._path(ticket), body.encode())
        return ticket

    def tickets(self) -> list[str]:
        """Return the submissions that are not in the ledger yet, oldest first."""
        return sorted({*self._names(_WAITING), *self._names(_TAKEN)})

    def get(self, ticket: str) -> Proposal | None:
        """The submission; None when it was withdrawn or recorded meanwhile. Raises UserError for a
        file that is none."""
        for suffix in (_WAITING, _TAKEN) if _TICKET.fullmatch(ticket) else ():
            path = self._path(ticket, suffix)
            try:
                return _proposals.validate_json(path.read_bytes(), strict=True)
            except FileNotFoundError:
                continue
            except ValueError:
                raise UserError(f"{path} is not a submission: remove the file") from None
        return None

    def take(self) -> Proposal | None:
        """The oldest that waits; from here on it cannot be withdrawn, and it stays until it is
        removed. None when nothing waits."""
        for ticket in sorted(self._names(_WAITING)):
            try:
                self._path(ticket).replace(self._path(ticket, _TAKEN))
            except FileNotFoundError:
                continue
            return self.get(ticket)
        return None

    def give_back(self) -> None:
        """Return taken submissions to the queue: their search ended before it recorded them."""
        for ticket in self._names(_TAKEN):
            self._path(ticket, _TAKEN).replace(self._path(ticket))

    def withdraw(self, ticket: str) -> bool:
        """Take back; False when it does not wait, or not any more."""
        return ticket in self._names(_WAITING) and _unlinked(self._path(ticket))

    def remove(self, ticket: str) -> bool:
        """Take out once it is in the ledger; whether it was there."""
        if not _TICKET.fullmatch(ticket):
            return False
        return any(_unlinked(self._path(ticket, s)) for s in (_WAITING, _TAKEN))

    def _path(self, ticket: str, suffix: str = _WAITING) -> Path:
        return self.folder / f"{ticket}{suffix}"

    def _names(self, suffix: str) -> list[str]:
        try:
            names = os.listdir(self.folder)
        except FileNotFoundError:
            return []
        found = (name.removesuffix(suffix) for name in names if name.endswith(suffix))
        return [name for name in found if _TICKET.fullmatch(name)]


def _unlinked(path: Path) -> bool:
    try:
        path.unlink()
    except FileNotFoundError:
        return False
    return True


# Search that empties a queue: the baseline first, then the submissions, until the budget is spent
# or no submission has come for a while.


IDLE_SECONDS = 1800.0


class IdleError(Exception):
    """End of the process after a time without submissions; the run can be resumed."""


class NewRequestError(Exception):
    """More was requested while the search waited."""


def with_guard(
    request: SearchRequest, wanted: bool | None, runs: Path, name: str | None
) -> SearchRequest:
    """Return the request with guard records held back, or without.

    Args:
        wanted: None for the choice of the run, where it exists, else to hold back some
    """
    if wanted is None:
        problem = load_problem(request.problem)
        directory = runs / (name or run_name(problem, request.agent, request.seed))
        before = SearchRequest.find(directory)
        if before is not None and has_begun(directory):
            return replace(request, guard=before.guard)
    return replace(request, guard=guard_share(request.agent, wanted))


def guard_words(problem: Problem, request: SearchRequest) -> str:
    """Return a phrase on the guard records of a problem, and how to choose otherwise."""
    names = ", ".join(problem.guard_names)
    if not names:
        return f"none (--guard holds back {100 * GUARD_SHARE:g} % of the training records)"
    change = "" if request.guard is None else "; --no-guard switches this off"
    return f"{names}, shown to no candidate and no agent{change}"


def requested_problem(request: SearchRequest) -> Problem:
    """The problem with what was requested in place of its own."""
    problem = request.applied(load_problem(request.problem, request.guard))
    # The submitting user decides when to stop. The lock file has it, so it never changes.
    return replace(problem, budget=replace(problem.budget, patience=1_000_000))


def prepare_request(request: SearchRequest, runs: Path, name: str | None) -> Prepared:
    """Prepare a search that empties a queue, see `prepare`. If the request leaves the number of
    experiments open, a run keeps a larger number than its problem has.

    Raises:
        UserError: as `prepare`; also if the run is another search or has a larger budget than
            requested.
    """
    level = Isolation(request.isolation) if request.isolation else None

    def prepared(problem: Problem) -> Prepared:
        return prepare(
            problem, request.agent, seed=request.seed, runs=runs, name=name, isolation=level,
            isolation_strict=request.isolation_strict, agent_settings=request.settings,
        )  # fmt: skip

    problem = requested_problem(request)
    ready = prepared(problem)
    if not ready.resumes:
        return ready
    view = open_run(ready.directory).view
    if request.experiments is None and view.budget > problem.budget.experiments:
        budget = replace(problem.budget, experiments=view.budget)
        ready = prepared(replace(problem, budget=budget))
    check_same_search(view, ready.started)
    return ready


def serve(directory: Path, idle_seconds: float = IDLE_SECONDS) -> None:
    """Run to the end of the budget, or leave the run interrupted after `idle_seconds` without a
    submission."""
    directory = directory.resolve()
    queue = Queue(directory)
    with attending(directory):
        while True:
            request = SearchRequest.load(directory)
            prepared = prepare_request(request, directory.parent, directory.name)

            def waiting(seconds: float, request: SearchRequest = request) -> None:
                now = SearchRequest.load(directory)
                # The same request given again asks for nothing more.
                if replace(now, records=request.records) != request:
                    raise NewRequestError
                if seconds > idle_seconds:
                    raise IdleError

            try:
                search(
                    prepared,
                    SubmittedAgent(prepared.started.agent, queue.take, waiting),
                    on_event=lambda event, view: clearing(queue, event),
                    on_start=lambda view: clear_known(queue, view),
                )
            except IdleError:
                # Submitted after the last poll, while this search was still visible.
                if not queue.tickets():
                    return
            except NewRequestError:
                pass
            else:
                if SearchRequest.load(directory) == request:
                    return


def clearing(queue: Queue, event: Event) -> None:
    """Take out what the ledger has."""
    if isinstance(event, Proposed) and event.ticket:
        queue.remove(event.ticket)


def clear_known(queue: Queue, view: SearchView) -> None:
    """Put in order what a search left that was cut off: what the ledger has is taken out, what it
    had taken and not recorded waits again."""
    for experiment in view.experiments:
        if experiment.proposed.ticket:
            queue.remove(experiment.proposed.ticket)
    queue.give_back()
