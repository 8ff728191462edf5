"""Runs that are looked at, each read once and then followed as its ledger grows."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from asia.errors import UserError
from asia.ledger import (
    Brief,
    Evaluated,
    Follower,
    Proposed,
    Run,
    brief,
    in_use,
    ledger_of,
)
from asia.problem.load import Problem, load_lock
from asia.report.pieces import Detail, Subject
from asia.search._steering import Steering

# A long search is not told whole below its list of experiments.
_DETAIL = Detail(sources=1, stories=1, rows=150)


@dataclass(frozen=True)
class Snapshot:
    """A run as of one line of its ledger."""

    subject: Subject
    """What pages are written from."""
    head: str
    """Digest of that line."""
    trouble: str = ""
    """Why there are no records, in words; "" where there are."""
    paused: bool = False
    """Whether a person asked it to pause."""

    @property
    def run(self) -> Run:
        """The run."""
        return self.subject.run

    @property
    def mark(self) -> str:
        """Where in the ledger this is, as `N-DIGEST` with the count of lines."""
        return f"{len(self.run.lines)}-{self.head[:20]}"

    def changed_since(self, count: int) -> list[int]:
        """Numbers of the experiments that later lines are about, the last one first."""
        found = {
            line.event.experiment
            for line in self.run.lines[count:]
            if isinstance(line.event, Proposed | Evaluated)
        }
        return sorted(found, reverse=True)


class FollowedRun:
    """One run; threads may share it."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._follower = Follower(ledger_of(directory))
        self._lock = threading.Lock()
        self._snapshot: Snapshot | None = None
        self._problem: Problem | None = None

    def snapshot(self) -> Snapshot:
        """As of now. Raises UserError where the ledger does not verify or is gone."""
        with self._lock:
            try:
                new = self._follower.read()
                ledger = ledger_of(self.directory)
            except OSError as error:
                raise UserError(f"{self.directory} is gone: {error.strerror}") from None
            last, busy = self._snapshot, in_use(ledger)
            paused = busy and Steering(self.directory).paused
            if new or last is None or busy != last.run.busy:
                last = self._make(busy)
            if last.paused != paused:
                last = replace(last, paused=paused)
            self._snapshot = last
            return last

    def count_of(self, mark: str) -> int | None:
        """How many lines lie before a mark; None where it is not of this ledger."""
        count, _, head = mark.partition("-")
        with self._lock:
            known = count.isdecimal() and self._follower.head_at(int(count)).startswith(head)
        return int(count) if known and len(head) >= 20 else None

    def _make(self, busy: bool) -> Snapshot:
        follower, trouble = self._follower, ""
        run = Run(self.directory, follower.view, tuple(follower.lines), busy)
        # A search that has only begun has no artifacts yet.
        if self._problem is None and run.store.kept:
            try:
                self._problem = load_lock(self.directory / "problem.lock.toml")
            except UserError as error:
                trouble = str(error)
        problem = self._problem if run.store.kept else None
        return Snapshot(Subject(run, problem, _DETAIL), follower.head, trouble)


@dataclass(frozen=True)
class ListedRun:
    """A line of the list of runs."""

    name: str
    """Name of its directory."""
    changed: float
    """When its ledger last did, in seconds since 1970."""
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
        """Of all runs, in alphabetical order."""
        return sorted(path.parent.name for path in self.folder.glob("*/ledger.jsonl"))

    def listed(self) -> Sequence[ListedRun]:
        """All runs: those that run, then the last one to change first."""
        with self._lock:
            found = [one for name in self.names() if (one := self._list(name)) is not None]
        return sorted(found, key=lambda one: (not _runs(one), -one.changed))

    def _list(self, name: str) -> ListedRun | None:
        """Read again only where something is new; None where it was removed meanwhile."""
        directory = self.folder / name
        ledger = directory / "ledger.jsonl"
        try:
            state = ledger.stat()
            seen = state.st_mtime_ns, state.st_size, in_use(ledger)
        except OSError:
            return None
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
        """Whether it is a directory of this folder itself with a ledger in it."""
        plain = name not in ("", ".", "..") and not {"/", "\\", "\0"} & set(name)
        return plain and (self.folder / name / "ledger.jsonl").is_file()


def _runs(one: ListedRun) -> bool:
    return one.brief is not None and one.brief.state == "running"
