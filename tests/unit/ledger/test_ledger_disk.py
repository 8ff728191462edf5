"""Disks that are full, slow to fail or read-only: a sentence that says what to do, and no loss."""

import errno
import os
import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.ledger import chain as _disk
from asia.ledger import chain as _lines
from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain
from asia.ledger.events import Steered, Stopped
from asia.ledger.index import brief
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.presentation.exports import write_exports


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """No file may grow beyond so many bytes; the write that would is cut short."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def full_disk() -> Iterator[None]:
    """Half of every write arrives, then the disk is full."""
    write = os.write
    written: set[int] = set()

    def some(fd: int, data: bytes) -> int:
        if fd in written:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written.add(fd)
        return write(fd, data[: len(data) // 2])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "write", some)
        yield


def test_a_record_is_written_whole_or_not_at_all(whole: Path) -> None:
    path = whole / "ledger.jsonl"
    sound = path.read_bytes()
    with Chain(path) as chain:
        for more in range(0, 250, 7):
            with (
                largest_file(len(sound) + more),
                pytest.raises(UserError, match=r"ledger\.jsonl could not be written: .*ulimit"),
            ):
                chain.append(Stopped("user", "x" * 300))
            assert path.read_bytes() == sound
        chain.append(Stopped("user"))
    assert verify(whole).records == 9


def test_a_full_disk_says_what_to_do_and_the_search_goes_on_afterwards(
    whole: Path,
) -> None:
    path = whole / "ledger.jsonl"
    sound = path.read_bytes()
    words = r"the disk is full .* are safe: free some space and repeat the command"
    with Chain(path) as chain:
        with full_disk(), pytest.raises(UserError, match=words):
            chain.append(Stopped("user"))
        assert path.read_bytes() == sound
        chain.append(Stopped("user"))
        assert chain.view.stopped == Stopped("user")
    assert verify(whole).records == 9


def test_short_writes_are_gone_on_with(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = os.write
    monkeypatch.setattr(os, "write", lambda fd, data: write(fd, data[:7]))
    with Chain(whole / "ledger.jsonl") as chain:
        chain.append(Stopped("user"))
    assert verify(whole).records == 9


@pytest.mark.parametrize("where", ["write", "fsync"])
def test_an_interrupt_in_the_middle_of_a_record_does_not_break_the_chain(
    whole: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """Events recorded at the exit, such as the end of a session, follow it."""
    original = getattr(os, where)

    def interrupted(fd: int, *data: bytes) -> int:
        original(fd, *data)
        raise KeyboardInterrupt

    with Chain(whole / "ledger.jsonl") as chain:
        with monkeypatch.context() as patch:
            patch.setattr(os, where, interrupted)
            with pytest.raises(KeyboardInterrupt):
                chain.append(Steered("cut off"))
        chain.append(Stopped("user"))
    assert [line.event for line in open_run(whole).lines[8:]] == [Stopped("user")]
    verify(whole)


def test_an_artifact_is_there_whole_or_not_at_all(tmp_path: Path) -> None:
    store = Store(tmp_path / "artifacts")
    with (
        largest_file(1000),
        pytest.raises(UserError, match=r"could not be written: .* are safe: raise it"),
    ):
        store.put(b"x" * 2000)
    assert list((tmp_path / "artifacts").iterdir()) == []
    assert store.get(store.put(b"x" * 2000)) == b"x" * 2000


def test_what_a_killed_process_had_begun_to_write_is_removed(tmp_path: Path) -> None:
    store = Store(tmp_path)
    kept = store.put(b"kept")
    (tmp_path / f".{'0' * 64}.4242-4243.new").write_bytes(b"half")
    store.tidy()
    assert [p.name for p in tmp_path.iterdir()] == [kept]


def test_generated_files_stay_as_they_were_where_new_ones_do_not_fit(whole: Path) -> None:
    view = open_run(whole).view
    write_exports(whole, view)
    before = {p.name: p.read_bytes() for p in whole.iterdir() if p.is_file()}
    with largest_file(10), pytest.raises(UserError, match=r"results\.tsv could not be written"):
        write_exports(whole, view)
    assert {p.name: p.read_bytes() for p in whole.iterdir() if p.is_file()} == before


def test_a_file_appears_with_its_folders_and_nothing_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "file"
    _disk.write_whole(path, b"one")
    _disk.write_whole(path, b"two")
    assert path.read_bytes() == b"two"
    assert list(path.parent.iterdir()) == [path]


def test_threads_that_keep_the_same_artifact_do_not_meet(tmp_path: Path) -> None:
    store = Store(tmp_path / "artifacts")
    failed: list[UserError] = []

    def put() -> None:
        try:
            for number in range(20):
                store.put(b"%d" % number)
        except UserError as error:
            failed.append(error)

    threads = [threading.Thread(target=put) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    assert len(list((tmp_path / "artifacts").iterdir())) == 20


@pytest.mark.parametrize("code", [errno.EROFS, errno.EACCES, errno.EPERM])
def test_a_directory_that_cannot_be_written_names_the_way_out(
    whole: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    """Root writes in spite of modes, so that the refusal itself is made up."""

    def refuse(*arguments: object, **options: object) -> int:
        raise OSError(code, os.strerror(code))

    with monkeypatch.context() as patch:
        patch.setattr(os, "open", refuse)
        with pytest.raises(UserError, match="name another one with --runs"):
            Chain(whole / "ledger.jsonl")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "mkdir", refuse)
        with pytest.raises(UserError, match="name another one with --runs"):
            Chain(whole / "new" / "ledger.jsonl")


def test_a_clock_that_is_set_back_changes_times_and_nothing_else(
    whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Backwards(datetime):
        hours = 0

        @classmethod
        def now(cls, tz: object = None) -> datetime:
            cls.hours -= 30
            return datetime(2020, 1, 1, tzinfo=UTC) + timedelta(hours=cls.hours)

    monkeypatch.setattr(_lines, "datetime", Backwards)
    with Chain(whole / "ledger.jsonl") as chain:
        for text in "one", "two":
            chain.append(Steered(text))
    run = open_run(whole)
    times = [line.time for line in run.lines]
    assert times[-1] < times[-2] < times[0]
    assert [note.text for note in run.view.notes][1:] == ["one", "two"]
    assert run.view.seconds == 2.0
    assert verify(whole).records == 10
    assert brief(whole).finished == 2
