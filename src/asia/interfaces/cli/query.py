"""asia query: read-only SQL over the runs of a folder."""

import contextlib
import json as jsonlib
import sqlite3
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from asia._text import one_line, say
from asia.errors import UserError
from asia.interfaces.cli.options import DEFAULT_RUNS, Json, Runs

_TABLES = """
CREATE TABLE runs (run TEXT, problem TEXT, agent TEXT, seed INTEGER, state TEXT, finished INTEGER,
    budget INTEGER, best INTEGER, V REAL, tokens INTEGER);
CREATE TABLE experiments (run TEXT, number INTEGER, parent INTEGER, phase TEXT, agent TEXT,
    family TEXT, title TEXT, hypothesis TEXT, expected TEXT, status TEXT, V REAL, reason TEXT,
    seconds REAL, tags TEXT);
CREATE TABLE settings (run TEXT, number INTEGER, name TEXT, value);
CREATE TABLE notes (run TEXT, experiment INTEGER, time TEXT, author TEXT, text TEXT);
"""
_COLUMNS = " ".join(_TABLES.replace("CREATE TABLE ", "").split())
# Functions of numbers, text, dates and JSON, which read their arguments alone.
_FUNCTIONS = """
    abs acos acosh asin asinh atan atan2 atanh avg ceil ceiling char coalesce concat concat_ws cos
    cosh count cume_dist current_date current_time current_timestamp date datetime degrees
    dense_rank exp first_value floor format glob group_concat hex ifnull iif instr julianday lag
    last_value lead length like likelihood likely ln log log10 log2 lower ltrim max median min mod
    nth_value ntile nullif octet_length percent_rank percentile percentile_cont percentile_disc pi
    pow power printf quote radians random rank replace round row_number rtrim sign sin sinh soundex
    source sqrt strftime string_agg substr substring sum tan tanh time timediff total trim trunc
    typeof unhex unicode unistr unixepoch unlikely upper
    -> ->> json json_array json_array_length json_error_position json_extract json_group_array
    json_group_object json_insert json_object json_patch json_pretty json_quote json_remove
    json_replace json_set json_type json_valid
"""
_READABLE = frozenset({"runs", "experiments", "settings", "notes", "json_each", "json_tree"})
_ACTIONS = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_RECURSIVE)
_LONGEST_VALUE = 16 << 20  # bytes
_SECONDS = 60.0
_WIDEST = 60


