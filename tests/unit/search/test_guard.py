"""Guard records: seen by nothing in a search, looked at when it ends, and every look counted."""

import pickle
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asia.agents import AgentView
from asia.errors import UserError
from asia.interfaces.workspace.process import SearchRequest
from asia.interfaces.workspace.workspace import make_workspace
from asia.judge.sandbox.worker.process import Channel
from asia.judge.scoring.outcome import Score
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.ledger.view import SearchView
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from asia.search.agent_views import agent_view, problem_facts
from asia.search.run import Prepared, prepare, search

from .toy import Scripted, arx, write_problem

AGENT = Scripted((arx(2), arx(3)))
MARK = 7654.25


def guard(root: Path) -> Path:
    """The toy problem, with a guard record that holds a number like no other."""
    problem = write_problem(root / "toy", experiments=2)
    table = np.loadtxt(problem / "test.csv", delimiter=",", skiprows=1)
    table[-1] = MARK
    np.savetxt(problem / "unseen.csv", table, delimiter=",", header="u,y", comments="")
    name = problem / "problem.toml"
    name.write_text(name.read_text().replace("[data]\n", '[data]\nguard = ["unseen.csv"]\n'))
    return problem


@pytest.fixture
def guarded(tmp_path: Path) -> Path:
    return guard(tmp_path)


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SearchView]:
    root = tmp_path_factory.mktemp("guarded")
    return root, go(load_problem(guard(root)), root / "runs")


@pytest.fixture
def looked(once: tuple[Path, SearchView], tmp_path: Path) -> SearchView:
    """A finished search, of which `tmp_path` has a copy beside its problem."""
    shutil.copytree(once[0], tmp_path, dirs_exist_ok=True)
    return once[1]


def prepared(problem: Problem, runs: Path) -> Prepared:
    """A search whose agent cannot read the training records: the guard is for the last look."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("asia.search.run.can_read_records", lambda names: False)
        return prepare(problem, AGENT.name, seed=0, runs=runs)


def go(problem: Problem, runs: Path) -> SearchView:
    ready = prepared(problem, runs)
    return search(ready, AGENT, lambda event, view: None, lambda view: None)


def extended(problem: Path, experiments: int) -> Problem:
    loaded = load_problem(problem)
    return replace(loaded, budget=replace(loaded.budget, experiments=experiments))


@pytest.mark.slow
def test_the_last_new_bests_are_looked_at_once(looked: SearchView, tmp_path: Path) -> None:
    assert looked.complete
    (look,) = looked.looks
    assert look.look == 1
    assert [s.experiment for s in look.scores] == [1, 2]
    values = [s.outcome.value for s in look.scores if isinstance(s.outcome, Score)]
    assert look.pick == look.scores[int(np.argmin(values))].experiment
    directory = tmp_path / "runs" / "toy-scripted-s0"
    verify(directory)
    size = (directory / "ledger.jsonl").stat().st_size
    go(load_problem(tmp_path / "toy"), tmp_path / "runs")
    assert (directory / "ledger.jsonl").stat().st_size == size


@pytest.mark.slow
@pytest.mark.usefixtures("looked")
def test_a_second_look_is_counted(tmp_path: Path) -> None:
    view = go(extended(tmp_path / "toy", 3), tmp_path / "runs")
    assert view.best is not None
    assert view.best.number == 3
    assert [look.look for look in view.looks] == [1, 2]


@pytest.mark.slow
def test_a_search_that_ends_again_with_the_same_bests_learns_nothing(
    guarded: Path, tmp_path: Path
) -> None:
    agent = Scripted((arx(3), arx(2), arx(1)))
    for experiments in (2, 4):
        ready = prepared(extended(guarded, experiments), tmp_path / "runs")
        view = search(ready, agent, lambda event, view: None, lambda view: None)
    assert [look.look for look in view.looks] in ([1, 1], [1, 2])
    same = view.looks[0].scores == view.looks[1].scores
    assert same == (view.looks[1].look == 1)


@pytest.mark.slow
def test_a_look_that_was_cut_off_is_made_up_for(looked: SearchView, tmp_path: Path) -> None:
    ledger = tmp_path / "runs" / "toy-scripted-s0" / "ledger.jsonl"
    lines = ledger.read_bytes().splitlines(keepends=True)
    assert b'"event":"guard"' in lines[-1]
    ledger.write_bytes(b"".join(lines[:-1]))
    assert not open_run(ledger.parent).view.complete
    assert go(load_problem(tmp_path / "toy"), tmp_path / "runs").looks == looked.looks


@pytest.mark.slow
def test_nobody_gets_to_see_it(
    guarded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = load_problem(guarded)
    sent: list[bytes] = []
    send = Channel.send

    def spy(self: Channel, request: tuple[bytes, str, Any], deadline: float) -> None:
        sent.append(pickle.dumps(request, protocol=5))
        send(self, request, deadline)

    monkeypatch.setattr(Channel, "send", spy)
    seen: list[AgentView] = []

    class Watching(Scripted):
        def propose(self, view: AgentView) -> Any:
            seen.append(view)
            assert not any(MARK in r.y or MARK in r.u for r in view.facts.records)
            assert not any(np.float64(MARK).tobytes() in body for body in sent)
            return super().propose(view)

    agent = Watching(AGENT.sources)
    ready = prepare(problem, "scripted", seed=0, runs=tmp_path / "runs")
    view = search(ready, agent, lambda event, view: None, lambda view: None)
    assert len(seen) == 1
    held_back = [body for body in sent if np.float64(MARK).tobytes() in body]
    # Its inputs, when the search is over: two folds of two candidates, each asked twice.
    assert len(held_back) == 8
    after = agent_view(problem_facts(problem), view, open_run(ready.directory).store)
    assert "7654" not in repr(after)
    order = SearchRequest(problem=str(guarded), agent="workspace", experiments=3)
    make_workspace(tmp_path / "work", ready, order)
    texts = [p.read_bytes() for p in (tmp_path / "work").rglob("*") if p.is_file()]
    assert texts
    assert not any(b"7654" in text or b"unseen" in text for text in texts)


@pytest.mark.slow
@pytest.mark.usefixtures("looked")
def test_a_guard_that_was_changed_is_not_looked_at(tmp_path: Path) -> None:
    unseen = tmp_path / "toy" / "unseen.csv"
    unseen.write_text(unseen.read_text().replace("7.654", "7.655"))
    with pytest.raises(UserError, match="guard changed"):
        go(extended(tmp_path / "toy", 3), tmp_path / "runs")


@pytest.mark.slow
def test_a_look_at_a_model_that_fails_there_is_a_failure(guarded: Path, tmp_path: Path) -> None:
    ready = prepared(load_problem(guarded), tmp_path / "runs")
    wild = f"        n = 2\n        assert np.abs(u).max() < {MARK / 2}\n"
    picky = arx(2).replace("        n = 2\n", wild, 1)
    view = search(ready, Scripted((picky,)), lambda event, view: None, lambda view: None)
    look = view.looks[0]
    assert [isinstance(s.outcome, Score) for s in look.scores] == [True, False]
    assert look.pick == 1
