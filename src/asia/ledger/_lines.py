"""One record as a line of JSON that names the sha256 of the line before it and of itself.

A line is checked as bytes, without parsing it: `{"seq":N,"prev":"<sha256>","time":"..",`, the
event, and last `"self":"<sha256>"}`, which is the digest of the line without that member.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from io import BufferedReader
from typing import Any

from pydantic import ValidationError

from asia.errors import InternalError, UserError
from asia.ledger._events import Event, adapter

GENESIS = "0" * 64
LINE_LIMIT = 64 * 1024
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


@dataclass(frozen=True)
class Position:
    """Between two records: how many come before it, in how many bytes, and the digest of the
    last of them."""

    seq: int = 0
    offset: int = 0
    head: str = GENESIS

    def behind(self, raw: bytes) -> Position:
        """The place after one more record."""
        return Position(self.seq + 1, self.offset + len(raw), _digests(raw)[1])


BEGIN = Position()


def encode(place: Position, event: Event) -> bytes:
    """The record of an event that comes at `place`, newline included."""
    body: dict[str, Any] = {
        "seq": place.seq,
        "prev": place.head,
        "time": datetime.now(UTC).isoformat(timespec="milliseconds"),
        **adapter.dump_python(event, mode="json"),
    }
    text = json.dumps(body, allow_nan=False, ensure_ascii=False, separators=(",", ":")).encode()
    line = text[:-1] + _SELF % hashlib.sha256(text).hexdigest().encode()
    if len(line) >= LINE_LIMIT:
        raise InternalError(f"ledger event '{event.event}' is {len(line)} bytes long")
    return line + b"\n"


def decode(raw: bytes, seq: int, where: str) -> Line:
    """The event of a record that was checked. Raises UserError where this version cannot read
    it."""
    begin = len(_START % (seq, GENESIS.encode()))
    time, _, rest = raw[begin : -_SELF_BYTES - 1].partition(b'",')
    try:
        return Line(seq, time.decode(), adapter.validate_json(b"{" + rest + b"}"))
    except (ValueError, ValidationError):
        raise UserError(
            f"{where}: event {seq} was written by another version of ASIA: read it with that one"
        ) from None


def scan(
    stream: BufferedReader, where: str, place: Position = BEGIN
) -> Iterator[tuple[Position, bytes]]:
    """Every whole record from `place` on, checked, with the place behind it.

    A torn last record, left by a crash or being written, is passed over. Raises UserError that
    names the first record that does not hold.
    """
    stream.seek(place.offset)
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
        if not raw.startswith(_START % (place.seq, place.head.encode())):
            raise UserError(
                f"{where}: event {place.seq} does not follow the one before it: events were "
                "removed, added or put in another order"
            )
        place = Position(place.seq + 1, place.offset + len(raw), head)
        yield place, raw


def _digests(raw: bytes) -> tuple[bytes, str]:
    """How a record must end, whatever its last byte, and its digest for the next one."""
    digest = hashlib.sha256(raw[: -_SELF_BYTES - 1])
    own = digest.copy()
    own.update(b"}")
    digest.update(raw[-_SELF_BYTES - 1 : -1])
    return _SELF % own.hexdigest().encode(), digest.hexdigest()
