"""Several coding agents on one search: one ledger, one budget, results visible to all."""

import json
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from asia.agents.registry import AGENTS, COMPANION, make_agent
from asia.errors import UserError
from asia.interfaces.cli.options import CommandOptions, ModelOptions
from asia.interfaces.cli.run import command_driver
from asia.interfaces.coding_agents.session import (
    CommandRules,
    Spent,
    command_agent,
    search_with_process,
)
from asia.ledger.artifacts import Store
from asia.ledger.chain import read_lines
from asia.ledger.events import SessionStarted, Streamed
from asia.ledger.run import open_run
from asia.ledger.view import SearchView
from asia.presentation.experiments import experiment_facts
from asia.problem.load import load_problem
from asia.search.replay import Replayed, replay_run
from asia.search.run import prepare
from tests.unit.search.toy import Scripted, arx, write_problem

from .commands import HERE, JAILED, RULES, TOY, fake, says

NAMES = ("claude-1", "claude-2", "claude-3")
NAME = "several"


def search_several(
    problem: Path,
    plans: Mapping[str, Sequence[str]],
    rules: CommandRules = RULES,
    companion: str = "",
) -> SearchView:
    settings = {COMPANION: companion} if companion else {}
    ready = prepare(
        load_problem(problem), NAME, seed=0, runs=problem.parent / "runs", name=NAME,
        agent_settings=settings,
    )  # fmt: skip
    preset = fake("gemini", "plan", json.dumps(plans))
    beside = make_agent(companion) if companion else None
    agent = command_agent(ready, preset, rules, tuple(plans), beside)
    return search_with_process(ready, agent, agent, lambda *_: None, lambda view: None)


def output(directory: Path, name: str) -> str:
    """All that the sessions of an agent have written."""
    events = [line.event for line in read_lines(directory / "ledger.jsonl")]
    own = {e.session for e in events if isinstance(e, SessionStarted) and e.agent == name}
    lines = [e.lines for e in events if isinstance(e, Streamed) and e.session in own]
    return b"".join(map(Store(directory / "artifacts").get, lines)).decode()


def check_replay(directory: Path) -> list[Replayed]:
    """Every outcome again, bitwise."""
    report = replay_run(directory, lambda item: None)
    assert {item.outcome for item in report.items} == {"same"}
    assert report.agrees
    return [item for item in report.items if item.name.startswith("#")]


@pytest.mark.slow
def test_three_agents_share_a_search_and_two_of_them_die(tmp_path: Path) -> None:
    problem = write_problem(tmp_path / "toy", experiments=4)
    plans = {
        "claude-1": ["try 2", "see 5", "try 5", "try 4"],
        "claude-2": ["die"],
        "claude-3": ["try 2", "submit 5", "die"],
    }
    view = search_several(problem, plans)
    directory = tmp_path / "runs" / NAME
    assert view.stopped is not None
    assert view.stopped.reason == "budget"
    brought = {e.proposed.title: e.proposed.agent for e in view.finished[1:]}
    assert sorted(brought) == ["order 2", "order 4", "order 5"]
    assert len(view.finished) == 4
    assert brought["order 2"] in ("claude-1", "claude-3")
    assert brought["order 5"] == "claude-3"
    assert brought["order 4"] == "claude-1"
    assert all(e.result is not None and e.result.duplicate_of is None for e in view.finished)
    # Both have the result of the idea that both had, and it was evaluated once.
    answers = [output(directory, name) for name in NAMES]
    second = next(e for e in view.finished if e.proposed.title == "order 2")
    for name in ("claude-1", "claude-3"):
        assert f"#{second.number:02d}" in output(directory, name)
    assert all("not evaluated again" in answers[k] for k in (0, 2))
    for name in NAMES:
        folder = tmp_path / "runs" / ".workspaces" / NAME / name
        table = (directory / "results.tsv").read_text()
        assert (folder / "results.tsv").read_text() == table
        assert f"You are {name}." in (folder / "PROMPT.md").read_text()
    assert ("agent", "claude-1") in experiment_facts(
        next(e for e in view.finished if e.proposed.title == "order 4"), view
    )
    assert {item.proposal for item in check_replay(directory)} == {"same", "taken"}


@pytest.mark.slow
def test_the_search_ends_when_all_have_ended(tmp_path: Path) -> None:
    problem = write_problem(tmp_path / "toy", experiments=4)
    view = search_several(problem, {"claude-1": ["try 2"], "claude-2": ["die"]})
    assert view.stopped is not None
    assert view.stopped.reason == "agent"
    assert "claude-1: it ended 2 times" in view.stopped.detail
    assert "claude-2: it ended 2 times" in view.stopped.detail
    assert [e.proposed.agent for e in view.finished] == ["", "claude-1"]


@pytest.mark.slow
def test_expert_has_its_share_and_the_rest_when_the_others_have_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    quick = Scripted(tuple(f"{arx(1)}\nK = {k}\n" for k in range(4)), "expert")
    monkeypatch.setitem(AGENTS, "expert", lambda: quick)
    problem = write_problem(tmp_path / "toy", experiments=5)
    view = search_several(problem, {"claude": ["try 2"]}, companion="expert")
    assert [e.proposed.agent for e in view.finished] == ["", "expert", "claude", *2 * ["expert"]]
    items = check_replay(tmp_path / "runs" / NAME)
    assert [item.proposal for item in items] == ["same", "same", "taken", "same", "same"]


