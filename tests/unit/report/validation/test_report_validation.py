"""Validation on the page: its verdicts, its pictures, and nothing that its record does not say."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from asia.judge.scoring.checks.check import Check, CheckCurve, Verdict
from asia.ledger.chain import Chain
from asia.ledger.events import RecordedCheck, Validated
from asia.ledger.evidence import put_curves
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.problem.load import load_problem
from asia.problem.lock import lock_text
from asia.problem.problem import Seal
from asia.report.page.page import page_of
from asia.report.page.sections.verdict import sealed_sentence
from tests.unit.report.made_up import write_run

ATTACK = "<script>alert(1)</script>"
SENTENCE = "the residual of level follows valve at lags 3 to 8 (41 % of its variance)"


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    problem = load_problem("two_tanks_sim")
    (tmp_path / "made").mkdir()
    lock = lock_text(problem, Seal(None, None))
    (tmp_path / "made" / "problem.lock.toml").write_text(lock, "utf-8")
    return write_run(tmp_path / "made", problem, (("first", 0.9), ("last", 0.2)))


def validated(directory: Path, record: str = "", digest: str = "") -> Validated:
    """As `asia validate` would have appended it, with four checks."""
    steps = np.arange(1.0, 2001.0)
    checks = (
        Check("inputs", Verdict.FAIL, SENTENCE, weight=0.41, axes=("lag [samples]", ATTACK),
              curves=(CheckCurve("level with valve", steps, np.sin(steps), 0.06),)),
        Check("error spectrum", Verdict.SHOWN, "level: residual 2.3 % of the output",
              axes=("frequency [Hz]", "amplitude"),
              curves=tuple(CheckCurve(f"curve {k}", steps - 1, 1 / steps) for k in range(7))),
        Check("steps ahead", Verdict.ABSENT, "does not apply: there is no room"),
        Check("time", Verdict.PASS, "no residual drifts with time"),
    )  # fmt: skip
    with Chain(directory / "ledger.jsonl") as chain:
        curves = put_curves(open_run(directory).store, checks)
        recorded = tuple(RecordedCheck(c.name, c.verdict, c.sentence) for c in checks)
        event = Validated(2, "ensemble", record, digest, recorded, curves, 1, 0, 1, "inputs")
        chain.append(event)
    return event


def test_a_validation_report_has_its_section_and_its_pictures(directory: Path) -> None:
    assert 'id="validation"' not in page_of(open_run(directory))
    validated(directory)
    validated(directory, ATTACK, "d")
    page = page_of(open_run(directory))
    assert page.count(SENTENCE) == 2 * 2  # first and in the table
    assert 'class="stamp small none">fail<' in page
    assert 'class="stamp small shown">none<' in page
    assert "<script" not in page
    assert "&lt;script&gt;" in page
    assert re.search(r"[Tt]he check \S{1,6}inputs\S{1,6} fails", page)
    assert "Further curves are in report/validation.pdf" in page
    assert page == page_of(open_run(directory))
    assert verify(directory).records


@pytest.mark.parametrize(
    ("record", "expected"),
    [("", "no figure here is from unseen"), ("new.csv", "Only the validation on new records")],
)
def test_a_validation_on_a_new_record_counts_as_unseen(record: str, expected: str) -> None:
    event = Validated(1, "refit", record, record, (), "", 1, 0, 0)
    view = SimpleNamespace(started=SimpleNamespace(test_digest=None), validated=(event,))
    assert expected in sealed_sentence(view)  # type: ignore[arg-type]


def test_a_newer_validation_takes_the_place_of_the_older_one_of_its_record(
    directory: Path,
) -> None:
    first = validated(directory, "new.csv", "d")
    validated(directory)
    with Chain(directory / "ledger.jsonl") as chain:
        chain.append(replace(first, record="again.csv"))
        assert [one.record for one in chain.view.validated] == ["", "again.csv"]


def test_a_long_curve_keeps_its_extremes(directory: Path) -> None:
    from asia.ledger.evidence import get_curves

    event = validated(directory)
    inputs, spectrum = get_curves(open_run(directory).store, event.curves)
    curve = inputs.curves[0]
    assert len(curve.x) <= 240
    assert max(curve.y) == pytest.approx(np.sin(np.arange(1.0, 2001.0)).max(), abs=1e-4)
    assert (len(spectrum.curves), spectrum.left_out) == (5, 2)
