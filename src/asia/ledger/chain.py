"""Hash-chained file of events: writer, readers, verification of lines, disk access."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import socket
import threading
import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from io import BufferedReader
from pathlib import Path
from typing import Any, Self

from pydantic import ValidationError

from asia._files import open_ordinary, sync_folder
from asia.errors import UserError
from asia.ledger.events import Event, adapter
from asia.ledger.folder import check_run_folder
from asia.ledger.view import Replay, SearchView

# Encoding of one record as lines of JSON, mostly a single one, with the sha256 of the line before
# and of the line itself.
#
# A line is checked as bytes, without parsing it: `{"seq":N,"prev":"<sha256>","time":"..",`, the
# event, and last `"self":"<sha256>"}`, which is the digest of the line without that member.
#
# An event that exceeds the maximum length of a line is split over several lines with the same
# number: each holds a part of the event's text and ends with `"more":true`, the last one with
# `"more":false`.


GENESIS = "0" * 64
LINE_LIMIT = 64 * 1024
# Characters of an event's text in a line. Each takes at most 4 bytes, escapes included.
_PIECE = 15_000
_MORE = b',"more":true'
_START = b'{"seq":%d,"prev":"%b","time":"'
_SELF = b',"self":"%b"}'
_SELF_BYTES = len(_SELF % GENESIS.encode())
# File systems may leave zeros where data had not reached the disk; no JSON has a zero byte.
_HOLE = bytes(16)


@dataclass(frozen=True)
class Line:
    """One verified record."""

    seq: int
    time: str
    event: Event
    digest: str
    """Digest that the next record names."""


@dataclass(frozen=True)
class Position:
    """Place between two records: their number and bytes before it, digest of the last one."""

    seq: int = 0
    offset: int = 0
    head: str = GENESIS

    def behind(self, raw: bytes) -> Position:
        """The place after one more record."""
        return Position(self.seq + 1, self.offset + len(raw), _head(raw))


BEGIN = Position()


def encode(place: Position, event: Event) -> bytes:
    """The record of an event that comes at `place`, newlines included."""
    time = datetime.now(UTC).isoformat(timespec="milliseconds")
    fields = adapter.dump_python(event, mode="json")
    line, _ = _line(place.seq, place.head, time, fields)
    if len(line) <= LINE_LIMIT:
        return line
    text, head, lines = _json(fields), place.head, list[bytes]()
    for begin in range(0, len(text), _PIECE):
        piece = {"text": text[begin : begin + _PIECE], "more": begin + _PIECE < len(text)}
        line, head = _line(place.seq, head, time, {"event": "piece", **piece})
        lines.append(line)
    return b"".join(lines)


def _line(seq: int, prev: str, time: str, fields: dict[str, Any]) -> tuple[bytes, str]:
    """A line, and its digest for the next one."""
    text = _json({"seq": seq, "prev": prev, "time": time, **fields}).encode()
    line = text[:-1] + _SELF % hashlib.sha256(text).hexdigest().encode() + b"\n"
    return line, _digests(line)[1]


def _json(value: dict[str, Any]) -> str:
    return json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":"))


def decode(raw: bytes, seq: int, where: str) -> Line:
    """The event of a checked record. Raises UserError where this version cannot read it."""
    begin = len(_START % (seq, GENESIS.encode()))
    time, _, rest = raw[begin : -_SELF_BYTES - 1].partition(b'",')
    try:
        if raw.count(b"\n") > 1:
            text = "".join(json.loads(line)["text"] for line in raw.split(b"\n")[:-1])
        else:
            text = b"{" + rest + b"}"
        return Line(seq, time.decode(), adapter.validate_json(text), _head(raw))
    except (ValueError, KeyError, TypeError, ValidationError, RecursionError):
        raise UserError(
            f"{where}: event {seq} was written by another version of ASIA: read it with that one"
        ) from None


def scan(
    stream: BufferedReader, where: str, place: Position = BEGIN
) -> Iterator[tuple[Position, bytes]]:
    """Yield every complete record from `place` on, checked, with the position after it.

    A torn last record, left by a crash or still being written, is ignored, including its complete
    lines. Raises UserError when a record does not verify; the message names the first one.
    """
    stream.seek(place.offset)
    lines, before = list[bytes](), place.head
    while raw := stream.readline(LINE_LIMIT + 1):
        own, head = _digests(raw)
        sound = own == raw[-_SELF_BYTES - 1 : -1]
        whole = raw.endswith(b"\n")
        # A sound record with another byte in place of its newline is no torn one.
        torn = not whole and not sound and len(raw) <= LINE_LIMIT
        if torn or (_HOLE in raw and not stream.peek(1)):
            return
        if not (whole and sound):
            raise UserError(f"{where}: event {place.seq} was changed after it was written")
        if not raw.startswith(_START % (place.seq, before.encode())):
            raise UserError(
                f"{where}: event {place.seq} does not follow the one before it: events were "
                "removed, added or put in another order"
            )
        lines.append(raw)
        before = head
        if raw[: -_SELF_BYTES - 1].endswith(_MORE):
            continue
        record = b"".join(lines)
        place, lines = Position(place.seq + 1, place.offset + len(record), head), []
        yield place, record


def _head(record: bytes) -> str:
    """Digest of a record, which is that of its last line, for the next one."""
    return _digests(record[record.rfind(b"\n", 0, -1) + 1 :])[1]


def _digests(raw: bytes) -> tuple[bytes, str]:
    """Return the required end of a record and its digest for the next one."""
    digest = hashlib.sha256(raw[: -_SELF_BYTES - 1])
    own = digest.copy()
    own.update(b"}")
    digest.update(raw[-_SELF_BYTES - 1 : -1])
    return _SELF % own.hexdigest().encode(), digest.hexdigest()


# Files that appear whole or not at all, and what to say where the disk refuses.


@contextlib.contextmanager
def writing(path: Path) -> Generator[None]:
    """Turns an OSError into a UserError that names `path` and says what to do."""
    try:
        yield
    except OSError as error:
        match error.errno:
            case errno.ENOSPC | errno.EDQUOT:
                text = (
                    f"the disk is full ({error.strerror}); recorded events are safe: free some "
                    "space and repeat the command"
                )
            case errno.EFBIG:
                text = (
                    "the file would exceed the limit of file sizes; recorded events are safe: "
                    "raise it (ulimit -f) and repeat the command"
                )
            case errno.EROFS | errno.EACCES | errno.EPERM:
                text = (
                    f"{error.strerror}; make the directory writable, or name another one with "
                    "--runs"
                )
            case _:
                text = (
                    f"{error.strerror or error}; recorded events are safe: correct this and repeat "
                    "the command"
                )
        raise UserError(f"{path} could not be written: {text}") from None


def write_whole(path: Path, data: bytes, *, durable: bool = True) -> None:
    """The file appears with all its bytes in one step; `durable`: on return it is on the disk.
    Missing folders are made. Raises UserError."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_native_id()}.new")
    with writing(path):
        make_folder(path.parent)
        try:
            with temporary.open("wb") as stream:
                stream.write(data)
                if durable:
                    stream.flush()
                    os.fsync(stream.fileno())
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        if durable:
            sync_folder(path.parent)


