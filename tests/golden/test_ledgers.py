"""Ledgers of earlier versions: they verify, are read as they were recorded, and go on."""

import json
import shutil
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.judge.sandbox.types import Isolation
from asia.ledger.index import brief
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.presentation.exports import journal, results_table
from asia.problem.load import load_problem
from asia.search.run import Prepared, prepare, search
from asia.search.scores import ScoreCheck
from asia.search.unsealing import unseal
from tests.golden.make_ledgers import AGENT, recorded
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.search.toy import arx

VERSIONS = sorted(p for p in Path(__file__).parent.iterdir() if (p / "runs").is_dir())
RUNS = [
    pytest.param(directory, id=f"{directory.parents[1].name}-{directory.name}")
    for version in VERSIONS
    for directory in sorted((version / "runs").iterdir())
]


@pytest.fixture
def version(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A copy: whoever asks a run may leave an index beside it."""
    shutil.copytree(request.param, tmp_path / "version")
    return tmp_path / "version"


@pytest.fixture
def run(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A copy of one run."""
    shutil.copytree(request.param, tmp_path / "runs" / request.param.name)
    return tmp_path / "runs" / request.param.name


def test_this_version_has_its_ledgers() -> None:
    names = {p.name for p in (VERSIONS[-1] / "runs").iterdir()}
    assert names >= {"finished", "interrupted", "unsealed", "steered"}


@pytest.mark.parametrize("run", RUNS, indirect=True)
def test_a_golden_ledger_verifies_and_is_read_as_it_was_recorded(run: Path) -> None:
    expected = json.loads((run / "recorded.json").read_text())
    assert recorded(open_run(run)) == expected
    found = verify(run)
    assert found.records == expected["records"]
    assert (found.torn > 0) == (run.name == "interrupted")
    assert brief(run).view.best == open_run(run).view.best


@pytest.mark.parametrize("version", VERSIONS, indirect=True, ids=lambda v: v.name)
def test_golden_scores_are_those_of_their_simulations(version: Path) -> None:
    problem = load_problem(version / "problem")
    for run in sorted((version / "runs").iterdir()):
        check = ScoreCheck(run, problem)
        verify(run, check=check)
        assert check.experiments == sum(e.score is not None for e in open_run(run).view.finished)
        assert check.tested == (2 if run.name == "unsealed" else 0)
        assert check.test_not_compared == ""


@pytest.mark.parametrize("run", RUNS, indirect=True)
def test_a_golden_ledger_is_printed(run: Path) -> None:
    expected = json.loads((run / "recorded.json").read_text())
    judged = [e for e in expected["experiments"] if e["status"]]
    for words in (["status"], ["verify"], ["show", run.name]):
        done = command_line(*words, "--runs", run.parent)
        assert done.code == 0, done.err
    shown = command_line("status", run.name, "--runs", run.parent).out
    assert f"{expected['state']}: {len(judged)} of {expected['budget']} experiments" in shown
    view = open_run(run).view
    assert results_table(view).count("\n") == len(judged) + 1
    assert journal(view).count("**Hypothesis:**") == len(judged)


def prepared(version: Path, name: str) -> Prepared:
    return prepare(
        load_problem(version / "problem"), AGENT.name, seed=0, runs=version / "runs", name=name,
        isolation=Isolation.PROCESS,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("version", VERSIONS, indirect=True, ids=lambda v: v.name)
def test_a_golden_search_goes_on_to_the_end_it_would_have_had(
    version: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Scores come out of this machine's linear algebra, and agree to rounding. These searches had
    no gate: with one they are not continued."""
    monkeypatch.setattr("asia.judge.evaluation.references.LINEAR", arx(2))
    runs = version / "runs"
    shutil.rmtree(runs / "unsealed")  # a copy of the finished run, which opened the test
    views = {}
    with pytest.raises(UserError, match="the gate of the guard records off, not on"):
        search(prepared(version, "finished"), AGENT, lambda event, view: None, lambda view: None)
    monkeypatch.setattr("asia.search.run.can_read_records", lambda names: False)
    for name in ("finished", "interrupted"):
        ready = prepared(version, name)
        before = open_run(runs / name).lines
        views[name] = search(ready, AGENT, lambda event, view: None, lambda view: None)
        assert open_run(runs / name).lines[: len(before)] == before
        assert verify(runs / name).torn == 0
    assert len(open_run(runs / "finished").lines) == len(open_run(runs / "interrupted").lines)
    pairs = zip(views["finished"].finished, views["interrupted"].finished, strict=True)
    for there, here in pairs:
        assert there.proposed == here.proposed
        assert there.result.status == here.result.status
        if there.score:
            assert here.score.value == pytest.approx(there.score.value, rel=1e-6)


@pytest.mark.parametrize("version", VERSIONS, indirect=True, ids=lambda v: v.name)
def test_a_golden_unsealing_is_not_repeated(version: Path) -> None:
    directory = version / "runs" / "unsealed"
    records = len(open_run(directory).lines)
    found = unseal(directory)
    assert not found.first_time
    assert len(open_run(directory).lines) == records
