"""Runs that are looked at, each read once and then followed as its ledger grows."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from asia.errors import UserError
from asia.ledger.artifacts import Store
from asia.ledger.chain import Follower, in_use, ledger_of
from asia.ledger.events import Evaluated, Noted, Proposed
from asia.ledger.index import Brief, brief
from asia.ledger.run import Run
from asia.problem.load import load_lock
from asia.problem.problem import Problem
from asia.report.page.subject import Detail, Subject
from asia.search.steering import FoldLosses, Steering, running_losses


@dataclass(frozen=True)
class Snapshot:
    """A run as of one line of its ledger."""

    subject: Subject
    """Subject from which pages are written."""
    head: str
    """Digest of that line."""
    problem: Problem | None = None
    """The problem with its records; None until they were read."""
    trouble: str = ""
    """Why there are no records, in words; "" where there are."""
    paused: bool = False
    """True if the user paused the search."""
    losses: Mapping[int, FoldLosses] = field(default_factory=dict[int, FoldLosses])
    """Training curves of the experiments under way, by their numbers."""

    @property
    def run(self) -> Run:
        """The run."""
        return self.subject.run

    @property
    def mark(self) -> str:
        """Position in the ledger, as `N-DIGEST` with the count of lines."""
        return f"{len(self.run.lines)}-{self.head[:20]}"

    def changed_since(self, count: int) -> list[int]:
        """Numbers of the experiments that later lines are about, the last one first."""
        found = {
            line.event.experiment
            for line in self.run.lines[count:]
            if isinstance(line.event, Proposed | Evaluated | Noted)
        }
        found.discard(0)
        return sorted(found, reverse=True)


class FollowedRun:
    """One run, shared between threads."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._follower = Follower(ledger_of(directory))
        self._lock = threading.Lock()
        self._snapshot: Snapshot | None = None
        self._records = _BackgroundRecords(directory / "problem.lock.toml")

    def snapshot(self, *, with_records: bool = False) -> Snapshot:
        """Return the present state.

        Args:
            with_records: true to wait for the records to be read.

        Raises:
            UserError: the ledger does not verify or is gone.
        """
        if with_records and Store(self.directory / "artifacts").kept:
            self._records.wait()
        with self._lock:
            try:
                new = self._follower.read()
                busy = in_use(ledger_of(self.directory))
            except OSError as error:
                raise UserError(f"{self.directory} is gone: {error.strerror}") from None
            paused = busy and Steering(self.directory).paused
            losses = running_losses(self.directory, self._follower.view) if busy else {}
            problem, trouble = self._records.found
            last = None if new else self._snapshot
            if (
                last is not None
                and (busy, trouble) == (last.run.busy, last.trouble)
                and problem is last.problem
            ):
                if (last.paused, last.losses) != (paused, losses):
                    last = self._snapshot = replace(last, paused=paused, losses=losses)
                return last
            follower = self._follower
            run = Run(self.directory, follower.view, tuple(follower.lines), busy)
            # A search that has only begun has no artifacts yet.
            if run.store.kept:
                self._records.begin()
            # Below its list of experiments, a long search is shown in part.
            detail = Detail(sources=1, stories=1, rows=150)
            subject = Subject(run, problem if run.store.kept else None, detail)
            head = follower.head
            self._snapshot = Snapshot(subject, head, problem, trouble, paused, losses)
            return self._snapshot

    def count_of(self, mark: str) -> int | None:
        """Return the number of lines before a mark; None if the mark is not of this ledger."""
        count, _, head = mark.partition("-")
        with self._lock:
            known = count.isdecimal() and self._follower.head_at(int(count)).startswith(head)
        return int(count) if known and len(head) >= 20 else None


class _BackgroundRecords:
    """Problem of a run with its records, which a background thread reads: they may have to be
    downloaded.
    """

    def __init__(self, lock_file: Path) -> None:
        self._lock_file = lock_file
        self._thread: threading.Thread | None = None
        self._starting = threading.Lock()
        self.found: tuple[Problem | None, str] = (None, "")
        """The problem, or why there is none; neither before it was read."""

    def begin(self) -> None:
        """Read them once."""
        with self._starting:
            if self._thread is None:
                self._thread = threading.Thread(target=self._read, daemon=True)
                self._thread.start()

    def wait(self) -> None:
        """Wait until the records were read."""
        self.begin()
        if self._thread is not None:
            self._thread.join()

    def _read(self) -> None:
        try:
            self.found = load_lock(self._lock_file), ""
        except UserError as error:
            self.found = None, str(error)


@dataclass(frozen=True)
class ListedRun:
    """A line of the list of runs."""

    name: str
    """Name of its directory."""
    changed: float
    """Time of the last change of the ledger, in seconds since 1970."""
    brief: Brief | None
    """The run at a glance; None where its ledger cannot be read."""
    trouble: str = ""
    """Why it cannot."""


class RunFolder:
    """The runs of a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._followed: dict[str, FollowedRun] = {}
        self._listed: dict[str, tuple[tuple[int, int, bool], ListedRun]] = {}
        self._lock = threading.Lock()

    def get(self, name: str) -> FollowedRun:
        """A run by its name. Raises UserError where there is none."""
        with self._lock:
            if not self._is_run(name):
                self._followed.pop(name, None)
                raise UserError(f"no run '{name}' under {self.folder}")
            if name not in self._followed:
                self._followed[name] = FollowedRun(self.folder / name)
            return self._followed[name]

    def names(self) -> list[str]:
        """Names of all runs in alphabetical order."""
        return sorted(path.parent.name for path in self.folder.glob("*/ledger.jsonl"))

    def listed(self) -> Sequence[ListedRun]:
        """Return all runs: those in progress first, then by the time of the last change."""
        with self._lock:
            found = [one for name in self.names() if (one := self._list(name)) is not None]

        def ended(one: ListedRun) -> bool:
            return one.brief is None or one.brief.state != "running"

        return sorted(found, key=lambda one: (ended(one), -one.changed))

    def _list(self, name: str) -> ListedRun | None:
        """Read again only where something is new; None where it was removed meanwhile."""
        directory = self.folder / name
        ledger = directory / "ledger.jsonl"
        try:
            state = ledger.lstat()
        except OSError:
            return None
        try:
            seen = state.st_mtime_ns, state.st_size, in_use(ledger)
        except UserError as error:
            return ListedRun(name, state.st_mtime_ns / 1e9, None, str(error))
        known = self._listed.get(name)
        if known is not None and known[0] == seen:
            return known[1]
        changed = state.st_mtime_ns / 1e9
        try:
            listed = ListedRun(name, changed, brief(directory, 1))
        except UserError as error:
            listed = ListedRun(name, changed, None, str(error))
        self._listed[name] = seen, listed
        return listed

    def _is_run(self, name: str) -> bool:
        """Return whether a name is a direct subfolder with a ledger in it."""
        plain = name not in ("", ".", "..") and not {"/", "\\", "\0"} & set(name)
        return plain and (self.folder / name / "ledger.jsonl").is_file()
