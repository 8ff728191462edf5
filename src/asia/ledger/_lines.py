"""Encoding of one record as lines of JSON, mostly a single one, with the sha256 of the line before
and of the line itself.

A line is checked as bytes, without parsing it: `{"seq":N,"prev":"<sha256>","time":"..",`, the
event, and last `"self":"<sha256>"}`, which is the digest of the line without that member.

An event that exceeds the maximum length of a line is split over several lines with the same number:
each holds a part of the event's text and ends with `"more":true`, the last one with `"more":false`.
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

from asia.errors import UserError
from asia.ledger._events import Event, adapter

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


@dataclass(frozen=True)
class Position:
    """Between two records: how many come before it, in how many bytes, and the digest of the
    last of them."""

    seq: int = 0
    offset: int = 0
    head: str = GENESIS

    def behind(self, raw: bytes) -> Position:
        """The place after one more record."""
        last = raw[raw.rfind(b"\n", 0, -1) + 1 :]
        return Position(self.seq + 1, self.offset + len(raw), _digests(last)[1])


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
    """The event of a record that was checked. Raises UserError where this version cannot read
    it."""
    begin = len(_START % (seq, GENESIS.encode()))
    time, _, rest = raw[begin : -_SELF_BYTES - 1].partition(b'",')
    try:
        if raw.count(b"\n") > 1:
            text = "".join(json.loads(line)["text"] for line in raw.split(b"\n")[:-1])
        else:
            text = b"{" + rest + b"}"
        return Line(seq, time.decode(), adapter.validate_json(text))
    except (ValueError, KeyError, TypeError, ValidationError):
        raise UserError(
            f"{where}: event {seq} was written by another version of ASIA: read it with that one"
        ) from None


def scan(
    stream: BufferedReader, where: str, place: Position = BEGIN
) -> Iterator[tuple[Position, bytes]]:
    """Yield every complete record from `place` on, checked, with the position after it.

    A torn last record, left by a crash or still being written, is ignored, including its complete
    lines.

    Raises:
        UserError: a record does not verify; the message names the first one.
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


def _digests(raw: bytes) -> tuple[bytes, str]:
    """Return the required end of a record, whatever its last byte, and its digest for the next
    record.
    """
    digest = hashlib.sha256(raw[: -_SELF_BYTES - 1])
    own = digest.copy()
    own.update(b"}")
    digest.update(raw[-_SELF_BYTES - 1 : -1])
    return _SELF % own.hexdigest().encode(), digest.hexdigest()
