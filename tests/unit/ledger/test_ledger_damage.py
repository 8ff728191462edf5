"""Nothing in a ledger or an artifact can be changed unnoticed; what a crash leaves is no damage."""

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from asia.errors import UserError
from asia.judge.scoring.outcome import FoldRecord, Score
from asia.judge.scoring.residuals import Diagnostics
from asia.ledger.artifacts import Store
from asia.ledger.chain import BEGIN, LINE_LIMIT, Chain, Follower, decode, encode, read_lines
from asia.ledger.events import Evaluated, Event, Steered, Stopped
from asia.ledger.index import brief
from asia.ledger.run import open_run
from asia.ledger.verification import verify

from .conftest import evaluated, finished_run, proposed, score, started

ONCE = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One sound run for all examples; each puts back what it changed."""
    return finished_run(tmp_path_factory.mktemp("kept") / "kept")


@contextmanager
def instead(path: Path, data: bytes | bytearray) -> Iterator[None]:
    """Other bytes in a file, for a while."""
    sound = path.read_bytes()
    path.write_bytes(data)
    try:
        yield
    finally:
        path.write_bytes(sound)


@given(where=st.floats(0.0, 1.0, exclude_max=True), other=st.integers(1, 255))
@settings(ONCE, max_examples=400)
def test_one_changed_byte_of_the_ledger_is_named(kept: Path, where: float, other: int) -> None:
    path = kept / "ledger.jsonl"
    sound = path.read_bytes()
    position = int(where * len(sound))
    changed = bytearray(sound)
    changed[position] ^= other
    record = sound[:position].count(b"\n")
    with instead(path, changed), pytest.raises(UserError, match=rf"event {record} "):
        verify(kept)


@given(which=st.integers(0, 100), where=st.floats(0.0, 1.0, exclude_max=True), other=st.integers(1))
@settings(ONCE, max_examples=100)
def test_one_changed_byte_of_an_artifact_is_named_with_its_record(
    kept: Path, which: int, where: float, other: int
) -> None:
    artifacts = sorted((kept / "artifacts").iterdir())
    path = artifacts[which % len(artifacts)]
    sound = path.read_bytes()
    changed = bytearray(sound)
    changed[int(where * len(sound))] ^= other % 255 + 1
    lines = (kept / "ledger.jsonl").read_text().splitlines()
    record = next(n for n, line in enumerate(lines) if path.name in line)
    words = rf"event {record} of .*{path.name} was changed"
    with instead(path, changed), pytest.raises(UserError, match=words):
        verify(kept)


def test_the_last_newline_and_every_byte_of_the_last_record_are_covered(whole: Path) -> None:
    path = whole / "ledger.jsonl"
    sound = path.read_bytes()
    for position in range(sound.rstrip(b"\n").rfind(b"\n"), len(sound)):
        for other in (0x01, 0x80, sound[position] ^ 0x0A or 0x0B):
            changed = bytearray(sound)
            changed[position] ^= other
            path.write_bytes(changed)
            with pytest.raises(UserError, match=r"event [67] "):
                verify(whole)
    path.write_bytes(sound)
    assert verify(whole).records == 8


def test_a_power_cut_at_every_byte_of_the_last_record(whole: Path) -> None:
    path = whole / "ledger.jsonl"
    sound = path.read_bytes()
    last = sound.rstrip(b"\n").rfind(b"\n") + 1
    before = sound[:last]
    for end in range(last, len(sound)):
        path.write_bytes(sound[:end])
        assert len(open_run(whole).lines) == 7
        found = verify(whole)
        assert (found.records, found.torn) == (7, end - last)
        with Chain(path) as chain:
            assert len(chain.lines) == 7
            assert path.read_bytes() == before
            chain.append(Stopped("user"))
        assert verify(whole).records == 8


@pytest.mark.parametrize("newline", [True, False])
def test_a_power_cut_that_leaves_a_hole_where_data_had_not_arrived(
    whole: Path, newline: bool
) -> None:
    path = whole / "ledger.jsonl"
    sound = path.read_bytes()
    last = sound.rstrip(b"\n").rfind(b"\n") + 1
    torn = bytes(100) + (sound[last + 100 :] if newline else b"")
    path.write_bytes(sound[:last] + torn)
    assert verify(whole).torn == len(torn)
    with Chain(path):
        assert path.read_bytes() == sound[:last]


def test_a_hole_further_up_is_damage(whole: Path) -> None:
    path = whole / "ledger.jsonl"
    sound = path.read_bytes()
    path.write_bytes(sound[:900] + bytes(100) + sound[1000:])
    with pytest.raises(UserError, match=r"event [01] was changed"):
        verify(whole)


def test_a_line_longer_than_any_record_is_damage_and_not_read_whole(whole: Path) -> None:
    path = whole / "ledger.jsonl"
    sound = path.read_bytes()
    path.write_bytes(sound + b"x" * 200_000)
    with pytest.raises(UserError, match="event 8 was changed"):
        verify(whole)


@pytest.mark.parametrize(
    ("order", "record"),
    [((0, 2, 3, 4, 5, 6, 7), 1), ((0, 1, 3, 2, 4), 2), ((0, 1, 1, 2), 2), ((1, 2, 3), 0)],
)
def test_records_cannot_be_taken_out_put_in_or_moved(
    whole: Path, order: tuple[int, ...], record: int
) -> None:
    path = whole / "ledger.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[n] for n in order))
    with pytest.raises(UserError, match=f"event {record} does not follow"):
        verify(whole)


def test_a_record_of_another_version_is_told_from_a_damaged_one(whole: Path) -> None:
    path = whole / "ledger.jsonl"
    with Chain(path) as chain:
        place = chain._place
    raw = json.loads(encode(place, Stopped("user")))
    raw["event"] = "prophesied"
    del raw["self"]
    body = json.dumps(raw, separators=(",", ":")).encode()
    own = hashlib.sha256(body).hexdigest().encode()
    with path.open("ab") as stream:
        stream.write(body[:-1] + b',"self":"' + own + b'"}\n')
    for reading in (lambda: list(read_lines(path)), lambda: verify(whole), lambda: Chain(path)):
        with pytest.raises(UserError, match="event 8 was written by another version"):
            reading()


@pytest.mark.parametrize("doubled", ["proposed", "evaluated", "orphan", "started"])
def test_an_experiment_is_there_once(whole: Path, doubled: str) -> None:
    with Chain(whole / "ledger.jsonl") as chain:
        chain.append(
            {
                "proposed": replace(chain.lines[2].event, title="again"),
                "evaluated": evaluated(1, "keep", score(0.2)),
                "orphan": evaluated(9, "keep", score(0.2)),
                "started": started(),
            }[doubled]
        )
    with pytest.raises(UserError, match="event 8 "):
        verify(whole)
    with pytest.raises(UserError, match="the ledger "):
        open_run(whole)


TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=200)


@given(text=TEXT, value=st.floats(allow_nan=False, allow_infinity=False))
@settings(ONCE, max_examples=200)
def test_every_text_and_number_comes_back_bitwise(text: str, value: float) -> None:
    events: list[Event] = [Steered(text), evaluated(1, "keep", score(value))]
    for event in events:
        assert repr(decode(encode(BEGIN, event), 0, "here").event) == repr(event)


@given(tail=st.binary(max_size=300))
@settings(ONCE, max_examples=200)
def test_whatever_stands_behind_the_last_record_is_a_user_error_or_a_torn_record(
    kept: Path, tail: bytes
) -> None:
    path = kept / "ledger.jsonl"
    with instead(path, path.read_bytes() + tail):
        try:
            records = verify(kept).records
        except UserError as error:
            assert b"\n" in tail
            assert "event 8 " in str(error)  # noqa: PT017
        else:
            assert records == 8


def test_a_proposal_without_its_result_is_whole(whole: Path) -> None:
    with Chain(whole / "ledger.jsonl") as chain:
        chain.append(proposed(Store(whole / "artifacts"), 3))
    assert verify(whole).records == 9


def long_result(folds: int = 160) -> Evaluated:
    fold = FoldRecord(
        0.25, (0.25,), (0.5,), (50.0,), (0.75,), model="a" * 64, y_hat="b" * 64, curve="c" * 64,
        diagnostics=Diagnostics(0.1, 0.0, 0.2, 0.3, 1.0, 1.0, 1.0, 0.0), fit_seconds=2.5,
        machine='"Nürnberg"\\',
    )  # fmt: skip
    return Evaluated(1, "keep", Score(0.25, (fold,) * folds), None, 1.0)


def test_an_event_longer_than_a_line_is_read_by_all(tmp_path: Path) -> None:
    path, store = tmp_path / "ledger.jsonl", Store(tmp_path / "artifacts")
    events = [started(), proposed(store, 1), long_result(), proposed(store, 2)]
    with Chain(path) as chain:
        for event in events[:2]:
            chain.append(event)
        follower = Follower(path)
        follower.read()
        for event in events[2:]:
            chain.append(event)
        assert [line.event for line in chain.lines] == events
    lines = path.read_bytes().splitlines(keepends=True)
    assert len(lines) > len(events) + 1
    assert max(map(len, lines)) <= LINE_LIMIT
    assert [(line.seq, line.event) for line in read_lines(path)] == [*enumerate(events)]
    assert follower.read()
    assert [line.event for line in follower.lines] == events
    assert follower.head_at(4) == follower.head
    assert open_run(tmp_path).view.experiment(1).result == events[2]
    for _ in range(2):
        assert brief(tmp_path, 1).view.experiment(1).result == events[2]


def test_a_kill_at_any_point_of_a_long_event_leaves_the_events_before(tmp_path: Path) -> None:
    path, store = tmp_path / "ledger.jsonl", Store(tmp_path / "artifacts")
    events = [started(), proposed(store, 1)]
    with Chain(path) as chain:
        for event in events:
            chain.append(event)
        before = path.stat().st_size
        chain.append(long_result())
    sound = path.read_bytes()
    ends = [n + 1 for n in range(before, len(sound)) if sound[n : n + 1] == b"\n"]
    assert len(ends) > 2
    for end in [e + shift for e in ends for shift in (-40_000, -1, 0, 1) if e + shift < len(sound)]:
        path.write_bytes(sound[: max(end, before)])
        assert [line.event for line in read_lines(path)] == events
        with Chain(path) as chain:
            assert path.stat().st_size == before
            chain.append(long_result())
        assert [line.event for line in read_lines(path)] == [*events, long_result()]


def test_a_changed_removed_or_moved_piece_of_a_long_event_is_named(tmp_path: Path) -> None:
    path, store = tmp_path / "ledger.jsonl", Store(tmp_path / "artifacts")
    with Chain(path) as chain:
        for event in (started(), proposed(store, 1), long_result(), Stopped("user")):
            chain.append(event)
    lines = path.read_bytes().splitlines(keepends=True)
    changed = lines[3].replace(b"cccc", b"cccd", 1)
    for damaged in (
        [*lines[:3], changed, *lines[4:]],
        [*lines[:3], *lines[4:]],
        [*lines[:2], lines[3], lines[2], *lines[4:]],
        [*lines[:-2], lines[-1]],
    ):
        path.write_bytes(b"".join(damaged))
        with pytest.raises(UserError, match="event 2 "):
            list(read_lines(path))