def query(
    sql: Annotated[str, typer.Argument(metavar="SQL", help="One SELECT statement.")],
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Answer an SQL query over the runs and their experiments, as a table or as JSON lines.

    Tables: runs (run, problem, agent, seed, state, finished, budget, best, V, tokens) and
    experiments (run, number, parent, phase, agent, family, title, hypothesis, expected, status, V,
    reason, seconds, tags), settings (run, number, name, value), notes (run, experiment, time,
    author, text). The function source(run, number) returns candidate.py. The tables are copies: a
    query changes nothing. Functions are SQLite's own of numbers, text, dates and JSON.
    """
    with contextlib.closing(sqlite3.connect(":memory:")) as database:
        _fill(database, runs)
        refused = _confine(database)
        try:
            cursor = database.execute(sql)
            rows = cursor.fetchall()
            if cursor.description is None:
                raise sqlite3.Warning("no statement")
        except (sqlite3.Error, sqlite3.Warning, MemoryError) as error:
            reason = refused[0] if refused else str(error) or "it needs too much memory"
            raise UserError(
                f"the query failed: {reason}; expected one SELECT over {_COLUMNS}"
            ) from None
        names = [column[0] for column in cursor.description]
    if json:
        for row in rows:
            say(jsonlib.dumps(dict(zip(names, row, strict=True)), ensure_ascii=False))
        return
    texts = [[_cell(value) for value in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(names, *texts, strict=True)]
    for line in (names, *texts):
        say("  ".join(f"{text:<{w}}" for text, w in zip(line, widths, strict=True)).rstrip())


def _confine(database: sqlite3.Connection) -> list[str]:
    """Allow reading of the tables, and functions of a list, for a limited time; return the list
    that takes the first refusal, a clause."""
    refused: list[str] = []
    # The first use of a virtual table creates it.
    with contextlib.suppress(sqlite3.Error):
        database.execute("SELECT 1 FROM json_each('[]'), json_tree('[]')")

    def allow(
        action: int, first: str | None, second: str | None, place: str | None, _: str | None
    ) -> int:
        if action == sqlite3.SQLITE_FUNCTION:
            if (second or "").lower() in _FUNCTIONS.split():
                return sqlite3.SQLITE_OK
            refused.append(f"the function {second} is not among those that a query may call")
        elif action == sqlite3.SQLITE_READ:
            # Without a column rows are counted; a virtual table asks for its own number.
            known = (first or "").lower() in _READABLE or (not second and place is None)
            if known or (first, second) == ("sqlite_master", "ROWID"):
                return sqlite3.SQLITE_OK
            refused.append(f"the table {first} is not among those that a query may read")
        elif action in _ACTIONS:
            return sqlite3.SQLITE_OK
        return sqlite3.SQLITE_DENY

    end = time.monotonic() + _SECONDS

    def late() -> bool:
        if over := time.monotonic() > end:
            refused.append(f"it took more than {_SECONDS:g} s")
        return over

    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST_VALUE)
    database.set_authorizer(allow)
    database.set_progress_handler(late, 100_000)
    return refused


def _fill(database: sqlite3.Connection, runs: Path) -> None:
    """Copy the runs of a folder; name on stderr those that cannot be read."""
    from asia.ledger.events import Noted
    from asia.ledger.run import Run, open_run
    from asia.presentation.experiments import decision_text
    from asia.recipe import read_recipe

    opened: dict[str, Run] = {}
    database.executescript(_TABLES)
    for ledger in sorted(runs.glob("*/ledger.jsonl")):
        name = ledger.parent.name
        try:
            run = open_run(ledger.parent)
        except UserError as error:
            say(f"left out: {error}", file=sys.stderr)
            continue
        opened[name] = run
        view, best = run.view, run.view.best
        start, usage = view.started, view.usage
        row = (
            name, start.problem, start.agent, start.seed, run.state, len(view.finished),
            view.budget, best and best.number, view.best_value, usage and usage.tokens,
        )  # fmt: skip
        database.execute(f"INSERT INTO runs VALUES ({', '.join('?' * len(row))})", row)
        for e in view.experiments:
            p, r = e.proposed, e.result
            row = (
                name, e.number, p.parent, p.phase, p.agent or start.agent, p.family, p.title,
                p.hypothesis, p.expected, r.status if r else "running",
                e.value, decision_text(e, view),
                r.seconds if r else None, " ".join(view.tags(e.number)),
            )  # fmt: skip
            marks = ", ".join("?" * len(row))
            database.execute(f"INSERT INTO experiments VALUES ({marks})", row)
            # Settings of a candidate of the library; of another source there are none.
            recipe = read_recipe(run.store.text(e.source)) if run.store.kept else None
            for key, value in (*recipe.config, *recipe.options, *recipe.maps) if recipe else ():
                text = str(value) if isinstance(value, tuple) else value
                database.execute("INSERT INTO settings VALUES (?, ?, ?, ?)",
                                 (name, e.number, key, text))  # fmt: skip
        for line in run.lines:
            if isinstance(one := line.event, Noted):
                row = name, one.experiment or None, line.time, one.author, one.text
                database.execute("INSERT INTO notes VALUES (?, ?, ?, ?, ?)", row)

    def source(name: str, number: int) -> str | None:
        run = opened.get(name)
        found = [e for e in run.view.experiments if e.number == number] if run else []
        return run.store.text(found[0].source) if run and found else None

    database.create_function("source", 2, source)


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.5g}"
    return "" if value is None else one_line(str(value), _WIDEST)
