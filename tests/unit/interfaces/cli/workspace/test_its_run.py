"""Commands about a run, given inside a workspace."""

from pathlib import Path

import pytest

from asia.interfaces.workspace.workspace import write_folder
from asia.problem.load import load_problem
from tests.unit.interfaces.cli.conftest import Asia, Searched
from tests.unit.search.toy import write_problem


@pytest.fixture
def folder(searched: Searched, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The workspace of a finished run; the commands are given in a folder below it."""
    made = tmp_path / "work"
    write_folder(made, load_problem(searched.problem), 1, searched.directory)
    monkeypatch.chdir(made / "data")
    return made


def test_the_run_of_the_workspace_is_found(searched: Searched, folder: Path, asia: Asia) -> None:
    del folder
    for words in (("status",), ("status", searched.name), ("show",), ("verify",)):
        done = asia(*words)
        assert done.code == 0, done.err
    assert f"run {searched.name}" in asia("status").out


def test_another_folder_of_runs_is_still_looked_in(
    folder: Path, asia: Asia, tmp_path: Path
) -> None:
    del folder
    done = asia("status", "--runs", tmp_path / "elsewhere")
    assert done.code == 2
    assert "no runs under" in done.err


def test_unsealing_asks_for_the_name(searched: Searched, folder: Path, asia: Asia) -> None:
    del folder
    done = asia("unseal", "--yes")
    assert done.code == 2
    assert f"name the run of this workspace, {searched.name}" in done.err


def test_a_search_that_has_not_begun(
    tmp_path: Path, asia: Asia, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_folder(
        tmp_path / "work", load_problem(write_problem(tmp_path / "toy")), 3, tmp_path / "runs" / "a"
    )
    monkeypatch.chdir(tmp_path / "work")
    done = asia("status")
    assert done.code == 2
    assert "has not started: asia try starts it" in done.err


def test_the_folder_of_a_coding_agent_has_no_run(
    tmp_path: Path, asia: Asia, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_folder(tmp_path / "work", load_problem(write_problem(tmp_path / "toy")), 3)
    monkeypatch.chdir(tmp_path / "work")
    done = asia("status")
    assert done.code == 2
    assert "results.tsv" in done.err
