"""Questions of `asia unseal` before it opens a test, and the alarm after it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from asia.judge.sandbox.types import Isolation
from asia.ledger.run import open_run
from asia.problem.load import load_problem
from asia.search.run import prepare, search
from tests.unit.search.toy import Scripted, arx, write_problem

from .conftest import Asia, Terminal


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The runs of a finished search at level process, with nothing to compile in it."""
    root = tmp_path_factory.mktemp("process")
    ready = prepare(
        load_problem(write_problem(root / "toy", experiments=1)), "random", seed=0,
        runs=root / "runs", isolation=Isolation.PROCESS,
    )  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("asia.judge.evaluation.references.LINEAR", arx(2))
        search(ready, Scripted((), "random"), lambda event, view: None, lambda view: None)
    return root / "runs"


@pytest.fixture
def run(searched: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A copy of it, below the directory that commands run in."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(searched, tmp_path / "runs")
    return "toy-random-s0"


def opened(run: str) -> bool:
    return open_run(Path("runs") / run).view.unsealing is not None


@pytest.mark.slow
def test_a_script_says_yes_to_each(run: str, asia: Asia) -> None:
    done = asia("unseal", run, "--yes")
    assert done.code == 2
    assert "level process" in done.err
    assert "--yes-process" in done.err
    assert not opened(run)
    assert asia("unseal", run, "--yes-process").code == 2
    assert not opened(run)
    assert asia("unseal", run, "--yes", "--yes-process").code == 0
    assert opened(run)
    # The test is of the same system.
    assert "ALARM" not in asia("status", run).out


@pytest.mark.slow
def test_a_person_is_told_why_and_asked(
    run: str, asia: Asia, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", Terminal(run, "n"))
    refused = asia("unseal", run)
    assert refused.code == 2
    assert "can read every file that you can" in refused.err
    assert "nothing was opened" in refused.err
    assert not opened(run)
    monkeypatch.setattr("sys.stdin", Terminal(run, "y"))
    assert asia("unseal", run).code == 0
    assert opened(run)


@pytest.mark.slow
def test_a_test_error_far_above_v_is_printed_first_and_in_red(
    tmp_path: Path, asia: Asia, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, runs = write_problem(tmp_path / "toy", experiments=2), tmp_path / "runs"
    table = np.loadtxt(problem / "test.csv", delimiter=",", skiprows=1)
    table[:, 1] *= -1
    np.savetxt(problem / "test.csv", table, delimiter=",", header="u,y", comments="")
    monkeypatch.setattr("asia.judge.evaluation.references.LINEAR", arx(2))
    ready = prepare(load_problem(problem), "scripted", seed=0, runs=runs)
    search(ready, Scripted((arx(2),)), lambda event, view: None, lambda view: None)
    run = ready.directory
    # Nothing is known before the test is opened.
    assert "ALARM" not in asia("status", run).out
    opened_first = json.loads(asia("unseal", run, "--yes", "--yes-process", "--json").out)
    (words,) = opened_first["alarms"]
    assert " times V" in words
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm-256color")
    for command in ("unseal", "status", "show"):
        done = asia(command, run)
        assert done.code == 0, done.err
        # Bold and red, before any other line.
        assert done.out.startswith("\x1b[1;31mALARM    the test error is "), command
