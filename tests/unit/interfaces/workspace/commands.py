"""Coding agents of our own for tests."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from asia.interfaces.coding_agents.presets import PRESETS, Preset, StreamFormat
from asia.interfaces.coding_agents.session import (
    CommandRules,
    command_agent,
    search_with_process,
)
from asia.judge.sandbox.availability import probe
from asia.judge.sandbox.types import Isolation
from asia.ledger.events import Event
from asia.ledger.view import SearchView
from asia.problem.load import load_problem
from asia.search.loop import OnEvent
from asia.search.run import Prepared, prepare

HERE = Path(__file__).resolve().parent
TOY = HERE.parents[1] / "search" / "toy.py"
JAILED = probe().level is Isolation.NAMESPACE
RULES = CommandRules(mounts=(HERE, TOY.parent), jail=JAILED)


def fake(format_: str, scenario: str, *arguments: str, dollars: tuple[str, ...] = ()) -> Preset:
    """The preset with a program of our own in place of the agent's."""
    words = (sys.executable, str(HERE / "fake_agent.py"), format_, scenario, *arguments)
    known = PRESETS[format_]
    return replace(
        known, start=words, resume=(*words, "resume") if known.resume else (), dollars=dollars
    )


def says(code: str, format_: StreamFormat = "claude", *arguments: str) -> Preset:
    """An agent that is a line of Python."""
    start = (sys.executable, "-c", code, "{prompt}", *arguments)
    return Preset(start=start, format=format_, tells_cost=True)


def with_config(problem: Path) -> CommandRules:
    """Return rules with a configuration folder: a session in a jail outlives its process."""
    config = problem.parent / ".claude"
    config.mkdir()
    (config / "login").write_text("a token")
    return replace(RULES, configs=(config,))


def run_command(
    ready: Prepared,
    preset: Preset,
    rules: CommandRules,
    on_event: OnEvent = lambda event, view: None,
) -> SearchView:
    agent = command_agent(ready, preset, rules)
    return search_with_process(ready, agent, agent, on_event, lambda view: None)


def go(
    problem: Path,
    preset: Preset,
    rules: CommandRules = RULES,
    on_event: Callable[[Event, SearchView], None] = lambda event, view: None,
) -> SearchView:
    """A whole sitting."""
    loaded = load_problem(problem)
    ready = prepare(loaded, "claude", seed=0, runs=problem.parent / "runs")
    return run_command(ready, preset, rules, on_event)
