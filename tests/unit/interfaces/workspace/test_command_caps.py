"""Tokens and money that a coding agent has spent, and caps that hold at any time."""

from dataclasses import replace
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.interfaces.coding_agents.session import CommandRules
from asia.ledger.chain import read_lines
from asia.ledger.events import Evaluated, Event
from asia.ledger.view import SearchView
from asia.problem.load import load_problem
from asia.search.run import prepare
from tests.unit.search.toy import write_problem

from .commands import RULES, TOY, fake, go, run_command, says, with_config
from .test_socket import ends

PAID = (
    "import json;print(json.dumps(dict(type='result',subtype='success',"
    "total_cost_usd=4.9,session_id='s')),flush=True)"
)


@pytest.fixture
def problem(tmp_path: Path) -> Path:
    return write_problem(tmp_path / "toy", experiments=3)


@pytest.mark.slow
def test_a_killed_session_does_not_reset_the_money_cap(problem: Path) -> None:
    first = go(problem, says(PAID), replace(RULES, cost=5.0, minutes=5))
    assert len(first.sessions) == 2  # 9.8 USD are spent
    sleeps = says("import time;time.sleep(60)")
    second = go(problem, sleeps, replace(RULES, cost=20.0, minutes=0.02))
    assert second.stopped is not None
    assert second.stopped.reason == "time"
    assert second.usage is not None
    assert second.usage.cost is None
    third = go(problem, says("pass"), replace(RULES, cost=19.0))
    assert third.stopped is not None
    assert third.stopped.reason == "cost"
    assert "9.80 of 19.00 USD, and up to 10.20" in third.stopped.detail


@pytest.mark.slow
def test_a_resumed_session_is_paid_once_with_a_cap(problem: Path) -> None:
    rules = replace(with_config(problem), cost=10.0)
    view = go(problem, fake("claude", "twice", dollars=("--budget", "{dollars}")), rules)
    costs = [s.usage.cost for s in view.sessions if s.usage]
    assert costs == [pytest.approx(0.03), pytest.approx(0.02)]


@pytest.mark.slow
def test_an_interrupted_session_is_charged(problem: Path) -> None:
    def interrupt(event: Event, view: SearchView) -> None:
        if isinstance(event, Evaluated) and event.experiment == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        go(problem, fake("claude", "search"), on_event=interrupt)
    ledger = problem.parent / "runs" / "toy-claude-s0" / "ledger.jsonl"
    kinds = [line.event.event for line in read_lines(ledger)]
    assert kinds.index("session_started") < kinds.index("streamed") < kinds.index("session_ended")


@pytest.mark.long
def test_a_session_that_a_crash_cut_off_is_charged_later(problem: Path) -> None:
    go(problem, fake("claude", "search"), replace(RULES, cost=5.0))
    directory = problem.parent / "runs" / "toy-claude-s0"
    lines = (directory / "ledger.jsonl").read_bytes().splitlines(keepends=True)
    ended = next(k for k, line in enumerate(lines) if b'"session_ended"' in line)
    (directory / "ledger.jsonl").write_bytes(b"".join(lines[:ended]))
    view = go(problem, fake("claude", "search"), replace(RULES, cost=5.0))
    assert view.sessions[0].outcome == "cut off with the search"
    assert view.sessions[0].usage is not None
    assert view.sessions[0].usage.tokens > 0
    assert view.stopped is not None


@pytest.mark.long
def test_failures_of_an_earlier_sitting_do_not_count(tmp_path: Path) -> None:
    problem = write_problem(tmp_path / "toy", experiments=4)
    first = go(problem, fake("claude", "fail"), replace(RULES, failures=1))
    assert first.stopped is not None
    assert first.stopped.reason == "stuck"
    second = go(problem, fake("claude", "search"), replace(RULES, failures=1))
    assert len(second.finished) > len(first.finished)


@pytest.mark.slow
def test_a_child_that_keeps_the_output_open_does_not_hold_the_search(problem: Path) -> None:
    code = "import subprocess;subprocess.Popen(['sleep','40'],start_new_session=True)"
    assert ends(lambda: go(problem, says(code), CommandRules(jail=False, minutes=5)), 30.0)


@pytest.mark.long
def test_time_is_capped_while_candidates_wait(tmp_path: Path) -> None:
    """An agent that hands in faster than is judged is watched all the same."""
    problem = write_problem(tmp_path / "toy", experiments=40)
    code = (
        "import sys,time;from pathlib import Path;from asia.agents import Proposal;"
        "from asia.interfaces.workspace.server import SocketDesk;import os;"
        "t=Path(sys.argv[2]).read_text();s={};"
        "exec(t[t.index('ARX = \"\"\"'):t.index('NOISE =')],s);"
        "d=SocketDesk(Path(os.environ['ASIA_DESK']));"
        "[d.submit(Proposal(s['ARX'].replace('{order}','2')+f'\\nN={i}\\n','a','t','h','e',None))"
        " for i in range(39)];time.sleep(15)"
    )
    loaded = load_problem(problem)
    loaded = replace(loaded, budget=replace(loaded.budget, patience=1000))
    ready = prepare(loaded, "claude", seed=0, runs=tmp_path / "runs")
    preset = says(code, "none", str(TOY))
    rules = replace(RULES, minutes=0.1)
    view = run_command(ready, preset, rules)
    assert view.stopped is not None
    assert view.stopped.reason == "time"
    assert len(view.finished) < 40


def test_tokens_told_late_need_minutes_too(problem: Path) -> None:
    for name in ("codex", "gemini"):
        with pytest.raises(UserError, match="--agent-minutes as well"):
            go(problem, fake(name, "search"), replace(RULES, tokens=10))
