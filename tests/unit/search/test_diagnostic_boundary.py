"""A diagnostic that raises leaves a line and ends no search; a score that raises is not caught."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest

from asia.analysis.validation import VALIDATION_CHECKS, validate
from asia.errors import CandidateError, InternalError, Reason, UserError
from asia.interfaces.cli import main
from asia.judge.evaluation import fold_fits
from asia.judge.scoring.checks.check import Verdict
from asia.ledger.run import error_of, open_run
from asia.report import files
from asia.report.files import write_report
from asia.report.page.page import write_page
from asia.report.page.sections import experiments
from asia.search import final, loop

from .toy import arx, search_toy

VALIDATION = import_module("asia.analysis.validation")
IN_A_FOLD = {
    "residual analysis": "diagnose",
    "signed residuals": "signed_residuals",
    "held-out residuals": "_held_out_residuals",
    "errors by step": "_step_errors",
    "training checks": "training_checks",
}
AT_THE_END = {
    "stack": "make_stack",
    "comparison of the refit": "check_refit",
    "parameter intervals": "_kept_estimates",
}
IN_A_VALIDATION = {
    "small steps": "linear_responses",
    "held-out error": "check_overfit",
    "steps ahead": "check_steps_ahead",
    "region of validity": "check_region",
    "output bands": "check_bands",
}


def fail(*arguments: object, **options: object) -> None:
    raise ValueError("array must not contain infs or NaNs")


def line(name: str) -> str:
    return f"check {name} failed: ValueError: array must not contain infs or NaNs"


# Fails, and does not diverge, where more samples are asked than a record holds.
HEAD = "def simulate(self, past_u, past_y, u):\n"
SHORT = f"{HEAD}        if u.shape[1] > 1000:\n            raise RuntimeError('too long')\n"


def asia(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr("sys.argv", ["asia", *words])
    with pytest.raises(SystemExit) as raised:
        main()
    return int(raised.value.code or 0)


@pytest.mark.slow
def test_every_step_fails_and_the_search_ends_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for module, names in ((fold_fits, IN_A_FOLD), (final, AT_THE_END)):
        for function in names.values():
            monkeypatch.setattr(module, function, fail)
    monkeypatch.setattr(loop, "write_exports", fail)
    run = open_run(search_toy(tmp_path, arx(2)))
    view = run.view
    assert view.complete
    assert view.best is not None
    assert view.best.number == 2
    assert error_of(run.directory) is None
    reference = next(reference for reference in view.references if reference.name == "linear model")
    assert reference.failed_checks[: len(IN_A_FOLD)] == tuple(map(line, IN_A_FOLD))
    first, second = (e.result for e in view.finished)
    assert first is not None
    assert second is not None
    assert first.failed_checks == tuple(map(line, IN_A_FOLD))
    exports = line("results.tsv and search_journal.md")
    assert second.failed_checks == (*map(line, IN_A_FOLD), exports)
    assert view.refitted is not None
    assert set(view.refitted.failed_checks) == {*map(line, AT_THE_END), exports}
    assert view.refitted.use == "ensemble"
    assert view.refitted.model is None
    runs = ["--runs", str(run.directory.parent)]
    for words, shown in ((["status"], f"#02: {exports}"), (["show", "1"], line("stack")[:6])):
        assert asia(monkeypatch, *words, *runs) == 0
        assert shown in capsys.readouterr().out

    for function in IN_A_VALIDATION.values():
        monkeypatch.setattr(VALIDATION, function, fail)
    for name in VALIDATION_CHECKS:
        monkeypatch.setitem(VALIDATION_CHECKS, name, fail)
    found = {c.name: c.sentence for c in validate(run.directory).checks}
    assert found == {name: line(name) for name in (*IN_A_VALIDATION, *VALIDATION_CHECKS)}

    monkeypatch.setattr(files, "draw_residuals", fail)
    failed: list[str] = []
    paths = write_report(run.directory, failed=failed)
    assert failed == [line("picture residuals")]
    assert all(path.stat().st_size for path in paths)
    page = write_page(run.directory).read_text()
    assert "failed diagnostic" in page
    assert "refit: check stack failed: ValueError" in page


def test_a_failing_section_shows_its_line(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(experiments, "progress_figure", fail)
    assert "check section" in write_page(finished).read_text()


@pytest.mark.slow
def test_a_score_that_raises_ends_the_search_and_status_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for error in (RuntimeError("the metric is broken"), InternalError("a bug")):

        def broken(*arguments: object, error: Exception = error, **options: object) -> None:
            raise error

        with monkeypatch.context() as patch:
            patch.setattr(fold_fits, "score_fold", broken)
            with pytest.raises(type(error), match=str(error)):
                search_toy(tmp_path, arx(2))
        assert asia(monkeypatch, "status", "--runs", str(tmp_path / "runs")) == 0
        shown = capsys.readouterr().out
        assert "interrupted: 0 of 2 experiments" in shown
        name = "" if isinstance(error, InternalError) else "RuntimeError: "
        assert f"error    {name}{error}" in shown
    run = open_run(search_toy(tmp_path, arx(2)))
    assert run.view.complete
    assert error_of(run.directory) is None


def test_errors_raised_on_purpose_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    from asia._diagnostic import diagnostic

    failed: list[str] = []
    for error in (CandidateError(Reason.NOT_FINITE), InternalError("a bug")):
        with pytest.raises(type(error)), diagnostic("anything", failed):
            raise error
    with pytest.raises(KeyboardInterrupt), diagnostic("anything", failed):
        raise KeyboardInterrupt
    assert failed == []


@pytest.mark.long
def test_a_model_that_fails_in_a_check_is_not_called_unstable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = search_toy(tmp_path, arx(2).replace(HEAD, SHORT))
    checks = {c.name: c for c in validate(directory).checks}
    assert checks["ten horizons"].verdict is Verdict.ABSENT
    assert checks["ten horizons"].sentence.startswith(
        "check ten horizons failed: the candidate raised an exception"
    )
    assert checks["fit in free run"].verdict is not Verdict.ABSENT

    monkeypatch.setattr("asia.search.simulation.library_digest", lambda: "another")
    with pytest.raises(UserError, match="stored by another version of ASIA"):
        validate(directory)