@pytest.mark.slow
def test_a_cap_is_that_of_all_agents(tmp_path: Path) -> None:
    problem = write_problem(tmp_path / "toy", experiments=3)
    ready = prepare(load_problem(problem), NAME, seed=0, runs=tmp_path / "runs", name=NAME)
    paid = (
        "import json,time;print(json.dumps(dict(type='result',subtype='success',"
        "total_cost_usd=1.2,session_id='s')),flush=True);time.sleep(60)"
    )
    agent = command_agent(ready, says(paid), replace(RULES, cost=3.0), NAMES)
    view = search_with_process(ready, agent, agent, lambda *_: None, lambda view: None)
    assert view.stopped is not None
    assert view.stopped.reason == "cost"
    # Each was allowed a third, so that none could spend what another one may.
    assert [event.grant for event in view.begun] == [1.0, 1.0, 1.0]
    assert Spent.of(view, ()).cost == pytest.approx(3.6)


def test_an_agent_waits_while_others_may_spend_what_is_left(tmp_path: Path) -> None:
    problem = write_problem(tmp_path / "toy", experiments=3)
    ready = prepare(load_problem(problem), NAME, seed=0, runs=tmp_path / "runs", name=NAME)
    paid = (
        "import json,pathlib,time;"
        "late = 'You are claude-1.' not in pathlib.Path('PROMPT.md').read_text();"
        "time.sleep(3 * late);"
        "print(json.dumps(dict(type='result',subtype='success',"
        "total_cost_usd=1.2 if late else 1.05,session_id='s')),flush=True);time.sleep(60 * late)"
    )
    agent = command_agent(ready, says(paid), replace(RULES, cost=3.0), NAMES)
    view = search_with_process(ready, agent, agent, lambda *_: None, lambda view: None)
    assert view.stopped is not None
    assert view.stopped.reason == "cost"
    # The first one ended above its share, and was not started again on the money of the others.
    assert [event.grant for event in view.begun] == [1.0, 1.0, 1.0]
    assert Spent.of(view, ()).cost == pytest.approx(3.45)


def command_line(problem: Path, plans: Mapping[str, Sequence[str]]) -> list[str]:
    words = f"{sys.executable} {HERE / 'fake_agent.py'} gemini plan '{json.dumps(plans)}'"
    asia = [sys.executable, "-c", "from asia.interfaces.cli import main; main()"]
    return [
        *asia, "run", str(problem), "--agent", "command:mine*3", "--name", NAME,
        "--command", f"{words} {{prompt_file}}", "--agent-mount", str(HERE),
        "--agent-mount", str(TOY.parent), "--runs", str(problem.parent / "runs"),
    ]  # fmt: skip


@pytest.mark.slow
def test_a_search_killed_at_any_point_goes_on(tmp_path: Path) -> None:
    problem = write_problem(tmp_path / "toy", experiments=6)
    plans = {
        "mine-1": ["try 2", "try 3"], "mine-2": ["try 3", "try 4"], "mine-3": ["try 5", "try 6"]
    }  # fmt: skip
    words, ledger = command_line(problem, plans), tmp_path / "runs" / NAME / "ledger.jsonl"
    before: list[bytes] = []
    for event, times in (("session_started", 2), ("proposed", 2), ("evaluated", 3)):
        with (tmp_path / "log").open("ab") as log:
            search = subprocess.Popen(words, stdout=log, stderr=log)
        end = time.monotonic() + 300.0
        while search.poll() is None and time.monotonic() < end:
            lines = ledger.read_bytes() if ledger.is_file() else b""
            if lines.count(f'"event":"{event}"'.encode()) >= times:
                break
            time.sleep(0.01)
        assert search.poll() is None
        search.kill()
        search.wait()
        lines = [line for line in ledger.read_bytes().splitlines(True) if line.endswith(b"\n")]
        assert lines[: len(before)] == before
        before = lines
    assert subprocess.run(words, capture_output=True, check=False).returncode == 0
    assert ledger.read_bytes().splitlines(True)[: len(before)] == before
    view = open_run(ledger.parent).view
    titles = [e.proposed.title for e in view.finished]
    assert sorted(titles) == ["baseline", *(f"order {k}" for k in range(2, 7))]
    assert not [e for e in view.finished if e.result and e.result.duplicate_of]
    check_replay(ledger.parent)


@pytest.mark.parametrize(
    ("agent", "words"),
    [
        ("command:mine*0", r"expected command:NAME\*N with N from 1 to 16"),
        ("command:mine*17", r"expected command:NAME\*N with N from 1 to 16"),
        ("command:mine*", r"expected command:NAME\*N with N from 1 to 16"),
        ("command:mine*two", r"expected command:NAME\*N with N from 1 to 16"),
        ("command:mine*2,command:other", r"one command:NAME\*N, and beside it expert"),
        ("command:mine,random", r"one command:NAME\*N, and beside it expert"),
        ("expert,command:mine,expert", r"one command:NAME\*N, and beside it expert"),
        ("command:,expert", "with letters and digits"),
    ],
)
def test_another_number_or_name_is_refused(agent: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        command_driver(agent, CommandOptions(command="true {prompt}"), ModelOptions())


def test_settings_and_name_say_how_many() -> None:
    options = CommandOptions(command="true {prompt}")
    several = command_driver("expert,command:mine*3", options, ModelOptions())
    assert several.name == "mine-x3+expert"
    assert several.settings["agents"] == "3"
    assert several.settings[COMPANION] == "expert"
    for agent in ("command:mine", "command:mine*1"):
        one = command_driver(agent, options, ModelOptions())
        assert one.name == "mine"
        assert one.settings == {
            k: v for k, v in several.settings.items() if k not in ("agents", COMPANION)
        }
    assert several.settings["jail"] == ("namespace" if JAILED else "none")
