"""Places that a coding agent must not reach, and secrets that must not be written down."""

from dataclasses import replace
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.interfaces.cli.options import CommandOptions, ModelOptions
from asia.interfaces.cli.run import command_driver
from asia.interfaces.coding_agents.presets import Stream
from asia.judge.sandbox.jail import Jail
from asia.ledger.artifacts import Store
from asia.ledger.chain import read_lines
from asia.ledger.events import Streamed, Usage
from asia.ledger.run import find_run
from tests.unit.search.toy import write_problem

from .commands import JAILED, RULES, fake, go, says, with_config


@pytest.fixture
def problem(tmp_path: Path) -> Path:
    return write_problem(tmp_path / "toy", experiments=3)


def streamed(problem: Path) -> bytes:
    directory = problem.parent / "runs" / "toy-claude-s0"
    events = [line.event for line in read_lines(directory / "ledger.jsonl")]
    store = Store(directory / "artifacts")
    return b"".join(store.get(e.lines) for e in events if isinstance(e, Streamed))


@pytest.mark.slow
def test_the_prompt_does_not_go_through_a_link(problem: Path) -> None:
    outside = problem.parent / "outside"
    outside.write_text("mine")
    folder = problem.parent / "runs" / ".workspaces" / "toy-claude-s0"
    folder.mkdir(parents=True)
    (folder / "PROMPT.md").symlink_to(outside)
    go(problem, fake("claude", "leave"))
    assert outside.read_text() == "mine"
    assert "PROGRAM.md" in (folder / "PROMPT.md").read_text()


@pytest.mark.slow
def test_a_workspace_is_never_taken_for_a_run(problem: Path) -> None:
    go(problem, fake("claude", "leave"))
    runs = problem.parent / "runs"
    forged = runs / ".workspaces" / "toy-claude-s0" / "ledger.jsonl"
    forged.write_bytes((runs / "toy-claude-s0" / "ledger.jsonl").read_bytes())
    (runs / "toy-claude-s0" / "ledger.jsonl").touch()
    assert [p.parent.name for p in runs.glob("*/ledger.jsonl")] == ["toy-claude-s0"]
    assert find_run(runs, None).name == "toy-claude-s0"
    with pytest.raises(UserError, match="looks like a run"):
        go(problem, fake("claude", "leave"))


def test_a_session_is_not_taken_for_an_option() -> None:
    stream = Stream("claude")
    stream.feed('{"type": "system", "session_id": "--settings=x"}')
    assert stream.session == ""


def test_totals_of_a_resumed_session_hold_the_earlier_ones() -> None:
    line = (
        '{"type": "result", "subtype": "success", "total_cost_usd": 0.5,'
        ' "modelUsage": {"m": {"inputTokens": 100, "outputTokens": 30}}}'
    )
    stream = Stream("claude", Usage(60, 10, 0, 0.2))
    stream.feed(line)
    assert stream.usage == Usage(40, 20, 0, pytest.approx(0.3))
    assert stream.totals == Usage(100, 30, 0, 0.5)


@pytest.mark.slow
@pytest.mark.skipif(not JAILED, reason="no namespaces here")
def test_the_jail_has_limits_and_a_configuration_is_a_copy(problem: Path) -> None:
    code = (
        "from pathlib import Path;p=Path.home()/'.claude'/'login';print(p.read_text());"
        "p.write_text('changed');import resource as r;"
        "print([r.getrlimit(k)[1] for k in (r.RLIMIT_NPROC,r.RLIMIT_FSIZE)]);"
        'print(\'{"type":"result","subtype":"\' + chr(92) + \'ud800\' + chr(92) + \'u001b"}\')'
    )
    view = go(problem, says(code), with_config(problem))
    assert b"a token" in streamed(problem)
    assert (problem.parent / ".claude" / "login").read_text() == "a token"
    assert b"[512, 1073741824]" in streamed(problem)
    # Half a character in a stream is no crash.
    assert view.sessions[0].outcome == "\N{REPLACEMENT CHARACTER}" * 2


@pytest.mark.skipif(not JAILED, reason="no namespaces here")
def test_a_mounted_program_is_found(tmp_path: Path) -> None:
    program = tmp_path / "tool" / "bin" / "mine"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    for mount in (tmp_path / "tool", tmp_path / "tool" / "bin"):
        assert Jail(tmp_path, tmp_path, mounts=(mount,)).find("mine") == str(program)
    assert Jail(tmp_path, tmp_path).find("mine") is None
    assert Jail(tmp_path, tmp_path).find(str(program)) is None


def test_a_program_that_is_not_there_is_said_up_front(problem: Path) -> None:
    preset = replace(says("pass"), start=("no-such-program", "{prompt}"))
    with pytest.raises(UserError, match=r"'no-such-program' cannot be run.*--agent-mount"):
        go(problem, preset)
    assert not (problem.parent / "runs").exists()


@pytest.mark.skipif(not JAILED, reason="no namespaces here")
def test_a_mount_does_not_show_the_runs(problem: Path) -> None:
    with pytest.raises(UserError, match="would show the agent the runs"):
        go(problem, fake("claude", "leave"), replace(RULES, mounts=(problem.parent,)))


def driver(agent: str, command: str | None, configs: list[Path] | None = None) -> dict[str, str]:
    options = CommandOptions(command=command, network=True, agent_config=configs)
    return command_driver(agent, options, ModelOptions()).settings


@pytest.mark.parametrize("name", ["expert", "random", "llm", "workspace", "mcp"])
def test_a_program_cannot_take_a_built_in_name(name: str) -> None:
    with pytest.raises(UserError, match="is reserved"):
        driver(f"command:{name}", "true {prompt}")


def test_settings_are_recorded_and_a_link_keeps_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """~/.claude is often a link into a folder of dotfiles; below the agent's home it is .claude."""
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "dotfiles").mkdir()
    (tmp_path / ".claude").symlink_to(tmp_path / "dotfiles")
    settings = driver("command:claude", None, [tmp_path / ".claude"])
    assert settings["configs"] == "~/.claude"
    assert settings["network"] == "yes"
    assert settings["mounts"] == "none"
    assert settings["jail"] == ("namespace" if JAILED else "none")
