"""asia validate on a small search."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from asia.analysis.validation import VALIDATION_CHECKS
from asia.judge.sandbox.types import Isolation
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.problem.load import load_problem
from asia.report.page.page import write_page
from asia.search.run import prepare, search
from tests.unit.search.toy import Scripted, arx, write_problem

from .conftest import Asia


def searched(root: Path, *sources: str) -> Path:
    agent = Scripted(sources)
    problem = load_problem(write_problem(root / "toy", experiments=1 + len(sources)))
    ready = prepare(problem, agent.name, seed=0, runs=root / "runs", isolation=Isolation.PROCESS)
    search(ready, agent, lambda event, view: None, lambda view: None)
    return ready.directory


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return searched(tmp_path_factory.mktemp("validate"), arx(2))


def new_record(path: Path, gain: float) -> Path:
    rng = np.random.default_rng(9)
    u = rng.normal(size=300)
    y = np.zeros(300)
    for k in range(2, 300):
        y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + gain * (0.4 * u[k] + 0.2 * u[k - 1])
    np.savetxt(path, np.stack([u, y], 1), delimiter=",", header="u,y", comments="")
    return path


@pytest.mark.slow
def test_a_line_a_check_and_a_summary_at_the_end(run: Path, asia: Asia) -> None:
    done = asia("validate", run)
    assert done.code == 0, done.err
    *lines, model, summary = done.out.splitlines()
    assert "fold models of experiment 2 on the held-out parts of the training records" in model
    assert model.endswith("the sealed test was not used")
    assert summary.startswith("pass ")
    assert summary.endswith("fail 0")
    names = [line.split(":")[0].partition(" ")[2].strip() for line in lines]
    # "residuals" has six results, each with a name of its own.
    residuals = ["fit in free run", "inputs", "whiteness", "time", "amplitude", "motion"]
    others = [name for name in VALIDATION_CHECKS if name != "residuals"]
    comparisons = ["held-out error", "steps ahead", "region of validity"]
    assert names == [*residuals, *others, *comparisons]
    assert (run / "report" / "validation.png").is_file()
    event = open_run(run).view.validated[0]
    assert [one.name for one in event.checks] == names
    assert f"checks  {summary}" in asia("status", run).out
    assert verify(run).records == len(open_run(run).lines)


@pytest.mark.slow
def test_the_ledger_has_a_validation_once_and_the_report_shows_it(run: Path, asia: Asia) -> None:
    asia("validate", run)
    before = len(open_run(run).lines)
    asia("validate", run)
    assert len(open_run(run).lines) == before
    page = write_page(run).read_text("utf-8")
    assert 'id="validation"' in page
    assert page.count('class="curves panel"') >= 9


@pytest.mark.slow
def test_a_search_that_is_not_finished_keeps_no_validation_report(
    run: Path, tmp_path: Path, asia: Asia
) -> None:
    part = shutil.copytree(run, tmp_path / "part")
    lines = (run / "ledger.jsonl").read_bytes().splitlines(keepends=True)
    end = next(k for k, line in enumerate(lines) if b'"event":"stopped"' in line)
    (part / "ledger.jsonl").write_bytes(b"".join(lines[:end]))
    done = asia("validate", part, "--json")
    assert done.code == 0, done.err
    assert json.loads(done.out.splitlines()[-1])["recorded"] is False
    assert len(open_run(part).lines) == end


@pytest.mark.slow
def test_a_new_record_that_the_model_gets_wrong(run: Path, tmp_path: Path, asia: Asia) -> None:
    good = asia("validate", run, "--record", new_record(tmp_path / "good.csv", 1.0))
    assert good.out.splitlines()[-1].endswith("fail 0")
    assert "PASS  output bands: 90 % output bands contained: y " in good.out
    done = asia("validate", run, "--record", new_record(tmp_path / "bad.csv", -1.0), "--json")
    *checks, end = (json.loads(line) for line in done.out.splitlines())
    verdicts = {check["check"]: check["verdict"] for check in checks}
    assert verdicts["direction of gain"] == "fail"
    assert verdicts["output bands"] in {"doubt", "fail"}
    assert end["record"] == "bad.csv"
    assert end["summary"].endswith("a gain has the wrong sign")
    bare = tmp_path / "bare.csv"
    header, *rows = (tmp_path / "good.csv").read_text().splitlines()
    bare.write_text("\n".join(rows) + "\n")
    named = asia("validate", run, "--record", bare, "--columns", header)
    assert named.out == good.out.replace("good.csv", "bare.csv")


def test_a_record_without_the_columns_is_refused(run: Path, tmp_path: Path, asia: Asia) -> None:
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    done = asia("validate", run, "--record", tmp_path / "other.csv")
    assert done.code == 2
    assert "has no column" in done.err
