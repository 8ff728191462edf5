"""Names of code in every field of text that ASIA reads from a file: nothing is imported."""

from __future__ import annotations

import importlib.abc
import json
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

from asia import _plugins
from asia.agents.registry import recorded_agent
from asia.errors import UserError
from asia.ledger.chain import BEGIN, encode, read_lines
from asia.ledger.events import Started, adapter
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.problem.load import load_lock, load_problem
from asia.problem.schema import LockFile, ProblemFile
from asia.problem.toml import toml_text
from tests.unit.interfaces.cli.conftest import command_line

MODULE = "named_by_a_file"
NAMES = (f"{MODULE}:run", f"{MODULE}.py:run")
# A problem with every table whose entries are not read as expressions or numbers.
PROBLEM = """
name = "toy"
description = "description.md"
notes = "description.md"
strategies = "description.md"
sampling_time = 0.5
inputs = [{ name = "u", unit = "V" }]
outputs = [{ name = "y", unit = "V" }]
[data]
source = "files"
train = ["train.csv"]
test = ["test.csv"]
time = "t"
time_unit = "s"
[protocol]
kind = "simulation"
metric = "rmse"
early_stopping = "inner"
feedback = "exact"
residuals = "train"
folds = { kind = "contiguous", count = 2 }
[protocol.test]
metrics = ["rmse"]
[loop]
reference = "r"
enters = "controller"
controller = "none"
inputs = "measured"
[plant]
source = "plant.py:simulate"
[plant.parameters]
k = { min = 0.1, max = 1.0, unit = "V" }
[physics]
states = ["x"]
[physics.dynamics]
x = "-x + u"
[physics.observation]
y = "x"
"""


class Watch(importlib.abc.MetaPathFinder):
    """Modules that something tried to import."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def find_spec(self, fullname: str, path: object, target: object = None) -> None:
        if MODULE in fullname:
            self.asked.append(fullname)


@pytest.fixture
def watch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Watch:
    """The module lies where Python finds it, and leaves a mark."""
    (tmp_path / f"{MODULE}.py").write_text(
        f"from pathlib import Path\nPath({str(tmp_path / 'mark')!r}).touch()\n"
        "def run(*_):\n    return [1.0], [1.0]\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    found = Watch()
    monkeypatch.setattr(sys, "meta_path", [found, *sys.meta_path])
    monkeypatch.delitem(sys.modules, MODULE, raising=False)
    return found


def untouched(watch: Watch, tmp_path: Path) -> bool:
    return not watch.asked and not (tmp_path / "mark").exists()


def places(value: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Paths of all texts in tables and lists, and of the names of tables."""
    if isinstance(value, dict):
        for key, one in value.items():
            yield from places(one, (*path, key))
    elif isinstance(value, list):
        for k, one in enumerate(value):
            yield from places(one, (*path, k))
    elif isinstance(value, str):
        yield path


def replaced(value: Any, path: Sequence[str | int], new: str) -> Any:
    """A copy with another text at `path`."""
    if not path:
        return new
    copy = dict(value) if isinstance(value, dict) else list(value)
    copy[path[0]] = replaced(copy[path[0]], path[1:], new)
    return copy


