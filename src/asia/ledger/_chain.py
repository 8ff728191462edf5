"""Append-only JSON lines, each naming the sha256 of the line before it."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pydantic import ValidationError

from asia.errors import InternalError, UserError
from asia.ledger._events import Event, adapter

GENESIS = "0" * 64
LINE_LIMIT = 64 * 1024
_LOCK_ATTEMPTS = 20
_ENVELOPE = ("seq", "prev", "time", "self")


@dataclass(frozen=True)
class Line:
    """One verified line."""

    seq: int
    time: str
    event: Event


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _canonical(body: dict[str, Any]) -> bytes:
    text = json.dumps(body, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    return text.encode()


def _encode(seq: int, prev: str, event: Event) -> bytes:
    body: dict[str, Any] = {
        "seq": seq,
        "prev": prev,
        "time": datetime.now(UTC).isoformat(timespec="milliseconds"),
        **adapter.dump_python(event, mode="json"),
    }
    body["self"] = _digest(_canonical(body))
    line = _canonical(body)
    if len(line) >= LINE_LIMIT:
        raise InternalError(f"ledger event '{event.event}' is {len(line)} bytes long")
    return line


def _decode(raw: bytes, seq: int, prev: str, where: str) -> Line:
    try:
        body: dict[str, Any] = json.loads(raw)
        own = body.pop("self")
        sound = own == _digest(_canonical(body)) and body["prev"] == prev and body["seq"] == seq
        time = body["time"]
        event = adapter.validate_python({k: v for k, v in body.items() if k not in _ENVELOPE})
    except (ValueError, KeyError, AttributeError, TypeError, ValidationError):
        raise UserError(
            f"{where}: record {seq} is damaged or was written by another version"
        ) from None
    if not sound:
        raise UserError(f"{where}: record {seq} was changed after it was written")
    return Line(seq, time, event)


def read_lines(path: Path) -> Iterator[Line]:
    """Every whole line, verified. A torn last line, left by a crash, is passed over.

    Raises UserError that names the first record that does not verify.
    """
    prev = GENESIS
    with path.open("rb") as stream:
        for seq, raw in enumerate(stream):
            if not raw.endswith(b"\n"):
                return
            raw = raw[:-1]
            yield _decode(raw, seq, prev, str(path))
            prev = _digest(raw)


class Chain:
    """The one writer of a ledger. Holds an exclusive lock for as long as it is open."""

    def __init__(self, path: Path) -> None:
        self._path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._fd = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
        if not _locked(self._fd):
            os.close(self._fd)
            raise UserError(
                f"{path.parent} is in use by another search; wait for it or choose another --name"
            ) from None
        self.lines = list(read_lines(path))
        self._prev = GENESIS
        self._cut_torn_tail()
        _sync_directory(path.parent)

    def _cut_torn_tail(self) -> None:
        whole = 0
        with self._path.open("rb") as stream:
            for raw in stream:
                if raw.endswith(b"\n"):
                    whole += len(raw)
                    self._prev = _digest(raw[:-1])
        if os.fstat(self._fd).st_size != whole:
            os.ftruncate(self._fd, whole)
            os.fsync(self._fd)

    def append(self, event: Event) -> None:
        """Write one event; on return it is on the disk."""
        line = _encode(len(self.lines), self._prev, event)
        self._write(line + b"\n")
        self.lines.append(_decode(line, len(self.lines), self._prev, str(self._path)))
        self._prev = _digest(line)

    def _write(self, data: bytes) -> None:
        """All of it, on the disk; or nothing and UserError."""
        size = os.fstat(self._fd).st_size
        try:
            done = 0
            while done < len(data):
                done += os.write(self._fd, data[done:])
            os.fsync(self._fd)
        except OSError as error:
            os.ftruncate(self._fd, size)
            raise UserError(f"cannot write {self._path}: {error.strerror}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        os.close(self._fd)


def _locked(fd: int) -> bool:
    """Take the exclusive lock. `in_use` holds a shared one for a moment, which is no search."""
    for attempt in range(_LOCK_ATTEMPTS):
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            time.sleep(0.01 if attempt + 1 < _LOCK_ATTEMPTS else 0.0)
        else:
            return True
    return False


def in_use(path: Path) -> bool:
    """Whether a search holds the ledger."""
    with path.open("rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return True
        return False


def _sync_directory(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
