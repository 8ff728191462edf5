"""Runs that the live pages show, and a client with the token."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from asia.interfaces.cli.view import RunStarter
from asia.interfaces.view.app import TokenOnly, make_app
from asia.interfaces.view.followed import RunFolder
from asia.interfaces.view.streams import Streams
from asia.problem.load import load_problem
from asia.problem.lock import lock_text
from asia.problem.problem import Problem, Seal
from tests.unit.report.made_up import write_run

TOKEN = "the-token-of-these-tests"
ATTACK = "<script>document.title='owned'</script><img src=x onerror=document.title='owned'>"
OUTCOMES = (("first", 0.9), (ATTACK, 0.5), ("failing", None), ("last", 0.7))


@pytest.fixture(scope="session")
def problem() -> Problem:
    return load_problem("two_tanks_sim")


@pytest.fixture
def runs(tmp_path: Path, problem: Problem) -> Path:
    """A folder with the finished run `made`."""
    make_run(tmp_path / "runs" / "made", problem)
    return tmp_path / "runs"


def make_run(directory: Path, problem: Problem, outcomes=OUTCOMES, **further: object) -> Path:
    directory.mkdir(parents=True)
    (directory / "problem.lock.toml").write_text(lock_text(problem, Seal(None, None)), "utf-8")
    return write_run(directory, problem, outcomes, **further)


def write_linear(directory: Path) -> None:
    """Pages of the files that `asia linear` and `asia control` write into the run."""
    curve = {"name": "mean", "x": [0.01, 0.1], "y": [2.0, 0.5]}
    panels = [
        {"name": name, "axes": ["frequency [Hz]", name], "curves": [curve]}
        for name in ("frequency response", "phase")
    ]
    poles = [{"real": 0.9, "imag": 0.1}, {"real": 0.9, "imag": -0.1}]
    found = {"text": ["pole 0.9", ATTACK], "drawn": panels}
    for folder, more in (("linear", {"points": [{"at": "mean", "poles": poles, "zeros": []}]}),
                         ("control", {})):  # fmt: skip
        (directory / folder).mkdir()
        (directory / folder / f"{folder}.json").write_text(json.dumps({**found, **more}))


@pytest.fixture
def stranger(runs: Path) -> Iterator[TestClient]:
    """A client that was not given the token."""
    app = TokenOnly(make_app(RunFolder(runs), Streams(), TOKEN, RunStarter()), TOKEN, 8731)
    with TestClient(app, base_url="http://127.0.0.1:8731", follow_redirects=False) as client:
        yield client


@pytest.fixture
def client(stranger: TestClient) -> TestClient:
    """A client that opened the address with the token."""
    answer = stranger.get(f"/?token={TOKEN}")
    assert (answer.status_code, answer.headers["location"]) == (303, "/")
    return stranger
