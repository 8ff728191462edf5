"""The one writer of a ledger, and readers of it."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import socket
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

from asia._files import sync_folder
from asia.errors import UserError
from asia.ledger._disk import make_folder, writing
from asia.ledger._events import Event
from asia.ledger._lines import BEGIN, Line, Position, decode, encode, scan
from asia.ledger._view import Replay, SearchView

_LOCK_ATTEMPTS = 20


def ledger_of(directory: Path) -> Path:
    """The ledger of a run. Raises UserError for a directory that is none."""
    ledger = directory / "ledger.jsonl"
    if not ledger.is_file():
        raise UserError(f"{directory} is not a run: it has no ledger.jsonl")
    return ledger


def read_lines(path: Path) -> Iterator[Line]:
    """Yield every complete line, verified. A torn last line, left by a crash, is ignored.

    Raises:
        UserError: a record does not verify; the message names the first one.
    """
    with path.open("rb") as stream:
        for place, raw in scan(stream, str(path)):
            yield decode(raw, place.seq - 1, str(path))


class Follower:
    """A ledger as it grows: each call of `read` takes up the whole lines that are new."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen: tuple[int, int, int] | None = None
        self._begin()

    def _begin(self) -> None:
        self.lines: list[Line] = []
        self._heads = [BEGIN.head]
        self._place = BEGIN
        self._replay = Replay()

    @property
    def view(self) -> SearchView:
        """Return the view after the last line that was read.

        Raises:
            UserError: no line was read yet.
        """
        return self._replay.view

    @property
    def head(self) -> str:
        """Digest of the last line that was read."""
        return self._place.head

    def head_at(self, count: int) -> str:
        """Digest of the last of the first `count` lines; "" where there are fewer."""
        return self._heads[count] if count < len(self._heads) else ""

    def read(self) -> bool:
        """Read the lines that are new and return whether there were any.

        A ledger that did not just grow is read again from the start.

        Raises:
            UserError: a line does not verify.
            OSError: the file is gone.
        """
        state = self._path.stat()
        seen = state.st_ino, state.st_size, state.st_mtime_ns
        if seen == self._seen:
            return False
        before = self._place
        if self._seen is not None and (seen[0] != self._seen[0] or seen[1] < before.offset):
            self._begin()
        try:
            self._take_up()
        except UserError:
            # A line that was never confirmed may have been cut, and another written in its place.
            self._begin()
            self._take_up()
        self._seen = seen
        return self._place != before

    def _take_up(self) -> None:
        with self._path.open("rb") as stream:
            for place, raw in scan(stream, str(self._path), self._place):
                line = decode(raw, place.seq - 1, str(self._path))
                self._replay.add(line.event)
                self.lines.append(line)
                self._heads.append(place.head)
                self._place = place


class Chain:
    """The one writer of a ledger. Holds an exclusive lock for as long as it is open.

    Raises UserError when another process holds it, which it names, or when the directory cannot
    be written. A torn last line is cut.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with writing(path):
            make_folder(path.parent)
            self._fd = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            self._lock()
            self.lines, self._place = _read(path)
            self._replay, self._replayed = Replay(), 0
            with writing(path):
                self._cut_back()
                sync_folder(path.parent)
        except BaseException:
            os.close(self._fd)
            raise

    @property
    def view(self) -> SearchView:
        """The events replayed, each of them once. Raises UserError as `Replay`."""
        while self._replayed < len(self.lines):
            self._replay.add(self.lines[self._replayed].event)
            self._replayed += 1
        return self._replay.view

    def append(self, event: Event) -> None:
        """Write one event; on return it is on the disk. Raises UserError when that is not possible:
        then nothing was written."""
        raw = encode(self._place, event)
        seq = self._place.seq
        line = decode(raw, seq, str(self._path))
        # An interrupt may have cut off an earlier call before it returned: then its record is
        # still there, but was never confirmed.
        with writing(self._path):
            self._cut_back()
            try:
                done = 0
                while done < len(raw):
                    done += os.write(self._fd, raw[done:])
                os.fsync(self._fd)
            except OSError:
                with contextlib.suppress(OSError):
                    self._cut_back()
                raise
        self._place = self._place.behind(raw)
        self.lines.append(line)

    def _cut_back(self) -> None:
        """Truncate the ledger to the end of the last acknowledged record."""
        if os.fstat(self._fd).st_size != self._place.offset:
            os.ftruncate(self._fd, self._place.offset)
            os.fsync(self._fd)

    def _lock(self) -> None:
        if not _locked(self._fd, self._path):
            holder = Holder.find(self._path)
            by = "" if holder is None else f" ({holder})"
            raise UserError(
                f"{self._path.parent} is in use by another search{by}; wait for it or choose "
                "another --name"
            )
        Holder.here().save(self._path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        with contextlib.suppress(OSError):
            _holder_path(self._path).unlink()
        os.close(self._fd)


@dataclass(frozen=True)
class Holder:
    """Process that holds a ledger, for display. The lock itself belongs to the file and ends with
    the process.
    """

    pid: int
    host: str
    since: str

    @classmethod
    def here(cls) -> Holder:
        """Return a holder for the current process."""
        return cls(os.getpid(), socket.gethostname(), datetime.now(UTC).isoformat(" ", "seconds"))

    @classmethod
    def find(cls, ledger: Path) -> Holder | None:
        """Return the process that took the lock last; None if that cannot be read."""
        try:
            return cls(**json.loads(_holder_path(ledger).read_text("utf-8")))
        except (OSError, ValueError, TypeError):
            return None

    def save(self, ledger: Path) -> None:
        """Write the holder next to the ledger. A failed write does not fail the search."""
        with contextlib.suppress(OSError):
            _holder_path(ledger).write_text(json.dumps(asdict(self)), "utf-8")

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}, since {self.since}"


def _holder_path(ledger: Path) -> Path:
    return ledger.with_suffix(".holder")


def _read(path: Path) -> tuple[list[Line], Position]:
    lines: list[Line] = []
    place = BEGIN
    with path.open("rb") as stream:
        for place, raw in scan(stream, str(path)):
            lines.append(decode(raw, place.seq - 1, str(path)))
    return lines, place


def _locked(fd: int, path: Path) -> bool:
    """Take the exclusive lock. `in_use` holds a shared one for a moment, which is no search."""
    for attempt in range(_LOCK_ATTEMPTS):
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                raise UserError(
                    f"{path} cannot be locked ({error.strerror}): name a directory on another file "
                    "system with --runs"
                ) from None
            time.sleep(0.01 if attempt + 1 < _LOCK_ATTEMPTS else 0.0)
        else:
            return True
    return False


def in_use(path: Path) -> bool:
    """Return whether a search holds the ledger."""
    with path.open("rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return True
        return False
