"""A cheat is refused alike whoever submits it: an agent in this process, `asia try` in a workspace,
or a client of the MCP server."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import anyio
import numpy as np
import pytest
from mcp import Client

import asia
from asia.data.trajectory import Trajectory
from asia.errors import Reason
from asia.interfaces.mcp import open_search
from asia.interfaces.mcp.server import make_server
from asia.interfaces.workspace.process import SearchRequest
from asia.judge.sandbox.availability import fitting_levels, why_not
from asia.ledger.run import open_run
from tests.redteam.attacks.source import HONEST, fill_in
from tests.redteam.attacks.table import ATTACKS
from tests.redteam.problem import SmallProblem, small_problem
from tests.redteam.types import CandidateAttack
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.interfaces.mcp.conftest import Agent
from tests.unit.interfaces.workspace.desks import end_searches
from tests.unit.search.toy import Scripted

LEVELS = [x.isolation for x in fitting_levels() if x.confined and why_not(x.isolation) is None]


@dataclass(frozen=True)
class Cheat:
    """One variant of an attack, and what refuses it; no reason where it answers as the honest
    candidate does."""

    number: int
    variant: str
    reason: Reason | None = None
    words: str = ""

    @property
    def attack(self) -> CandidateAttack:
        found = next(a for a in ATTACKS if a.number == self.number)
        assert isinstance(found, CandidateAttack)
        return found

    @property
    def source(self) -> str:
        """As the suite submits it."""
        return filled(self.attack.sources[self.variant], small_problem(self.attack.problem))


CHEATS = [
    Cheat(51, "mean and spread"),
    Cheat(52, "one letter a sample", Reason.LITERALS, "bits of data more than #01"),
    Cheat(55, "without memory", Reason.SUSPECT, "look-ahead: "),
]


def filled(source: str, problem: SmallProblem) -> str:
    return fill_in(source, repr({"MARK": "rt-interface"}), problem)


def write_problem(folder: Path, problem: SmallProblem) -> Path:
    """The small problem as files, with the suite's honest candidate as the baseline."""
    folder.mkdir()
    names = [signal.name for signal in problem.context.inputs]

    def write(name: str, record: Trajectory) -> None:
        table = np.concatenate([record.u, record.y], axis=1)
        header = ",".join([*names, "level"])
        np.savetxt(folder / name, table, fmt="%.17g", delimiter=",", header=header, comments="")

    write("train.csv", problem.record)
    guard = 'guard = ["guard.csv"]\n' if problem.guard else ""
    standardised = "[preprocess]\ndetrend = true\nscale = true\n" if problem.standardised else ""
    for record in problem.guard:
        write("guard.csv", record)
    (folder / "baseline.py").write_text(filled(HONEST, problem))
    rule = problem.rule
    (folder / "problem.toml").write_text(
        f'name = "small"\nsampling_time = 1.0\ninputs = {json.dumps(names)}\noutputs = ["level"]\n'
        f'[data]\ntrain = ["train.csv"]\n{guard}{standardised}[protocol]\n'
        f"past_inputs = {rule.past_inputs}\npast_outputs = {rule.past_outputs}\n"
        "folds = { count = 2 }\n[budget]\nexperiments = 2\nfit_seconds = 60\nretests = 0\n"
    )
    return folder


def submit_here(problem: Path, runs: Path, source: str) -> None:
    asia.run(problem, agent=Scripted((source,)), runs=runs)


def submit_by_workspace(problem: Path, runs: Path, source: str) -> None:
    folder = runs.parent / "work"
    own = [] if (problem / "guard.csv").exists() else ["--no-guard"]
    made = command_line("agent", "workspace", problem, folder, "--runs", runs, *own)
    assert made.code == 0, made.err
    (folder / "candidate.py").write_text(source)
    done = command_line("try", "-m", "a lower V", "--dir", folder)
    assert done.code in (0, 3), done.err


def submit_by_mcp(problem: Path, runs: Path, source: str) -> None:
    request = SearchRequest(str(problem), "mcp", 0, None, None, None, None)

    async def main() -> None:
        async with Client(make_server(open_search(request, runs, None))) as client:
            agent = Agent(client)
            await agent.judged(await agent.submit(source))

    anyio.run(main)


@pytest.fixture
def runs(tmp_path: Path) -> Iterator[Path]:
    yield tmp_path / "runs"
    for run in (tmp_path / "runs").iterdir():
        end_searches(run)


@pytest.mark.slow
@pytest.mark.skipif(not LEVELS, reason="no level keeps intent in here")
@pytest.mark.parametrize(
    ("cheat", "submit"),
    [
        # Every interface and every cheat once; the other pairs before a release.
        pytest.param(cheat, submit, marks=[] if i == j else [pytest.mark.long])
        for i, cheat in enumerate(CHEATS)
        for j, submit in enumerate((submit_by_workspace, submit_by_mcp, submit_here))
    ],
    ids=lambda one: one.attack.name if isinstance(one, Cheat) else one.__name__,
)
def test_a_cheat_is_refused_by_every_interface(
    cheat: Cheat, submit: Callable[[Path, Path, str], None], runs: Path, tmp_path: Path
) -> None:
    problem = write_problem(tmp_path / "small", small_problem(cheat.attack.problem))
    submit(problem, runs, cheat.source)
    (run,) = (path for path in runs.iterdir() if (path / "ledger.jsonl").exists())
    view = open_run(run).view
    assert view.started.isolation == LEVELS[0]
    honest, cheating = view.experiments
    assert honest.score is not None
    assert view.best is honest
    if cheat.reason is None:
        assert cheating.score == honest.score
    else:
        assert cheating.failure is not None
        assert cheating.failure.reason is cheat.reason
        assert cheat.words in cheating.failure.detail
