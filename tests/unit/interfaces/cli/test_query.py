"""asia query: SQL over runs, which changes nothing."""

from __future__ import annotations

import contextlib
import json
import shutil
import sqlite3
from pathlib import Path

import pytest

from asia.interfaces.cli import query
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


@pytest.mark.parametrize(
    ("sql", "named"),
    [
        ("select fts3_tokenizer('simple')", "function fts3_tokenizer"),
        ("select hex(FTS3_Tokenizer('porter')) from runs", "function fts3_tokenizer"),
        ("select load_extension('made up')", "function load_extension"),
        ("select sqlite_source_id()", "function sqlite_source_id"),
        ("select length(randomblob(1000000000))", "function randomblob"),
        ("select length(zeroblob(1000000000))", "function zeroblob"),
        ("select matchinfo(run) from runs", "function matchinfo"),
        ("select name from pragma_function_list", "not authorized"),
        ("select file from pragma_database_list", "not authorized"),
        ("select * from dbstat", "dbstat"),
        ("select sql from sqlite_stmt", "sqlite_stmt"),
        ("select sql from sqlite_master", "table sqlite_master"),
        ("select * from sqlite_dbpage", "sqlite_dbpage"),
        ("create virtual table t using fts3(x)", "not authorized"),
        ("select length(replace(printf('%9000000d', 1), ' ', 'many of them'))", "too big"),
    ],
)
def test_functions_and_tables_are_those_of_a_list(sql: str, named: str, tmp_path: Path) -> None:
    done = command_line("query", sql, "--runs", tmp_path)
    assert done.code == 2
    assert named in done.err
    assert done.out == ""


def test_each_function_that_sqlite_has_is_allowed_by_its_name_or_refused(tmp_path: Path) -> None:
    """The kinds of functions that read their arguments alone, and no other one of this SQLite."""
    with contextlib.closing(sqlite3.connect(":memory:")) as database:
        known = {name for (name,) in database.execute("select name from pragma_function_list")}
    outside = known.difference(query._FUNCTIONS.split())
    assert {"fts3_tokenizer", "load_extension"} <= outside | {"load_extension"}
    for name in outside:
        words = f"select {name}(run) from runs"
        assert command_line("query", words, "--runs", tmp_path).code == 2


def test_an_endless_recursion_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(query, "_SECONDS", 0.5)
    endless = "with recursive c(x) as (select 1 union all select x + 1 from c) select max(x) from c"
    done = command_line("query", endless, "--runs", tmp_path)
    assert done.code == 2
    assert "it took more than 0.5 s" in done.err


@pytest.mark.parametrize(
    ("sql", "answer"),
    [
        ("with c(x) as (values (1), (2)) select count(*), sum(x), max(x) from c", "2"),
        ("select value ->> 'a' as a, json_type(value) as t from json_each('[{\"a\": 7}]')", "7"),
        ("select rank() over (order by a), date('2026-01-02') as d from (select 'x' a)", "1"),
        ("select upper(substr('abc', 2)) as t where 'abc' like 'a%'", "BC"),
    ],
)  # fmt: skip
def test_ordinary_functions_are_allowed(sql: str, answer: str, tmp_path: Path) -> None:
    done = command_line("query", sql, "--runs", tmp_path)
    assert done.code == 0, done.err
    assert done.out.splitlines()[1].split()[0] == answer
