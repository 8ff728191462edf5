"""Everything that reads outputs, on searches whose records miss one output sample in five.

In one of them fits standardise their records too.
"""

from __future__ import annotations

import csv
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from starlette.testclient import TestClient

import asia
from asia import SystemIdentifier
from asia.agents.expert.agent import ExpertAgent
from asia.agents.llm.prompt import problem_text
from asia.analysis.ablation import ablate
from asia.analysis.confirmation import confirm
from asia.analysis.validation import validate
from asia.export.pipeline import export
from asia.interfaces.cli.show import describe, wide_console
from asia.interfaces.view.app import TokenOnly, make_app
from asia.interfaces.view.followed import RunFolder
from asia.interfaces.view.streams import Streams
from asia.interfaces.workspace.tools import WorkspaceTools, draw, tables
from asia.interfaces.workspace.workspace import write_folder
from asia.judge.evaluation.references import LINEAR, LINEAR_REFERENCE
from asia.judge.scoring.checks.check import Verdict
from asia.judge.scoring.outcome import Score
from asia.ledger.run import Run, open_run
from asia.ledger.verification import verify
from asia.problem.check import check_problem
from asia.problem.load import load_problem
from asia.problem.seal import seal
from asia.report.files import draw_cases, draw_problem, write_figures, write_report
from asia.report.page.page import write_page
from asia.search.agent_views import agent_view, problem_facts
from asia.search.dry_runs import dry_run
from asia.search.run import prepare, search
from asia.search.scores import ScoreCheck
from asia.search.simulation import simulated_excerpts
from tests.unit.painting import unpainted

from .toy import Scripted, arx, write_problem


def with_gaps(path: Path) -> None:
    """One output in five empty, two in a row among them, never in the first rows."""
    rows = list(csv.reader(path.read_text().splitlines()))
    lost = np.random.default_rng(3).random(len(rows)) < 0.2
    lost[40:42] = True
    lost[:5] = False
    rows = [[row[0], ""] if gone else row for row, gone in zip(rows, lost, strict=True)]
    path.write_text("\n".join(",".join(row) for row in rows) + "\n")


@dataclass(frozen=True)
class Searched:
    problem: Path
    run: Run
    folder: Path


