"""Coding agents as processes: their streams, caps, ends, and the jail."""

import json
import socket
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.interfaces.coding_agents.presets import Stream, StreamFormat, make_preset
from asia.ledger.artifacts import Store
from asia.ledger.chain import read_lines
from asia.ledger.events import Streamed
from asia.ledger.run import open_run
from tests.unit.search.toy import write_problem

from .commands import JAILED, RULES, fake, go


@pytest.fixture
def problem(tmp_path: Path) -> Path:
    return write_problem(tmp_path / "toy", experiments=3)


@pytest.mark.parametrize(
    ("format_", "lines", "tokens"),
    [
        ("codex", 2 * ['{"type": "turn.completed", "usage": {"input_tokens": 100, '
                       '"output_tokens": 10}}'], 220),
        ("gemini", ['{"type": "message", "role": "assistant", "content": "working"}',
                    '{"type": "result", "status": "success", "stats": {"input_tokens": 200, '
                    '"output_tokens": 20}}'], 220),
    ],
)  # fmt: skip
def test_each_format_tells_its_tokens(format_: StreamFormat, lines: list[str], tokens: int) -> None:
    stream = Stream(format_)
    for line in ("this is not JSON", *lines):
        stream.feed(line)
    assert stream.usage.tokens == tokens


@pytest.mark.slow
def test_an_agent_drives_a_search(problem: Path) -> None:
    view = go(problem, fake("claude", "search"))
    assert view.stopped is not None
    assert view.stopped.reason == "budget"
    assert [e.proposed.title for e in view.finished[1:]] == [
        "order 2, number 0",
        "order 3, number 1",
    ]
    assert view.usage is not None
    assert view.usage.tokens <= 2 * 115
    assert view.usage.tokens >= 110
    directory = problem.parent / "runs" / "toy-claude-s0"
    store = Store(directory / "artifacts")
    chunks = [x.event.lines for x in read_lines(directory / "ledger.jsonl")
              if isinstance(x.event, Streamed)]  # fmt: skip
    stream = b"".join(store.get(name) for name in chunks).decode()
    assert "this is not JSON" in stream
    assert "V = " in stream


@pytest.mark.slow
def test_a_token_cap_ends_an_agent_in_flight(problem: Path) -> None:
    view = go(problem, fake("claude", "greedy"), replace(RULES, tokens=5000))
    assert view.stopped is not None
    assert view.stopped.reason == "tokens"
    assert view.usage is not None
    # At most one reply beyond the cap.
    assert 5000 <= view.usage.tokens < 5000 + 2 * 1015


@pytest.mark.slow
def test_a_hang_is_stuck(problem: Path) -> None:
    view = go(problem, fake("codex", "hang"), replace(RULES, stuck_minutes=0.02))
    assert view.stopped is not None
    assert view.stopped.reason == "stuck"
    assert "no new experiment" in view.stopped.detail


@pytest.mark.slow
def test_time_is_capped(problem: Path) -> None:
    view = go(problem, fake("gemini", "hang"), replace(RULES, minutes=0.05))
    assert view.stopped is not None
    assert view.stopped.reason == "time"


@pytest.mark.slow
def test_an_agent_that_leaves_at_once_is_asked_twice(problem: Path) -> None:
    view = go(problem, fake("claude", "leave"))
    assert view.stopped is not None
    assert view.stopped.reason == "agent"
    assert "cannot log in" in view.stopped.detail
    assert len(view.sessions) == 2


@pytest.mark.long
def test_a_search_stopped_by_a_cap_goes_on(problem: Path) -> None:
    first = go(problem, fake("claude", "hang"), replace(RULES, minutes=0.02))
    assert first.stopped is not None
    assert first.stopped.reason == "time"
    view = go(problem, fake("claude", "search"))
    assert view.stopped is not None
    assert view.stopped.reason == "budget"
    assert open_run(problem.parent / "runs" / "toy-claude-s0").view.complete


@pytest.mark.slow
@pytest.mark.skipif(not JAILED, reason="no namespaces here")
def test_the_jail_shows_the_workspace_and_the_socket_alone(
    problem: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SECRET_KEY", "not for you")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = str(server.getsockname()[1])
        runs = problem.parent / "runs"
        seen = (str(Path.home()), str(runs), str(problem), "127.0.0.1", port)
        go(problem, fake("claude", "probe", *seen))
    found = json.loads((runs / ".workspaces" / "toy-claude-s0" / "probe.json").read_text())
    assert not found["ledger"]
    assert not found["test"]
    assert not found["network"]
    assert found["written"] == []
    assert "SECRET_KEY" not in found["keys"]
    assert len(found["processes"]) <= 3
    inside = Path.home() in Path(sys.prefix).parents or Path.home() in Path(sys.base_prefix).parents
    assert found["home"] == inside


def test_what_cannot_be_capped_is_refused(problem: Path) -> None:
    with pytest.raises(UserError, match="does not report its cost"):
        go(problem, fake("codex", "search"), replace(RULES, cost=1.0))
    with pytest.raises(UserError, match="--agent-minutes"):
        go(problem, make_preset("mine", "mine {prompt}"), replace(RULES, tokens=10))
    with pytest.raises(UserError, match="with \\{prompt\\} or \\{prompt_file\\}"):
        make_preset("mine", "mine --now")
    with pytest.raises(UserError, match="there is claude, codex, gemini"):
        make_preset("mine", None)
