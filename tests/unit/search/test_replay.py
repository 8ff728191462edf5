"""Replays of searches whose agents use no language model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import asia
from asia.agents.registry import AGENTS
from asia.errors import UserError
from asia.search.replay import Replayed, replay_run

from .toy import CRASH, NOISE, Scripted, arx, write_problem

AGENT = Scripted((arx(2), CRASH, arx(2)))


@pytest.fixture
def problem(tmp_path: Path) -> Path:
    return write_problem(tmp_path / "toy")


def replayed(directory: Path, tolerance: float = 0.0) -> dict[str, Replayed]:
    report = replay_run(directory, lambda item: None, tolerance)
    return {item.name: item for item in report.items if not item.name.startswith("reference")}


@pytest.mark.long
def test_an_agent_is_asked_again(
    problem: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Known agents are asked; the proposals of others come from the ledger; twins follow theirs."""
    run = asia.run(problem, agent=AGENT, runs=tmp_path / "runs", experiments=5)
    assert run.view.stopped is not None
    assert run.view.stopped.reason == "exhausted"
    taken = replayed(run.directory)
    assert [item.proposal for item in taken.values()] == ["same", "taken", "taken", "taken"]
    assert all(item.agrees for item in taken.values())
    assert taken["#04"].detail == "twin of #02"
    monkeypatch.setitem(AGENTS, "scripted", lambda: AGENT)
    asked = replayed(run.directory)
    assert [item.proposal for item in asked.values()] == ["same"] * 5
    assert asked["stop"].agrees
    monkeypatch.setitem(AGENTS, "scripted", lambda: replace(AGENT, sources=(arx(3),) * 4))
    other = replayed(run.directory)
    assert [name for name, item in other.items() if not item.agrees] == [
        "#02", "#03", "#04", "stop",
    ]  # fmt: skip
    assert other["#02"].detail == "the proposal differs in source"
    assert other["#02"].outcome == "same"
    assert "continues here" in other["stop"].detail


@pytest.mark.long
def test_an_outcome_of_chance_is_found_and_lies_within_a_tolerance(
    problem: Path, tmp_path: Path
) -> None:
    """NOISE differs in the tenth digit from fit to fit, and is never kept."""
    agent = Scripted((arx(2), NOISE))
    run = asia.run(problem, agent=agent, runs=tmp_path / "runs", experiments=3)
    strict = replayed(run.directory)
    assert [name for name, item in strict.items() if not item.agrees] == ["#03"]
    assert strict["#03"].outcome == "differs"
    close = replayed(run.directory, tolerance=1e-3)["#03"]
    assert (close.agrees, close.outcome) == (True, "close")
    assert close.apart is not None
    assert 0 < close.apart < 1e-6


@pytest.mark.slow
def test_a_replay_wants_the_same_data(problem: Path, tmp_path: Path) -> None:
    run = asia.run(problem, agent=Scripted(()), runs=tmp_path / "runs", experiments=1)
    table = (problem / "train.csv").read_text()
    (problem / "train.csv").write_text(table.replace("\n", "\n0.5,0.5\n", 1))
    with pytest.raises(UserError, match="training record 'train' changed"):
        replay_run(run.directory, lambda item: None)
