"""Looks at a sealed test by runs, by copies of them, and by others on the same records."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from asia._files import config_folder
from asia.errors import UserError
from asia.ledger import looks
from asia.ledger.chain import BEGIN, Line, encode, read_lines
from asia.ledger.events import Started
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.presentation.integrity import seal_text
from asia.search.run import prepare, search
from asia.search.unsealing import unseal
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.search.toy import Scripted, arx


def copied(run: Path, place: Path) -> Path:
    place.parent.mkdir(parents=True, exist_ok=True)
    shutil.copytree(run, place)
    return place


def opened(run: Path) -> tuple[str, ...]:
    return unseal(run, process_consent=True).opened_before


def forged(run: Path, **changes: object) -> Path:
    """A ledger written anew: another first line, so that it looks like a run of its own."""
    place, written = BEGIN, b""
    for line in list(read_lines(run / "ledger.jsonl")):
        event = line.event
        raw = encode(place, replace(event, **changes) if isinstance(event, Started) else event)
        written += raw
        place = place.behind(raw)
    (run / "ledger.jsonl").write_bytes(written)
    return run


def test_a_copy_opens_the_test_and_the_original_says_so(finished: Path, tmp_path: Path) -> None:
    copy = copied(finished, tmp_path / "elsewhere" / "copy")
    assert opened(copy) == ()
    with pytest.raises(UserError, match="was opened by a copy, copy on 20"):
        opened(finished)
    assert open_run(finished).view.unsealing is None
    runs = ("--runs", finished.parent)
    for words in (("status",), ("show",), ("report",)):
        done = command_line(*words, finished.name, *runs)
        assert done.code == 0, done.err
        assert "was opened by a copy, copy on 20" in done.out + done.err
    page = (finished / "report" / "report.html").read_text("utf-8")
    assert "was opened by a copy, copy on 20" in page
    assert "never opened" not in page
    assert str(copy.parent) not in page
    # The copy itself prints its result again.
    assert not unseal(copy, process_consent=True).first_time


@pytest.mark.parametrize("again", ["same place", "copy beside", "moved"])
def test_no_copy_of_a_run_is_opened_twice(finished: Path, tmp_path: Path, again: str) -> None:
    first = copied(finished, tmp_path / "elsewhere" / "one")
    opened(first)
    second = tmp_path / "elsewhere" / "two"
    if again == "copy beside":
        # The user's folder was lost, or the opened copy comes from another machine.
        shutil.rmtree(config_folder() / "looks")
    elif again == "same place":
        second = finished.with_name("two")
    if again == "moved":
        second = Path(shutil.move(finished, second))
    else:
        copied(finished, second)
    with pytest.raises(UserError, match="nothing was opened"):
        opened(second)
    assert open_run(second).view.unsealing is None


def test_a_copy_in_the_place_of_an_opened_one_is_no_first_look(
    finished: Path, tmp_path: Path
) -> None:
    place = copied(finished, tmp_path / "elsewhere" / "one")
    opened(place)
    shutil.rmtree(place)
    (words,) = opened(copied(finished, place))
    assert words.startswith("one on 20")
    done = command_line("status", "one", "--runs", place.parent)
    assert "look 2 at these test records, after one on 20" in done.out


def test_a_forged_copy_is_no_first_look(finished: Path, tmp_path: Path) -> None:
    copy = copied(finished, tmp_path / "elsewhere" / "copy")
    opened(copy)
    other = forged(copied(finished, tmp_path / "other" / "mine"), salt="another")
    (words,) = opened(other)
    assert words.startswith("copy on 20")
    verify(other)
    done = command_line("status", "mine", "--runs", other.parent)
    assert "look 2 at these test records, after copy on 20" in done.out


def test_the_search_of_the_original_ends_when_a_copy_opens_its_test(
    finished: Path, tmp_path: Path
) -> None:
    opened(copied(finished, tmp_path / "elsewhere" / "copy"))
    from asia.problem.load import load_problem

    problem = load_problem(tmp_path / "toy")
    agent = Scripted((arx(2), arx(3)))
    count = open_run(finished).view.budget + 1
    longer = replace(problem, budget=replace(problem.budget, experiments=count))
    ready = prepare(longer, agent.name, seed=0, runs=finished.parent, name=finished.name)
    with pytest.raises(UserError, match="was opened by a copy"):
        search(ready, agent, lambda event, view: None, lambda view: None)


def test_without_the_memory_of_looks_a_copy_opens_the_test_unseen(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The attack works where nothing is kept in the user's folder, as on another machine."""
    copy = copied(finished, tmp_path / "elsewhere" / "copy")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "another machine"))
    assert opened(copy) == ()
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "this machine"))
    assert looks.look_by_copy(finished, open_run(finished).view) is None
    assert opened(finished) == ()


@pytest.mark.parametrize("step", ["ledger.chain.Chain.append", "search.unsealing.open_test"])
def test_the_look_is_kept_before_anything_else(
    step: str, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = copied(finished, tmp_path / "elsewhere" / "copy")

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(f"asia.{step}", killed)
        with pytest.raises(KeyboardInterrupt):
            opened(copy)
    assert looks.look_by_copy(finished, open_run(finished).view) is not None
    # The interrupted run itself goes on; a look that its ledger does not have is counted.
    assert len(opened(copy)) == (step != "search.unsealing.open_test")
    assert open_run(copy).view.unsealed is not None


def test_of_a_run_beside_the_first_line_is_read_alone(
    finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run of another problem, however long."""
    for k in range(3):
        other = copied(finished, finished.with_name(f"other{k}"))
        forged(other, salt=str(k), test_digest="another")
    read = list[Line]()

    def counted(path: Path) -> Iterator[Line]:
        for line in read_lines(path):
            read.append(line)
            yield line

    monkeypatch.setattr(looks, "read_lines", counted)
    view = open_run(finished).view
    assert seal_text(finished, view) == ""
    assert read == []
    opened(finished)
    assert len(read) == 3


def test_a_folder_that_cannot_be_written_is_a_sentence(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "file"))
    with pytest.raises(UserError, match="name a folder of yours with XDG_CONFIG_HOME"):
        opened(finished)