def make_folder(path: Path) -> None:
    """Create a folder with its parents. A new folder is on the disk on return."""
    if not path.is_dir():
        make_folder(path.parent)
        path.mkdir(exist_ok=True)
        sync_folder(path.parent)


# The one writer of a ledger, and readers of it.


def ledger_of(directory: Path) -> Path:
    """The ledger of a run. Raises UserError for a directory that is none, and as
    `check_run_folder`."""
    ledger = directory / "ledger.jsonl"
    check_run_folder(directory)
    if not ledger.is_file():
        raise UserError(f"{directory} is not a run: it has no ledger.jsonl")
    return ledger


def open_ledger(path: Path) -> BufferedReader:
    """Open a ledger for reading. Raises UserError where there is something else, or nothing."""
    try:
        return open(open_ordinary(path), "rb")
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from None


def read_lines(path: Path) -> Iterator[Line]:
    """Yield every complete record, see `scan`."""
    with open_ledger(path) as stream:
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
        self._place = BEGIN
        self._replay = Replay()

    @property
    def view(self) -> SearchView:
        """The view after the last line. Raises UserError where no line was read yet."""
        return self._replay.view

    @property
    def head(self) -> str:
        """Digest of the last line that was read."""
        return self._place.head

    def head_at(self, count: int) -> str:
        """Digest of the last of the first `count` lines; "" where there are fewer."""
        if count == 0:
            return BEGIN.head
        return self.lines[count - 1].digest if count <= len(self.lines) else ""

    def read(self) -> bool:
        """Read the lines that are new and return whether there were any. A ledger that did not just
        grow is read again from the start. Raises UserError for a line that does not verify, OSError
        when the file is gone."""
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
        with open_ledger(self._path) as stream:
            for place, raw in scan(stream, str(self._path), self._place):
                line = decode(raw, place.seq - 1, str(self._path))
                self._replay.add(line.event)
                self.lines.append(line)
                self._place = place


# A link in place of the ledger is not followed, nor a named pipe waited for.
_OWN = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK


class Chain:
    """The one writer of a ledger. Holds an exclusive lock for as long as it is open.

    Raises UserError when another process holds it, which it names, or when the directory cannot
    be written. A torn last line is cut.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._holder = path, path.with_suffix(".holder")
        check_run_folder(path.parent)
        with writing(path):
            make_folder(path.parent)
            self._fd = os.open(path, _OWN, 0o644)
        try:
            self._lock()
            self.lines: list[Line] = []
            self._place = BEGIN
            self._replay, self._replayed = Replay(), 0
            with open_ledger(path) as stream:
                for place, raw in scan(stream, str(path)):
                    self.lines.append(decode(raw, self._place.seq, str(path)))
                    self._place = place
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
        """Take the exclusive lock, and write the holder next to the ledger for display."""
        import fcntl  # no module of Windows, where the command line says what to do

        # `in_use` holds a shared lock for a moment, which is no search.
        attempts = 20
        for attempt in range(attempts):
            try:
                fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except OSError as error:
                if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                    raise UserError(
                        f"{self._path} cannot be locked ({error.strerror}): name a directory on "
                        "another file system with --runs"
                    ) from None
                time.sleep(0.01 if attempt + 1 < attempts else 0.0)
        else:
            by = ""
            with contextlib.suppress(OSError, ValueError, TypeError, KeyError):
                found = json.loads(self._holder.read_text("utf-8"))
                by = f" (process {found['pid']} on {found['host']}, since {found['since']})"
            raise UserError(
                f"{self._path.parent} is in use by another search{by}; wait for it or choose "
                "another --name"
            )
        since = datetime.now(UTC).isoformat(" ", "seconds")
        holder = {"pid": os.getpid(), "host": socket.gethostname(), "since": since}
        with contextlib.suppress(OSError):
            self._holder.write_text(json.dumps(holder), "utf-8")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        with contextlib.suppress(OSError):
            self._holder.unlink()
        os.close(self._fd)


def in_use(path: Path) -> bool:
    """Return whether a search holds the ledger."""
    import fcntl

    with open_ledger(path) as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return True
        return False
