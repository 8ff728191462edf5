import os
import sqlite3
from collections.abc import Callable
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.ledger import index as _index
from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain
from asia.ledger.events import Event
from asia.ledger.index import brief, index_path, refresh
from asia.ledger.run import open_run

from .conftest import evaluated, proposed, score, started

VALUES = [0.5, 0.9, 0.4, 0.7, 0.6, 0.45, 0.8, 0.3, 0.35]


def long_run(directory: Path, values: list[float] = VALUES) -> Path:
    store = Store(directory / "artifacts")
    best = 1.0
    events: list[Event] = [started()]
    for number, value in enumerate(values, 1):
        events.append(proposed(store, number))
        events.append(evaluated(number, "keep" if value < best else "discard", score(value)))
        best = min(best, value)
    with Chain(directory / "ledger.jsonl") as chain:
        for event in events:
            chain.append(event)
    return directory


@pytest.fixture
def scanned(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The records that were read one after the other since."""
    found: list[int] = []
    original = _index.scan

    def counting(*arguments: object) -> object:
        for place, raw in original(*arguments):  # type: ignore[arg-type]
            found.append(place.seq - 1)
            yield place, raw

    monkeypatch.setattr(_index, "scan", counting)
    return found


def test_a_glance_says_what_the_whole_ledger_says(tmp_path: Path) -> None:
    directory = long_run(tmp_path / "long")
    view = open_run(directory).view
    for last in (0, 1, 2, 5, 9, 50):
        found = brief(directory, last)
        assert found.finished == 9
        assert found.seconds == view.seconds
        assert found.state == "interrupted"
        assert found.view.best == view.best
        assert found.view.finished[-last:] == view.finished[-last:] or last == 0
        assert len(found.view.finished) <= last + 2


def test_the_incumbent_before_the_shown_experiments_is_known(tmp_path: Path) -> None:
    found = brief(long_run(tmp_path / "long", VALUES[:7]), 3).view
    assert [e.number for e in found.finished] == [3, 5, 6, 7]
    assert found.best is not None
    assert found.best.number == 3


def test_the_experiment_that_runs_is_known(run: Path) -> None:
    with Chain(run / "ledger.jsonl") as chain:
        chain.append(proposed(Store(run / "artifacts"), 4))
        pending = brief(run, 1).view.pending
        assert brief(run, 1).state == "running"
    assert pending is not None
    assert pending.number == 4


def test_a_ledger_that_has_grown_is_read_from_where_it_was_known(
    tmp_path: Path, scanned: list[int]
) -> None:
    directory = long_run(tmp_path / "long")
    refresh(directory)
    assert scanned == list(range(19))
    scanned.clear()
    brief(directory)
    assert scanned == []
    with Chain(directory / "ledger.jsonl") as chain:
        chain.append(proposed(Store(directory / "artifacts"), 10))
        chain.append(evaluated(10, "keep", score(0.1)))
    assert brief(directory, 1).finished == 10
    assert scanned == [19, 20]


def cut(path: Path) -> None:
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:-2]))


def replaced(path: Path) -> None:
    long_run(path.parent.parent / "other", [0.2, *VALUES[1:-1]])
    (path.parent.parent / "other" / "ledger.jsonl").replace(path)


def rewritten(path: Path) -> None:
    """Another search of the same length in the same file."""
    other = long_run(path.parent.parent / "other", [0.2, *VALUES[1:], 0.25])
    path.write_bytes((other / "ledger.jsonl").read_bytes())


@pytest.mark.parametrize("change", [cut, replaced, rewritten])
def test_a_ledger_that_did_not_just_grow_is_read_anew(
    tmp_path: Path, scanned: list[int], change: Callable[[Path], None]
) -> None:
    directory = long_run(tmp_path / "long")
    brief(directory)
    scanned.clear()
    change(directory / "ledger.jsonl")
    view = open_run(directory).view
    found = brief(directory)
    assert found.finished == len(view.finished)
    assert found.view.best == view.best
    assert found.view.finished == view.finished
    assert scanned[0] == 0


def test_a_changed_record_is_noticed_by_a_glance(tmp_path: Path) -> None:
    directory = long_run(tmp_path / "long")
    brief(directory)
    path = directory / "ledger.jsonl"
    sound = path.read_bytes()
    os.utime(path, ns=(1, 1))
    path.write_bytes(sound.replace(b'"value":0.9', b'"value":0.1'))
    with pytest.raises(UserError, match="event 4 was changed"):
        brief(directory)
    path.write_bytes(sound)
    assert brief(directory).finished == 9


@pytest.mark.parametrize("junk", [b"", b"no database", b"SQLite format 3\0" + bytes(4000)])
def test_a_damaged_index_is_made_anew(tmp_path: Path, junk: bytes) -> None:
    directory = long_run(tmp_path / "long")
    brief(directory)
    index_path(directory).write_bytes(junk)
    assert brief(directory).finished == 9
    index_path(directory).unlink()
    assert brief(directory).finished == 9


def test_an_index_of_another_version_is_made_anew(tmp_path: Path) -> None:
    directory = long_run(tmp_path / "long")
    brief(directory)
    index = sqlite3.connect(index_path(directory))
    index.execute("PRAGMA user_version = 99")
    index.execute("DROP TABLE records")
    index.commit()
    index.close()
    assert brief(directory).finished == 9


def test_a_directory_that_takes_no_index_is_read_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = long_run(tmp_path / "long")
    connect = sqlite3.connect

    def refused(place: Path, **options: object) -> sqlite3.Connection:
        if str(place) != ":memory:":
            raise sqlite3.OperationalError("attempt to write a readonly database")
        return connect(place, **options)  # type: ignore[call-overload]

    monkeypatch.setattr(sqlite3, "connect", refused)
    assert brief(directory).finished == 9
    assert not index_path(directory).exists()


def test_an_index_that_is_being_written_is_waited_for_or_done_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = long_run(tmp_path / "long")
    connect = sqlite3.connect
    monkeypatch.setattr(
        sqlite3, "connect", lambda place, **options: connect(place, timeout=0.05, **options)
    )
    brief(directory)
    other = connect(index_path(directory), isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    assert brief(directory).finished == 9
    other.close()


def test_what_is_no_run_has_no_index(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="not a run"):
        brief(tmp_path)
    refresh(tmp_path)
    assert list(tmp_path.iterdir()) == []
