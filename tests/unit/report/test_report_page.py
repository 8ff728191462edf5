"""The page of a run: what stands on it, and what never does."""

from __future__ import annotations

import hashlib
import itertools
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asia.candidate import ParameterEstimate, ParameterEstimates
from asia.control.report import CERTIFICATE_FILE
from asia.judge.scoring.checks.check import Verdict
from asia.judge.scoring.repeated_fits import Attribution, ExpectedError, Interval
from asia.ledger.chain import Chain
from asia.ledger.events import (
    Ablated,
    Confirmed,
    ConfirmedCandidate,
    ConfirmedPair,
    LeftOut,
    RecordedCheck,
    Refitted,
    Validated,
)
from asia.ledger.events import (
    TestBands as Bands,
)
from asia.ledger.evidence import identified, put_curves, put_estimates
from asia.ledger.run import Run, open_run
from asia.problem.load import load_problem
from asia.problem.lock import lock_text
from asia.problem.problem import DESCRIPTION_TEMPLATE, Seal, is_described
from asia.report.page.code import python
from asia.report.page.page import LIMIT, page_of, write_page
from asia.report.page.sections.evidence import LINEAR_FILE
from asia.report.pictures.evidence import draw_ablation

from .made_up import Outcomes, write_run

GOLDEN = Path(__file__).parents[2] / "golden" / "0.1.0"
ATTACK = "<script>alert(1)</script><img src=x onerror=alert(2)>"
OUTCOMES: Outcomes = (("first", 0.9), (ATTACK, 0.5), ("failing", None), ("last", 0.2))


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., Run]:
    """A run of the two-tank problem, whose data need no file."""

    def make(outcomes: Outcomes = OUTCOMES, **options: Any) -> Run:
        problem = load_problem("two_tanks_sim")
        directory = tmp_path / "made"
        directory.mkdir()
        seal = Seal(None, None)
        (directory / "problem.lock.toml").write_text(lock_text(problem, seal), "utf-8")
        return open_run(write_run(directory, problem, outcomes, **options))

    return make


def test_the_same_ledger_gives_the_same_bytes(make_run: Callable[..., Run]) -> None:
    directory = make_run().directory
    first = write_page(directory).read_bytes()
    other = shutil.copytree(directory, directory.with_name("elsewhere"))
    assert write_page(directory).read_bytes() == first
    assert write_page(other).read_bytes() == first


def test_words_of_candidates_are_shown_as_text(make_run: Callable[..., Run]) -> None:
    page = page_of(make_run())
    assert "&lt;script&gt;alert" in page
    assert "<script" not in page
    assert "<img" not in page


def test_nothing_is_loaded_from_elsewhere(make_run: Callable[..., Run]) -> None:
    page = page_of(make_run(unsealed=1))
    assert "default-src 'none'" in page
    assert not re.findall(r"""(?:src|href)=["'](?!#)|url\((?!#)|@import|https?:""", page)


def test_every_part_of_an_opened_run_is_there(make_run: Callable[..., Run]) -> None:
    page = page_of(make_run(unsealed=2))
    for key in ("verdict", "model", "accuracy", "test", "use", "progress", "experiments"):
        assert f'<section id="{key}"' in page
    assert "On the sealed test, which this run opened" in page


def test_no_figure_of_the_test_stands_on_a_page_of_a_sealed_run(
    make_run: Callable[..., Run],
) -> None:
    page = page_of(make_run())
    assert "never opened" in page
    assert 'id="test"' not in page
    assert "unsealed:" not in page


def test_every_experiment_has_its_hypothesis_and_its_change(make_run: Callable[..., Run]) -> None:
    page = page_of(make_run())
    for number in range(1, len(OUTCOMES) + 1):
        assert f'id="e{number}"' in page
    # The section of the model repeats that of the best candidate.
    assert page.count("<dt>hypothesis</dt><dd>because<") == len(OUTCOMES) + 1
    assert "-60.0 %" in page  # 0.2 against 0.5, the previous best


def test_ids_are_unique_and_links_lead_somewhere(make_run: Callable[..., Run]) -> None:
    page = page_of(make_run(unsealed=1))
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'href="#([^"]+)"', page)) <= set(ids)


