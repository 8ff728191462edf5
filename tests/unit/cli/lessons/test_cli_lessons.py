"""`asia lessons`, and `asia run --lessons`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from asia.agents.lessons import FIRST_FIT, Lesson, encode_lessons, keep_lessons, kept_lessons
from asia.ledger import Store, open_run
from tests.unit.cli.conftest import Asia, Searched

KNOWN = (Lesson("a", frozenset({"short"}), "arx", FIRST_FIT, 0.5),)


@pytest.fixture(autouse=True)
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("ASIA_LESSONS", str(tmp_path / "kept"))
    return tmp_path / "kept" / "lessons.json"


def test_lessons_are_learned_shown_exported_forgotten_and_imported(
    asia: Asia, searched: Searched, kept: Path, tmp_path: Path
) -> None:
    keep_lessons(KNOWN)
    shown = asia("lessons", "--runs", searched.runs)
    assert shown.code == 0, shown.err
    assert "learned from 1 runs" in shown.out
    assert "V -39%" in shown.out
    assert str(kept) in shown.out
    first = kept.read_bytes()
    assert asia("lessons", "--runs", searched.runs).code == 0
    assert kept.read_bytes() == first
    as_json = json.loads(asia("lessons", "--runs", searched.runs, "--json").out)
    assert as_json[0]["family"] == "arx"
    file = tmp_path / "mine.json"
    assert "written to" in asia("lessons", "--export", file).out
    assert file.read_bytes() == first
    assert "removed" in asia("lessons", "--forget").out
    assert not kept.exists()
    assert "there were none" in asia("lessons", "--forget").out
    assert asia("lessons", "--import", file).code == 0
    assert kept.read_bytes() == first


def test_what_is_left_out_is_said(asia: Asia, searched: Searched) -> None:
    ledger = searched.directory / "ledger.jsonl"
    ledger.write_bytes(b"".join(ledger.read_bytes().splitlines(keepends=True)[:-2]))
    shown = asia("lessons", "--runs", searched.runs)
    assert shown.code == 0
    assert f"left out {searched.name}: the search is not finished" in shown.out
    assert kept_lessons() == ()


@pytest.mark.slow
@pytest.mark.parametrize("which", ["own", "file"])
def test_a_search_has_the_lessons_that_it_is_given(
    asia: Asia, problem: Path, tmp_path: Path, which: str
) -> None:
    keep_lessons(KNOWN)
    (tmp_path / "file.json").write_bytes(encode_lessons(KNOWN))
    given = "own" if which == "own" else tmp_path / "file.json"
    done = asia("run", problem, "--experiments", 1, "--lessons", given)
    assert done.code == 0, done.err
    run = open_run(Path("runs/toy-expert-s0"))
    assert run.view.started.lessons is not None
    artifacts = Store(run.directory / "artifacts")
    assert artifacts.get(run.view.started.lessons) == encode_lessons(KNOWN)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--lessons", "own", "--agent", "random"), "the agent 'random' does not use lessons"),
        (
            ("--lessons", "own", "--agent", "random*1+bayes"),
            "'random*1+bayes' does not use",
        ),
        (("--lessons", "no.json"), "no such file: no.json"),
    ],
)
def test_lessons_that_cannot_be(
    asia: Asia, problem: Path, options: tuple[str, ...], words: str
) -> None:
    done = asia("run", problem, *options)
    assert done.code == 2
    assert words in done.err
    assert not Path("runs").exists()


@pytest.mark.long
def test_by_default_there_are_none(asia: Asia, problem: Path) -> None:
    keep_lessons(KNOWN)
    assert asia("run", problem, "--experiments", 1, "--lessons", "off").code == 0
    assert asia("run", problem, "--experiments", 1).code == 0
    assert open_run(Path("runs/toy-expert-s0")).view.started.lessons is None


@pytest.mark.long
def test_agents_are_compared_without_lessons(asia: Asia, problem: Path) -> None:
    keep_lessons(KNOWN)
    options = ("--agents", "expert,random", "--seeds", 1, "--experiments", 1)
    assert asia("compare", problem, *options).code == 0
    ledgers = [path.parent for path in Path("runs").glob("*/ledger.jsonl")]
    assert len(ledgers) == 2
    assert all(open_run(path).view.started.lessons is None for path in ledgers)


def test_two_things_at_once_are_refused(asia: Asia) -> None:
    done = asia("lessons", "--forget", "--shipped")
    assert done.code == 2
    assert "give one of them" in done.err
