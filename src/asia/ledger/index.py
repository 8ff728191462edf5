"""Index of a ledger: position of each record, so that status queries need not read them all.

A cache in the user's cache folder, which may be deleted at any time. It is not next to the ledger,
because a database that somebody else made can do harm when it is opened. Every query updates it. It
is rebuilt if it is damaged, has another version, or if the ledger did not just grow. No decision
depends on it: `verify`, resume, unseal and reports read the ledger.
"""

import contextlib
import os
import sqlite3
import sys
from collections.abc import Callable
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import TypeVar

from asia._files import cache_folder, name_of_place
from asia.errors import UserError
from asia.ledger.chain import BEGIN, Position, decode, in_use, ledger_of, open_ledger, scan
from asia.ledger.events import Evaluated, Event, Landed, Proposed
from asia.ledger.run import RunState, state_of
from asia.ledger.view import SearchView, replay

T = TypeVar("T")

_VERSION = 3
_SCHEMA = """
DROP TABLE IF EXISTS records;
DROP TABLE IF EXISTS covered;
CREATE TABLE records (seq INTEGER PRIMARY KEY, offset INTEGER, length INTEGER, event TEXT,
    experiment INTEGER, status TEXT, seconds REAL, validation_scores INTEGER,
    lowest INTEGER);
CREATE INDEX numbers ON records (experiment);
CREATE TABLE covered (inode INTEGER, size INTEGER, modified INTEGER, seq INTEGER, offset INTEGER,
    head TEXT);
"""
_TOTALS = """SELECT count(*), total(seconds), total(validation_scores) FROM records
    WHERE event = 'evaluated'"""
_LAST = """SELECT seq, experiment FROM records WHERE event = 'evaluated'
    ORDER BY seq DESC LIMIT ?"""
_KEPT_BEFORE = """SELECT experiment FROM records WHERE status = 'keep' AND seq < ?
    ORDER BY seq DESC LIMIT 1"""
_LOWEST_BEFORE = """SELECT experiment FROM records WHERE lowest AND seq < ?
    ORDER BY seq DESC LIMIT 1"""
_LAST_PROPOSED = "SELECT max(experiment) FROM records"
_RUNNING = """SELECT DISTINCT experiment FROM records WHERE experiment >
    (SELECT coalesce(max(experiment), 0) FROM records WHERE event = 'evaluated')"""
_RECORDS = """SELECT seq, offset, length FROM records
    WHERE (experiment IS NULL AND event <> 'streamed')
    OR experiment IN (SELECT value FROM json_each(?)) ORDER BY seq"""


@dataclass(frozen=True)
class Brief:
    """A run at a glance. `view` has of the experiments only the last ones, the incumbent and the
    best before them, the last one proposed and those that run; the totals are of all."""

    view: SearchView
    state: RunState
    finished: int
    seconds: float
    validation_scores: int


def brief(directory: Path, last: int = 50) -> Brief:
    """Read with the `last` experiments that have a result. Raises UserError when the directory is
    no run, or when a record that was read does not hold."""

    def read(index: sqlite3.Connection) -> Brief:
        finished, seconds, scores = index.execute(_TOTALS).fetchone()
        shown = index.execute(_LAST, (last,)).fetchall()
        first = shown[-1][0] if shown else sys.maxsize
        chosen = [number for _, number in shown]
        for query in (_KEPT_BEFORE, _LOWEST_BEFORE, _LAST_PROPOSED, _RUNNING):
            values = (first,) if "?" in query else ()
            chosen += [n for (n,) in index.execute(query, values).fetchall() if n is not None]
        places = index.execute(_RECORDS, (str(chosen),)).fetchall()
        ledger = ledger_of(directory)
        events: list[Event] = []
        with open_ledger(ledger) as stream:
            for seq, offset, length in places:
                stream.seek(offset)
                events.append(decode(stream.read(length), seq, str(ledger)).event)
        view = replay(events)
        return Brief(view, state_of(view, busy=in_use(ledger)), finished, seconds, int(scores))

    return _ask(directory, read)


def index_path(directory: Path) -> Path:
    """Return the file of the index of a run."""
    return cache_folder() / "index" / f"{name_of_place(directory)}.sqlite"


def refresh(directory: Path) -> None:
    """Update the index, so that the next query is fast. Errors are left to the next query."""
    with contextlib.suppress(UserError):
        _ask(directory, lambda index: None)


def _ask(directory: Path, question: Callable[[sqlite3.Connection], T]) -> T:
    """The answer from the index; where it cannot be written, from one in memory."""
    ledger, file = ledger_of(directory), index_path(directory)
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)

    def answer(place: Path) -> T:
        with contextlib.closing(sqlite3.connect(place, isolation_level=None)) as index:
            _update(index, ledger)
            return question(index)

    with contextlib.suppress(sqlite3.OperationalError):
        try:
            return answer(file)
        except sqlite3.OperationalError:
            raise
        except sqlite3.DatabaseError:
            with contextlib.suppress(OSError):
                file.unlink()
            return answer(file)
    return answer(Path(":memory:"))


def _update(index: sqlite3.Connection, ledger: Path) -> None:
    stat = os.stat(ledger)
    now = stat.st_ino, stat.st_size, stat.st_mtime_ns
    before: tuple[int, ...] | None = None  # the ledger at the last update
    if index.execute("PRAGMA user_version").fetchone() == (_VERSION,):
        before = index.execute("SELECT inode, size, modified FROM covered").fetchone()
    if before == now:
        return
    index.execute("BEGIN IMMEDIATE")
    with open_ledger(ledger) as stream:
        place = BEGIN
        if before is not None and before[0] == now[0] and before[1] != now[1]:
            place = _known_place(index, stream)
        if place == BEGIN:
            for statement in _SCHEMA.split(";"):
                index.execute(statement)
            index.execute(f"PRAGMA user_version = {_VERSION}")
        for after, raw in scan(stream, str(ledger), place):
            event = decode(raw, place.seq, str(ledger)).event
            # experiment, status, seconds, validation scores, lowest
            columns: tuple[int | str | float | None, ...] = (None,) * 5
            match event:
                case Proposed() | Landed():
                    columns = event.experiment, None, None, None, None
                case Evaluated():
                    scores, lowest = event.validation_scores, int(event.lowest)
                    spent = event.seconds if event.elapsed is None else event.elapsed
                    columns = event.experiment, event.status, spent, scores, lowest
                case _:
                    pass
            row = (place.seq, place.offset, len(raw), event.event, *columns)
            index.execute("INSERT INTO records VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", row)
            place = after
    index.execute("DELETE FROM covered")
    row = (*now, place.seq, place.offset, place.head)
    index.execute("INSERT INTO covered VALUES (?, ?, ?, ?, ?, ?)", row)
    index.execute("COMMIT")


def _known_place(index: sqlite3.Connection, stream: BufferedReader) -> Position:
    """Return the position after the indexed records, or the start where the ledger has others."""
    found = Position(*index.execute("SELECT seq, offset, head FROM covered").fetchone())
    last = index.execute("SELECT offset, length FROM records WHERE seq = ?", (found.seq - 1,))
    offset, length = last.fetchone() or (0, 0)
    stream.seek(offset)
    before = Position(found.seq - 1, offset).behind(stream.read(length))
    return before if before == found else BEGIN