def test_headings_descend_and_pictures_have_words(make_run: Callable[..., Run]) -> None:
    page = page_of(make_run(unsealed=1))
    levels = [int(level) for level in re.findall(r"<h([1-6])", page)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(b - a <= 1 for a, b in itertools.pairwise(levels))
    for svg in re.findall(r"<svg[^>]*>", page):
        assert "aria-hidden" in svg or "aria-label" in svg


def test_an_event_on_several_lines_of_the_ledger_has_a_page(make_run: Callable[..., Run]) -> None:
    run = make_run()
    with Chain(run.directory / "ledger.jsonl") as chain:
        chain.append(Refitted(4, None, "made up " * 20_000))
    raw = (run.directory / "ledger.jsonl").read_bytes()
    run = open_run(run.directory)
    assert raw.count(b"\n") > len(run.lines)
    digest = hashlib.sha256(raw.splitlines()[-1]).hexdigest()
    assert f"<code>{digest}</code>" in page_of(run)


@pytest.mark.long
def test_a_long_search_stays_below_the_limit(make_run: Callable[..., Run]) -> None:
    values = [(f"candidate {k}: {'word ' * 12}", 0.9 - 1e-4 * (k % 97)) for k in range(1200)]
    run = make_run(tuple(values))
    page = page_of(run)
    best = run.view.best
    assert best is not None
    assert len(page.encode()) <= LIMIT
    assert f'id="e{best.number}"' in page


@pytest.mark.parametrize("name", ["finished", "unsealed", "interrupted", "steered"])
def test_old_ledgers_without_artifacts_have_a_page(tmp_path: Path, name: str) -> None:
    place = shutil.copytree(
        GOLDEN / "runs" / name, tmp_path / name, ignore=shutil.ignore_patterns("artifacts")
    )
    page = write_page(place).read_text("utf-8")
    assert '<section id="verdict"' in page
    assert ('id="test"' in page) == (name == "unsealed")


def test_a_search_without_a_score_says_so(make_run: Callable[..., Run]) -> None:
    page = page_of(make_run((("one", None), ("two", None))))
    assert "No model" in page
    assert "None of the candidates has a score" in page


def test_the_bands_of_the_test_stand_beside_what_they_are_meant_to_hold(
    make_run: Callable[..., Run],
) -> None:
    run = make_run(unsealed=1)
    assert "output bands on the sealed test" not in page_of(run).lower()
    opened = run.view.unsealed
    assert opened is not None
    bands = Bands("ensemble", 0.9, (0.873,), 0.02, opened.measured, opened.measured)
    other = run.directory.with_name("banded")
    shutil.copytree(run.directory, other)
    (other / "ledger.jsonl").unlink()
    with Chain(other / "ledger.jsonl") as chain:
        for line in run.lines[:-1]:
            chain.append(line.event)
        chain.append(replace(opened, bands=bands))
    page = page_of(open_run(other))
    assert "87.3 %" in page
    assert "share inside the 90 % bands of the ensemble" in page
    assert 'class="band"' not in page_of(run)
    drawn = page[page.index('id="test"') :].split("</section>")[0]
    assert drawn.count('class="band"') == 2 * drawn.count('class="simulated"') > 0
    assert "band of 90 %, holds 87 %" in drawn


def test_what_was_identified_stands_on_the_page_with_its_uncertainty(
    make_run: Callable[..., Run],
) -> None:
    run = make_run()
    assert 'id="identified"' not in page_of(run)
    rows = (
        ParameterEstimate("k1", 0.25, 0.012, 0.2264, 0.2736, "1/s", 0.001, 1.0),
        ParameterEstimate(ATTACK, 1.0, 0.3, 0.4, 1.6, "", 0.001, 1.0),
    )
    correlation = np.array([[1.0, -0.987], [-0.987, 1.0]])
    found = ParameterEstimates(rows, correlation, ("d(x)/dt = -0.25 * sqrt(x) <b>",))
    name = put_estimates(run.store, found)
    with Chain(run.directory / "ledger.jsonl") as chain:
        chain.append(Refitted(4, None, "made up", estimates=name))
    page = page_of(open_run(run.directory))
    part = page[page.index('id="identified"') :]
    for words in ("-0.25 * sqrt(x) &lt;b&gt;", "0.2264", "0.2736", "1/s", "-0.987", "upper end"):
        assert words in part
    assert "in the candidate&#39;s own words" in part
    name = put_estimates(run.store, found, library=True)
    with Chain(run.directory / "ledger.jsonl") as chain:
        chain.append(Refitted(4, None, "made up", estimates=name))
    part = page_of(open_run(run.directory))
    assert "Equations of the best candidate with the fitted numbers" in part
    assert "own words" not in part
    assert "<script>alert" not in page


def test_an_interval_by_folds_or_by_a_missing_effect_is_on_the_page(
    make_run: Callable[..., Run],
) -> None:
    run = make_run(parameters=[(("b", 2.0), ("R", value)) for value in (0.8, 1.3)])
    rows = (
        ParameterEstimate("R", 1.0, 0.01, 0.98, 1.02, "Ohm", 0.1, 10.0),
        ParameterEstimate("b", 2.0, 0.01, 1.98, 2.02, "", -9.0, 9.0, misfit_error=0.5),
    )
    name = put_estimates(run.store, ParameterEstimates(rows, np.eye(2)))
    with Chain(run.directory / "ledger.jsonl") as chain:
        chain.append(Refitted(4, None, "made up", estimates=name))
    run = open_run(run.directory)
    page = page_of(run)
    part = page[page.index('id="identified"') :]
    quoted = identified(run)
    assert quoted is not None
    low, high = quoted.parameters[0].interval or (0.0, 0.0)
    assert low < 0.8
    for words in (f"{low:.4g}", f"{high:.4g}", ">folds<", ">missing effect<", "1.5", "2.5"):
        assert words in part
    assert "Significantly different between the folds: R;" in part
    assert "Parameters significantly different between the folds: R; " in page
    assert 'class="stamp shown">Not validated<' in page


@pytest.mark.parametrize(
    ("verdict", "weight", "stamp", "kind"),
    [
        (Verdict.PASS, 0.0, "Usable", "good"),
        (Verdict.DOUBT, 0.4, "Usable", "good"),  # a hint for the next model
        (Verdict.FAIL, 0.6, "Doubtful", "doubt"),  # a residual check: a limit
        (Verdict.FAIL, 1.5, "Not usable", "none"),
    ],
)
def test_the_verdict_has_the_doubts_of_the_validation(
    make_run: Callable[..., Run], verdict: Verdict, weight: float, stamp: str, kind: str
) -> None:
    run = make_run()
    assert 'class="stamp shown">Not validated<' in page_of(run)
    check = RecordedCheck("motion", verdict, "a sentence", "friction is missing", weight)
    curves = put_curves(run.store, ())
    event = Validated(4, "ensemble", "", "", (check,), curves, 1, 0, 0)
    with Chain(run.directory / "ledger.jsonl") as chain:
        chain.append(event)
    page = page_of(open_run(run.directory))
    assert f'class="stamp {kind}">{stamp}<' in page
    assert ("friction is missing" in page[: page.index("<dl")]) is (verdict is Verdict.FAIL)


def test_a_confirmation_has_its_section(make_run: Callable[..., Run]) -> None:
    directory = make_run().directory
    assert 'id="confirmation"' not in page_of(open_run(directory))
    interval = ConfirmedPair(4, 2, Interval(0.3, -0.1, 0.7))
    found = Confirmed(
        best=4,
        seeds=5,
        tried=3,
        level=0.95,
        candidates=(
            ConfirmedCandidate(4, 0.2, Interval(0.25, 0.2, 0.3), 0.01, 4, 1, False, 1, 2),
            ConfirmedCandidate(2, 0.5, Interval(0.5, 0.4, 0.6), 0.0, 1, 0, True, 1, 2),
        ),
        pairs=(interval, replace(interval, difference=Interval(0.3, 0.1, 0.7))),
        noise=0.01,
        expected=ExpectedError(0.27, 0.2, 0.4, 0.02),
        after_unsealing=True,
    )
    with Chain(directory / "ledger.jsonl") as chain:
        chain.append(found)
    page = page_of(open_run(directory))
    assert 'id="confirmation"' in page
    assert "statistically equal" in page
    assert "is better" in page
    assert "fits do not depend on the seed" in page
    assert "Computed after the sealed test was opened" in page
    with Chain(directory / "ledger.jsonl") as chain:
        chain.append(replace(found, candidates=(), pairs=(), noise=None, expected=None))
    assert "it failed with every other seed" in page_of(open_run(directory))


def test_linear_models_have_their_section_and_a_foreign_file_does_no_harm(
    make_run: Callable[..., Run],
) -> None:
    directory = make_run().directory
    assert 'id="linear"' not in page_of(open_run(directory))
    file = directory / LINEAR_FILE
    file.parent.mkdir()
    curve = {"name": ATTACK, "x": [0.1, 1.0], "y": [2.0, 0.5]}
    drawn = [{"name": "frequency response", "axes": ["frequency [Hz]", "gain"], "curves": [curve]}]
    file.write_text(json.dumps({"text": ["order     2", ATTACK], "drawn": drawn}))
    page = page_of(open_run(directory))
    section = page[page.index('id="linear"') :].split("</section>")[0]
    assert "order     2" in section
    assert "&lt;script&gt;" in section
    assert "<script" not in page
    assert 'class="curve"' in section
    for content in ("[]", "{", '{"text": 3, "drawn": []}', " " * 5_000_000):
        file.write_text(content)
        assert "is no file of this version: run asia linear again" in page_of(open_run(directory))


def test_a_certificate_has_its_section_with_its_assumptions(make_run: Callable[..., Run]) -> None:
    directory = make_run().directory
    assert 'id="certificate"' not in page_of(open_run(directory))
    file = directory / CERTIFICATE_FILE
    stated = {"statements": [{"text": ATTACK}], "missed": ["no box"], "assumptions": ["a start"]}
    file.write_text(json.dumps(stated))
    page = page_of(open_run(directory))
    section = page[page.index('id="certificate"') :].split("</section>")[0]
    assert all(text in section for text in ("&lt;script&gt;", "no box", "a start"))
    file.write_text('{"statements": []}')
    assert "run asia certify again" in page_of(open_run(directory))


def test_an_ablation_has_its_section_and_its_picture(make_run: Callable[..., Run]) -> None:
    directory = make_run().directory
    assert 'id="ablation"' not in page_of(open_run(directory))
    parts = (
        Interval(0.3, 0.2, 0.4),
        Interval(0.21, 0.1, 0.3),
        Interval(0.06, 0, 0),
        Interval(0.03, 0, 0),
    )
    left_out = LeftOut(2, Interval(0.123, 0.1, 0.15)), LeftOut(4, detail="7 of 8")
    found = Ablated(4, 1, 3, Attribution(*parts), "", left_out)
    with Chain(directory / "ledger.jsonl") as chain:
        chain.append(found)
    page = page_of(open_run(directory))
    assert 'id="ablation"' in page
    assert "0.21" in page
    assert "0.123" in page
    figure = draw_ablation(found, "run", "V")
    assert [t.get_text() for t in figure.axes[0].get_yticklabels()][-1] == "the change of #02"
    with Chain(directory / "ledger.jsonl") as chain:
        chain.append(
            replace(found, crossing=None, detail="fit of #1 contains further code", left_out=())
        )
    assert "cannot be crossed" in page_of(open_run(directory))


def test_a_source_is_coloured_and_escaped() -> None:
    shown = str(python('if a < 1:  # <b>\n    b = "<i>"\n', "source"))
    for part in ('<span class="k">if</span>', '<span class="m">1</span>', "a &lt; "):
        assert part in shown
    assert '<span class="c"># &lt;b&gt;</span>' in shown
    assert "<i>" not in shown
    assert "not python (" in str(python("not python (", "source")).replace("</span>", "").replace(
        '<span class="k">', ""
    )


def test_trade_offs_leave_out_costs_that_the_ledger_does_not_have(
    make_run: Callable[..., Run],
) -> None:
    page = page_of(make_run())
    assert re.findall(r'name="axis" id="(axis\d)"( checked)?', page) == [("axis2", " checked")]
    table = page.split("Candidates that no other one beats in V and in a cost")[2]
    assert re.findall(r'href="#e(\d+)"', table.split("</table>")[0]) == ["4"]


def test_the_description_of_the_problem_is_on_the_page(make_run: Callable[..., Run]) -> None:
    run = make_run()
    assert 'id="problem"' in page_of(run)
    page = page_of(run)
    assert "<h3>Two tanks in series, simulated</h3>" in page
    assert "A pump fills an upper tank; its water runs through an opening" in page
    assert "<li>The two tanks and their openings are of about" in page
    assert not is_described(DESCRIPTION_TEMPLATE.format(name="mill"))
    assert not is_described(" ")
    assert is_described("A pump fills a tank.")