@pytest.fixture(
    scope="module",
    params=[
        "simulation",
        pytest.param("windows", marks=pytest.mark.long),
        pytest.param("standardised", marks=pytest.mark.long),
    ],
)
def searched(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Searched:
    folder = tmp_path_factory.mktemp(request.param)
    problem = write_problem(folder / "toy", experiments=2)
    for name in ("train", "test"):
        with_gaps(problem / f"{name}.csv")
    (problem / "baseline.py").write_text(arx(1))
    text = (problem / "problem.toml").read_text()
    if request.param == "windows":
        text = text.replace("[protocol]", '[protocol]\nkind = "windows"\nhorizon = 20')
    if request.param == "standardised":
        text += "[preprocess]\ndetrend = true\nscale = true\n"
    (problem / "problem.toml").write_text(text)
    agent = Scripted((LINEAR,))
    ready = prepare(load_problem(problem), agent.name, seed=0, runs=folder / "runs")
    search(ready, agent, lambda event, view: None, lambda view: None)
    return Searched(problem, open_run(ready.directory), folder)


def references_search_and_evidence(s: Searched) -> None:
    view = s.run.view
    assert all(isinstance(reference.outcome, Score) for reference in view.references)
    windows = view.references[2].name == "constant velocity"  # a reference where windows are scored
    assert len(view.references) == 3 + windows
    assert view.references[-1].name == LINEAR_REFERENCE
    assert all(e.score is not None for e in view.finished)
    assert view.best is not None
    assert view.best.number == 2
    assert view.failed_checks == ()
    assert view.refitted is not None
    assert view.refitted.check is not None


def check(s: Searched) -> None:
    problem = load_problem(s.problem)
    lines = check_problem(problem, seal(problem)).lines()
    assert any("missing outputs" in line for line in lines)
    failed: list[str] = []
    with unpainted():
        assert draw_problem(problem, s.folder / "check", failed)
    assert failed == []


def validation(s: Searched) -> None:
    found = validate(s.run.directory)
    assert len(found.checks) >= 12
    assert [c.sentence for c in found.checks if " failed: " in c.sentence] == []
    fit = next(c for c in found.checks if c.name == "fit in free run")
    assert fit.verdict is Verdict.PASS


def validation_on_a_record(s: Searched) -> None:
    found = validate(s.run.directory, s.problem / "test.csv")
    assert [c.sentence for c in found.checks if " failed: " in c.sentence] == []
    assert found.checks[-1].name == "output bands"


def confirmation(s: Searched) -> None:
    found, _ = confirm(s.run.directory, lambda event, done, total: None, top=1, seeds=1)
    first = found.candidates[0]
    assert first.experiment == 2
    assert first.value.low <= first.first <= first.value.high


def ablation(s: Searched) -> None:
    found, _ = ablate(s.run.directory, lambda event, done, total: None, seeds=1)
    assert found.best == 2


def bands(s: Searched) -> None:
    record = load_problem(s.problem).train[0]
    past_y = record.measured_y[39:42]
    assert np.isnan(past_y).any()
    made = asia.simulate(s.run.directory, record.u[39:42], past_y, record.u[42:90], bands=0.9)
    assert np.isfinite(made.y_hat).all()
    assert (made.upper > made.lower).all()


def report(s: Searched) -> None:
    failed: list[str] = []
    with unpainted():
        assert write_report(s.run.directory, failed=failed)
        assert write_figures(s.run.directory, s.folder / "figures")
    assert failed == []
    page = write_page(s.run.directory).read_text()
    assert not re.search(r"check [^<]* failed:", page)
    assert "nan" not in page.lower().replace("nanodrone", "").split("<style>")[0]


def view_pages(s: Searched) -> None:
    app = TokenOnly(make_app(RunFolder(s.run.directory.parent), Streams(), "t"), "t", 8731)
    with TestClient(app, base_url="http://127.0.0.1:8731") as client:
        client.get("/?token=t")
        name = s.run.directory.name
        for path in ("", "/sections/accuracy", "/experiments/2", "/experiments/2/overlays/0"):
            answer = client.get(f"/runs/{name}{path}")
            assert answer.status_code == 200
            assert "NaN" not in answer.text


def show(s: Searched) -> None:
    describe(wide_console(), s.run, s.run.view.experiment(2))
    with unpainted():
        pictures = draw_cases(simulated_excerpts(s.run, 2))
    assert sorted(pictures) == ["residuals", "simulation"]


def export_parity(s: Searched) -> None:
    (made,) = export(s.run.directory, ["numpy"], out=s.folder / "export")
    assert max(row.difference or 0.0 for row in made.parity) < 1e-9


def workspace_tools(s: Searched) -> None:
    problem = load_problem(s.problem)
    folder = s.folder / "work"
    write_folder(folder, problem, 1)
    (folder / "candidate.py").write_text(arx(1))
    tools = WorkspaceTools(folder, 0)
    assert np.array_equal(
        tools.problem.train[0].measured_y, problem.train[0].measured_y, equal_nan=True
    )
    found = tools.evaluate("candidate.py", tools.folds)
    baseline = s.run.view.experiment(1).score
    assert baseline is not None
    assert [one.value for one, _ in found] == pytest.approx(
        [f.value for f in baseline.folds], rel=1e-12
    )
    lines = "\n".join(tables(tools.problem, tools.folds, found, complete=True, held_out=True))
    assert "nan" not in lines
    with unpainted():
        assert draw(folder, tools.problem, "a candidate", tools.folds, found, held_out=True)


def agents(s: Searched) -> None:
    facts = problem_facts(load_problem(s.problem))
    assert "nan" not in problem_text(facts).lower().replace("nanodrone", "")
    proposal = ExpertAgent().propose(agent_view(facts, s.run.view, s.run.store))
    assert proposal is not None
    assert dry_run(s.run, arx(2)).failure is None


CONSUMERS = (
    references_search_and_evidence, check, validation, validation_on_a_record, confirmation,
    ablation, bands, report, view_pages, show, export_parity, workspace_tools, agents,
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("consumer", CONSUMERS, ids=lambda consumer: consumer.__name__)
def test_a_consumer_of_outputs(consumer: Callable[[Searched], None], searched: Searched) -> None:
    consumer(searched)


@pytest.mark.slow
def test_the_test_is_opened(searched: Searched) -> None:
    copy = searched.folder / "opened" / searched.run.directory.name
    shutil.copytree(searched.run.directory, copy)
    opened = asia.unseal(copy).record
    assert opened.failed_checks == ()
    assert opened.bands is not None
    assert 0.0 < opened.bands.covered[0] <= 1.0
    check = ScoreCheck(copy)
    verify(copy, check=check)
    assert (check.experiments > 0, check.tested > 0, check.test_not_compared) == (True, True, "")
    assert not re.search(r"check [^<]* failed:", write_page(copy).read_text())


@pytest.mark.long
def test_the_estimator(tmp_path: Path) -> None:
    problem = write_problem(tmp_path / "toy")
    with_gaps(problem / "train.csv")
    record = load_problem(problem).train[0]
    model = SystemIdentifier(
        experiments=1, runs=tmp_path / "runs", progress=False, budget={"retests": 0},
        protocol={"past_inputs": 3, "past_outputs": 3},
    )  # fmt: skip
    model.fit(record.u, record.measured_y, sampling_time=0.5)
    assert model.score(record.u, record.measured_y) > 80.0
    ahead = model.predict(record.u, record.measured_y, horizon=2)
    assert np.isfinite(ahead[4:]).all()
    assert all(path.stat().st_size for path in model.report())
