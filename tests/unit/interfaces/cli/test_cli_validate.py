"""asia validate on a small search."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from asia.analysis.validation import VALIDATION_CHECKS
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.report.page.page import write_page

from .conftest import Asia


def new_record(path: Path, gain: float) -> Path:
    rng = np.random.default_rng(9)
    u = rng.normal(size=300)
    y = np.zeros(300)
    for k in range(2, 300):
        y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + gain * (0.4 * u[k] + 0.2 * u[k - 1])
    np.savetxt(path, np.stack([u, y], 1), delimiter=",", header="u,y", comments="")
    return path


@pytest.mark.slow
def test_a_line_a_check_a_record_in_the_ledger_and_a_section_of_the_report(
    finished: Path, asia: Asia
) -> None:
    done = asia("validate", finished)
    assert done.code == 0, done.err
    printed = done.out.splitlines()
    end = next(k for k, line in enumerate(printed) if line.startswith("pass "))
    *lines, model, summary = printed[: end + 1]
    assert printed[end + 1].startswith("verdict ")
    assert "fold models of experiment 2 on the held-out parts of the training records" in model
    assert model.endswith("the sealed test was not used")
    assert summary.startswith("pass ")
    assert summary.endswith("fail 0")
    names = [line.split(":")[0].partition(" ")[2].strip() for line in lines]
    # "residuals" has six results, each with a name of its own.
    residuals = ["fit in free run", "inputs", "whiteness", "time", "amplitude", "motion"]
    others = [name for name in VALIDATION_CHECKS if name != "residuals"]
    comparisons = ["held-out error", "steps ahead", "region of validity"]
    assert names == [*residuals, *others, *comparisons, "output bands"]
    assert (finished / "report" / "validation.png").is_file()
    event = open_run(finished).view.validated[0]
    assert [one.name for one in event.checks] == names
    assert f"checks   {summary}" in asia("status", finished).out
    before = len(open_run(finished).lines)
    assert verify(finished).records == before
    # The same validation is recorded once.
    asia("validate", finished)
    assert len(open_run(finished).lines) == before
    page = write_page(finished).read_text("utf-8")
    assert 'id="validation"' in page
    assert page.split('id="validation"')[1].split("</section>")[0].count("<figure>") >= 9


@pytest.mark.long
def test_a_search_that_is_not_finished_keeps_no_validation_report(
    finished: Path, asia: Asia
) -> None:
    lines = (finished / "ledger.jsonl").read_bytes().splitlines(keepends=True)
    end = next(k for k, line in enumerate(lines) if b'"event":"stopped"' in line)
    (finished / "ledger.jsonl").write_bytes(b"".join(lines[:end]))
    done = asia("validate", finished, "--json")
    assert done.code == 0, done.err
    assert json.loads(done.out.splitlines()[-1])["recorded"] is False
    assert len(open_run(finished).lines) == end


@pytest.mark.slow
def test_a_new_record_that_the_model_gets_wrong(finished: Path, tmp_path: Path, asia: Asia) -> None:
    good = asia("validate", finished, "--record", new_record(tmp_path / "good.csv", 1.0))
    (summary,) = (line for line in good.out.splitlines() if line.startswith("pass "))
    assert summary.endswith("fail 0 on good.csv")
    assert "PASS  output bands: 90 % output bands contained: y " in good.out
    done = asia("validate", finished, "--record", new_record(tmp_path / "bad.csv", -1.0), "--json")
    *checks, end = (json.loads(line) for line in done.out.splitlines())
    verdicts = {check["check"]: check["verdict"] for check in checks}
    assert verdicts["direction of gain"] == "fail"
    assert verdicts["output bands"] in {"doubt", "fail"}
    assert end["record"] == "bad.csv"
    assert end["summary"].endswith("a gain has the wrong sign")
    bare = tmp_path / "bare.csv"
    header, *rows = (tmp_path / "good.csv").read_text().splitlines()
    bare.write_text("\n".join(rows) + "\n")
    named = asia("validate", finished, "--record", bare, "--columns", header)
    # The verdict behind them knows the bad record too.
    expected = good.out.replace("good.csv", "bare.csv").replace("'good'", "'bare'")
    assert named.out.partition("\nverdict ")[0] == expected.partition("\nverdict ")[0]


def test_a_record_without_the_columns_is_refused(
    finished: Path, tmp_path: Path, asia: Asia
) -> None:
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    done = asia("validate", finished, "--record", tmp_path / "other.csv")
    assert done.code == 2
    assert "has no column" in done.err
