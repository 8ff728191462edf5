"""The level that a ledger names has no effect on what executes later, and the run that a workspace
names has none on what is shown."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.interfaces.workspace.workspace import Workspace, write_folder
from asia.judge.sandbox.availability import probe
from asia.judge.sandbox.types import Isolation
from asia.ledger.folder import MARK, link_path, linked_workspace
from asia.ledger.run import open_run
from asia.ledger.view import SearchView
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from asia.search.run import check_same_search, make_evaluator, prepare
from asia.search.unsealing import needs_consent
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.search.toy import write_problem

STRONGEST = probe().level


@pytest.fixture
def problem(tmp_path: Path) -> Problem:
    return load_problem(write_problem(tmp_path / "toy"))


def view_at(problem: Problem, tmp_path: Path, level: Isolation) -> SearchView:
    ready = prepare(problem, "expert", seed=0, runs=tmp_path / "runs", isolation=level)
    return SearchView(ready.started, 1, None)


@pytest.mark.skipif(STRONGEST is Isolation.PROCESS, reason="only level process works here")
def test_the_strongest_level_counts_whatever_the_ledger_says(
    problem: Problem, tmp_path: Path
) -> None:
    view = view_at(problem, tmp_path, Isolation.PROCESS)
    assert make_evaluator(problem, view).workers.isolation is STRONGEST
    asked = make_evaluator(problem, view, isolation=Isolation.PROCESS)
    assert asked.workers.isolation is Isolation.PROCESS


@pytest.mark.skipif(STRONGEST is Isolation.PROCESS, reason="only level process works here")
def test_a_search_goes_on_at_the_asked_level_alone(problem: Problem, tmp_path: Path) -> None:
    weak = view_at(problem, tmp_path, Isolation.PROCESS)
    strong = prepare(problem, "expert", seed=0, runs=tmp_path / "runs").started
    with pytest.raises(UserError, match=f"has isolation process, not {STRONGEST}"):
        check_same_search(weak, strong)
    check_same_search(weak, weak.started)


def test_a_test_opened_at_level_process_needs_consent(problem: Problem, tmp_path: Path) -> None:
    """Also where the candidates of the search were confined."""
    view = view_at(problem, tmp_path, Isolation.PROCESS)
    confined = replace(view, started=replace(view.started, isolation="namespace"))
    assert needs_consent(view)
    assert not needs_consent(confined)
    assert needs_consent(confined, Isolation.PROCESS)


@pytest.mark.skipif(sys.platform == "darwin", reason="sandbox-exec may work here")
def test_a_level_that_is_not_here_is_refused(problem: Problem, tmp_path: Path) -> None:
    view = view_at(problem, tmp_path, Isolation.PROCESS)
    with pytest.raises(UserError, match="omit --isolation"):
        make_evaluator(problem, view, isolation=Isolation.SANDBOX_EXEC)


# Workspaces.


@pytest.fixture
def work(problem: Problem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A workspace, in which an agent has put a copy of a run."""
    made = tmp_path / "work"
    write_folder(made, problem, 1, tmp_path / "runs" / "own")
    forged = made / "runs" / "forged"
    shutil.copytree(Path(__file__).parents[2] / "golden" / "0.1.0" / "runs" / "unsealed", forged)
    monkeypatch.chdir(made)
    monkeypatch.delenv("ASIA_RUNS", raising=False)
    return made


def test_what_a_workspace_says_of_its_run_has_no_effect(work: Path, tmp_path: Path) -> None:
    assert Workspace.find(work).run == tmp_path / "runs" / "own"
    (work / MARK).write_text(json.dumps({"run": str(work / "runs" / "forged")}))
    assert Workspace.find(work).run == tmp_path / "runs" / "own"
    (work / MARK).unlink()
    assert Workspace.find(work / "data").run == tmp_path / "runs" / "own"


@pytest.mark.parametrize("with_mark", [True, False])
def test_a_run_in_a_workspace_is_refused(work: Path, with_mark: bool) -> None:
    if not with_mark:
        (work / MARK).unlink()
    forged = work / "runs" / "forged"
    with pytest.raises(UserError, match="lies in the workspace"):
        open_run(forged)
    for words in (
        ("status", forged), ("status", "forged", "--runs", work / "runs"), ("show", forged),
        ("verify", forged), ("validate", forged), ("report", forged),
        ("export", forged, "--to", "numpy"), ("steer", forged, "--note", "hello"),
    ):  # fmt: skip
        done = command_line(*words)
        assert done.code == 2
        assert "lies in the workspace" in done.err, done.err
    away = work.parent / "link"
    away.symlink_to(forged)
    with pytest.raises(UserError, match="lies in the workspace"):
        open_run(away)


def test_the_forged_run_is_shown_without_the_principle(work: Path) -> None:
    """With neither link nor mark the same folder is a run as any other."""
    link_path(work).unlink()
    (work / MARK).unlink()
    assert open_run(work / "runs" / "forged").view.experiments


def test_no_search_begins_in_a_workspace(work: Path, problem: Problem) -> None:
    with pytest.raises(UserError, match="lies in the workspace"):
        prepare(problem, "expert", seed=0, runs=Path("runs"))


def test_a_planted_workspace_below_has_no_run(work: Path) -> None:
    inner = work / "inner"
    (inner / MARK).parent.mkdir(parents=True)
    (inner / MARK).write_text(json.dumps({"run": str(work / "runs" / "forged")}))
    assert Workspace.find(inner).run is None


def test_a_link_of_another_user_has_no_effect(work: Path) -> None:
    assert linked_workspace(work) is not None
    link_path(work).chmod(0o666)
    assert linked_workspace(work) is None
    assert Workspace.find(work).run is None