def fields(kind: type) -> Iterator[tuple[str, ...]]:
    """Paths of all fields of text in the schema of a file; `*` for an entry of a table or list."""
    whole = TypeAdapter(kind).json_schema()

    def below(one: Any, path: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
        if "$ref" in one:
            one = whole["$defs"][one["$ref"].rpartition("/")[2]]
        for part in (*one.get("anyOf", ()), *one.get("oneOf", ()), *one.get("allOf", ())):
            yield from below(part, path)
        for name, part in one.get("properties", {}).items():
            yield from below(part, (*path, name))
        for entries in ("items", "additionalProperties"):
            if isinstance(one.get(entries), dict):
                yield from below(one[entries], (*path, f"*{entries}"))
        if one.get("type") == "string":
            yield path

    yield from below(whole, ())


def with_field(table: Any, path: Sequence[str], new: str) -> Any:
    """A copy of a table with a text in a field that it may not have yet."""
    if not path:
        return new
    if path[0] == "*items":
        return [with_field({}, path[1:], new)]
    name = "x" if path[0] == "*additionalProperties" else path[0]
    known = table if isinstance(table, dict) else {}
    return {**known, name: with_field(known.get(name, {}), path[1:], new)}


def try_problem(folder: Path, table: Any, only: str = "problem.toml") -> None:
    (folder / only).write_text(toml_text(table))
    try:
        if only == "problem.toml":
            load_problem(folder)
        else:
            load_lock(folder / only)
    except UserError:
        pass


def test_no_text_of_a_problem_file_names_code(finished: Path, tmp_path: Path, watch: Watch) -> None:
    folder = tmp_path / "toy"
    (folder / "description.md").write_text("A system.")
    (folder / "plant.py").write_text(f"import {MODULE}\n\ndef simulate(u, p, x, dt): ...\n")
    whole = tomllib.loads(PROBLEM)
    small = tomllib.loads((finished.parents[1] / "toy" / "problem.toml").read_text())
    count = 0
    # A wrong table ends the reading, so each is also tried without the others.
    tables = [whole, *({**small, k: v} for k, v in whole.items()), small]
    for table in tables:
        for path in places(table):
            for name in NAMES:
                try_problem(folder, replaced(table, path, name))
                count += 1
    known = set(fields(ProblemFile))
    assert {("control", "setpoints"), ("loop", "enters"), ("data", "guard")} < {
        k[:2] for k in known
    }
    for path in known:
        for table in (small, whole):
            try_problem(folder, with_field(table, path, NAMES[0]))
            count += 1
    assert count > 150 + 2 * len(known)
    assert untouched(watch, tmp_path)


def test_no_text_of_a_lock_names_code(finished: Path, tmp_path: Path, watch: Watch) -> None:
    path = finished / "problem.lock.toml"
    table = tomllib.loads(path.read_text())
    table["loop"] = {"reference": "r", "controller": f"{MODULE}:run"}
    found = [path for path in places(table) if path != ("baseline",)]
    for place in found:
        for name in NAMES:
            try_problem(finished, replaced(table, place, name), path.name)
    for place in set(fields(LockFile)) - {("baseline",)}:
        try_problem(finished, with_field(table, place, NAMES[0]), path.name)
    assert len(found) > 10
    assert untouched(watch, tmp_path)


def test_no_text_of_a_ledger_names_code(finished: Path, tmp_path: Path, watch: Watch) -> None:
    """Each text of each kind of event in turn, with valid hashes."""
    ledger = finished / "ledger.jsonl"
    events = [adapter.dump_python(line.event, mode="json") for line in read_lines(ledger)]
    started = next(k for k, event in enumerate(events) if event["event"] == "started")
    events[started]["agent_settings"] = {"class": "x:y", "space": "library"}
    seen, opened = set[tuple[str | int, ...]](), 0
    for k, event in enumerate(events):
        for path in places(event):
            kind = (event["event"], *(p for p in path if isinstance(p, str)))
            if kind in seen or path == ("event",):
                continue
            seen.add(kind)
            changed = [*events[:k], replaced(event, path, f"{MODULE}:run"), *events[k + 1 :]]
            place, written = BEGIN, b""
            try:
                for one in changed:
                    raw = encode(place, adapter.validate_json(json.dumps(one)))
                    written += raw
                    place = place.behind(raw)
            except ValueError:  # one of several words was expected
                continue
            ledger.write_bytes(written)
            try:
                run = open_run(finished)
                opened += 1
                started = run.view.started
                recorded_agent(started.agent, started.agent_settings)
                verify(finished)
            except UserError:
                pass
    assert opened > 20
    assert untouched(watch, tmp_path)


def test_no_name_of_an_agent_is_imported_by_the_commands(
    finished: Path, tmp_path: Path, watch: Watch, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for agent in (f"{MODULE}:run", f"{MODULE}:run*2+expert", MODULE):
        place, written = BEGIN, b""
        for line in list(read_lines(finished / "ledger.jsonl")):
            event: Any = line.event
            if isinstance(event, Started):
                settings = {**event.agent_settings, "class": agent, "package": MODULE}
                event = adapter.validate_python(
                    {**adapter.dump_python(event), "agent": agent, "agent_settings": settings}
                )
            raw = encode(place, event)
            written += raw
            place = place.behind(raw)
        (finished / "ledger.jsonl").write_bytes(written)
        for words in (["status"], ["show"], ["verify"], ["verify", "--replay"]):
            command_line(words[0], finished, *words[1:])
    assert untouched(watch, tmp_path)


@pytest.mark.parametrize("controller", [f"{MODULE}:run", "cProfile:main", "pytest:main"])
def test_with_names_of_code_allowed_a_problem_file_runs_code(
    controller: str, finished: Path, tmp_path: Path, watch: Watch, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Attacks by the lock of a run and by the file of a workspace: refused, and both work where a
    reader of problem files looks the name up."""
    folder = tmp_path / "toy"
    loop = f'[loop]\nreference = "u"\ncontroller = "{controller}"\n'
    problem, lock = folder / "problem.toml", finished / "problem.lock.toml"
    problem.write_text(problem.read_text() + loop)
    lock.write_text(lock.read_text() + loop)
    readers = (lambda: load_problem(folder), lambda: load_lock(lock))
    for read in readers:
        with pytest.raises(UserError, match="controller is"):
            read()
    monkeypatch.chdir(folder)
    assert command_line("check", ".").code == 2
    assert command_line("report", finished).code == 2
    assert untouched(watch, tmp_path)
    found = list[object]()

    def obedient(path: Path, schema: object) -> None:
        table = tomllib.loads(path.read_text())
        found.append(_plugins.load_target(table["loop"]["controller"], "controller"))
        raise UserError("done")

    monkeypatch.setattr("asia.problem.load.read_table", obedient)
    for read in readers:
        with pytest.raises(UserError, match="done"):
            read()
    assert len(found) == 2
    assert all(callable(one) for one in found)
    assert watch.asked == ([MODULE] if MODULE in controller else [])


def test_a_family_of_a_package_that_brings_no_parts_is_not_imported(
    tmp_path: Path, watch: Watch
) -> None:
    with pytest.raises(UserError, match="there is no family"):
        _plugins.family_module(MODULE, "linear")
    assert untouched(watch, tmp_path)
