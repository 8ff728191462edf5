"""asia query: SQL over runs, which changes nothing."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from asia.ledger.run import open_run

from .conftest import Done, Searched, command_line


def test_rows_are_those_of_the_ledger(searched: Searched) -> None:
    run = open_run(searched.directory)
    best = run.view.best
    assert best is not None
    assert best.score is not None
    sql = (
        "select r.run, e.number, e.V, e.status, source(e.run, e.number) "
        "from runs r join experiments e using (run) where r.best = e.number"
    )
    done = command_line("query", sql, "--runs", searched.runs, "--json")
    assert done.code == 0, done.err
    assert list(json.loads(done.out).values()) == [
        searched.name, best.number, best.score.value, "keep", run.store.text(best.proposed.source),
    ]  # fmt: skip
    table = command_line("query", "select title, V from experiments", "--runs", searched.runs).out
    heads, row = table.splitlines()
    assert heads.split() == ["title", "V"]
    assert row.startswith(best.proposed.title)
    assert row.endswith(f"{best.score.value:.5g}")


def test_notes_and_tags_of_people_are_printed_and_found(searched: Searched, tmp_path: Path) -> None:
    copied = shutil.copytree(searched.directory, tmp_path / "made")

    def note(*words: object) -> Done:
        return command_line("note", copied, *words, "--runs", tmp_path)

    assert note("slow valve", "--experiment", 1, "--tag", "odd", "--author", "Ada").code == 0
    assert note("for the paper", "--tag", "paper").code == 0
    assert note("--tag", "paper").code == 2
    assert note("no such experiment", "--experiment", 99).code == 2
    first, second = note().out.splitlines()
    assert first.endswith("#01  Ada: +odd slow valve")
    assert second.endswith(": +paper for the paper")
    assert json.loads(note("--experiment", 1, "--json").out)["tags"] == ["odd"]
    sql = "select number, author, text from experiments join notes on number = experiment"
    done = command_line("query", f"{sql} where tags = 'odd'", "--runs", tmp_path, "--json")
    assert json.loads(done.out) == {"number": 1, "author": "Ada", "text": "slow valve"}
    assert command_line("verify", copied).code == 0


def test_a_folder_without_runs_and_an_unreadable_run(tmp_path: Path) -> None:
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "ledger.jsonl").write_text("made up\n")
    done = command_line("query", "select count(*) as n from runs", "--runs", tmp_path)
    assert done.out == "n\n0\n"
    assert "left out: " in done.err


@pytest.mark.parametrize(
    "sql",
    [
        "delete from runs",
        "create table t (x)",
        "attach database '{folder}/made.sqlite' as made",
        "pragma query_only = 0",
        "select load_extension('made up')",
        "vacuum into '{folder}/made.sqlite'",
        "select 1; delete from runs",
        "select made_up from runs",
        "",
    ],
)
def test_only_reading_is_allowed(sql: str, tmp_path: Path) -> None:
    done = command_line("query", sql.format(folder=tmp_path), "--runs", tmp_path)
    assert done.code == 2
    assert "expected one SELECT over runs (run TEXT" in done.err
    assert list(tmp_path.iterdir()) == []
