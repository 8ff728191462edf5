from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from asia.judge.scoring.outcome import TestScore as Scored
from asia.ledger.events import TestedModel as Recorded
from asia.ledger.events import Unsealed
from asia.problem import protocol
from asia.problem.problem import Problem
from asia.report.published import (
    Entry,
    OfficialFigure,
    leaderboard,
    official_figures,
    ordinal,
    standings,
    submission_line,
)

FIGURES = {
    "cascaded_tanks": 1,
    "ced": 2,
    "emps": 1,
    "silverbox": 3,
    "wiener_hammerstein": 1,
    "fine_steering_mirror": 3,
    "parallel_wiener_hammerstein": 5,
    "f16": 6,
}


def test_the_published_results_of_the_cascaded_tanks() -> None:
    entries = leaderboard("cascaded_tanks")
    values = sorted(e.test_rmse for e in entries)
    assert len(entries) == 24
    assert (values[0], values[1], values[-1]) == (0.18, 0.221, 1.29)
    assert all(e.source.startswith("https://") and e.method and e.authors for e in entries)
    assert {e.year for e in entries} <= set(range(2017, 2027))


@pytest.mark.parametrize("name", list(FIGURES))
def test_each_result_has_a_number_or_a_gap_for_each_figure(name: str) -> None:
    entries = leaderboard(name)
    assert entries
    assert {len(e.figures) for e in entries} == {FIGURES[name]}
    assert all(e.source and any(v is not None for v in e.figures) for e in entries)


def test_the_records_of_the_boards() -> None:
    def best(name: str) -> list[float]:
        columns = zip(*(e.figures for e in leaderboard(name)), strict=True)
        return [min(v for v in column if v is not None) for column in columns]

    assert best("silverbox") == [0.289, 0.26, 0.257]
    assert best("parallel_wiener_hammerstein") == [0.2, 0.397, 0.412, 0.469, 0.827]
    assert best("wiener_hammerstein") == [0.241]


@pytest.mark.parametrize(
    "name", ["two_tanks_sim", "my_own", "", "..", "../problems/cascaded_tanks"]
)
def test_other_problems_have_none(name: str) -> None:
    assert leaderboard(name) == ()


def entry(*figures: float | None) -> Entry:
    return Entry(2020, "M", "A et al.", figures, "https://")


def test_a_figure_is_ranked_among_the_results_that_have_it() -> None:
    board = [entry(0.3, 2.0), entry(None, 1.0), entry(0.1, None), entry(0.2, 3.0)]
    first, second = standings(board, [OfficialFigure("a", 0.25), OfficialFigure("b", 0.5)])
    assert (first.rank, first.among, first.above_value) == (3, 4, 0.2)
    assert first.words == "3rd of 4, just above it 0.2 of M (A et al., 2020)"
    assert (second.rank, second.among, second.above) == (1, 4, None)
    (alone,) = standings([], [OfficialFigure("a", 1.0)])
    assert alone.words == ""


def test_an_equal_result_is_not_above() -> None:
    (found,) = standings([entry(0.2)], [OfficialFigure("a", 0.2)])
    assert (found.rank, found.among) == (1, 2)


def figures_of(values: dict[str, float], rule: protocol.TestRule) -> tuple[OfficialFigure, ...]:
    score = Scored("rmse", 9.9, (9.9,), tuple(values.values()))
    model = Recorded((score,), "0" * 64)
    record = cast(Any, SimpleNamespace(trajectories=tuple(values), horizon=None))
    problem = cast(Any, SimpleNamespace(protocol=protocol.ProtocolRule(test=rule)))
    return official_figures(cast(Problem, problem), cast(Unsealed, record), model)


def test_each_record_is_a_figure_in_the_official_unit() -> None:
    rule = protocol.TestRule(unit="mV", unit_factor=1000.0)
    found = figures_of({"a": 0.001, "b": 0.002}, rule)
    assert [(f.name, f.value) for f in found] == [("a", 1.0), ("b", 2.0)]


def test_a_figure_can_be_the_mean_over_records() -> None:
    rule = protocol.TestRule(
        figures=(protocol.Group("low", ("low_*",)), protocol.Group("high", ("high",)))
    )
    found = figures_of({"low_1": 1.0, "low_2": 3.0, "high": 5.0}, rule)
    assert [(f.name, f.value) for f in found] == [("low", 2.0), ("high", 5.0)]


def test_the_line_for_the_form() -> None:
    figures = [OfficialFigure("a", 0.3456), OfficialFigure("b", 12.0)]
    line = submission_line(figures, "mV", 61.0)
    assert line.startswith("RMSE [0.346; 12] mV, training time 1-60 min;")
    assert "> 4 days" in submission_line(figures, "mV", 1e6)


def test_ordinals() -> None:
    numbers = (1, 2, 3, 4, 11, 12, 13, 21, 102, 111)
    words = "1st 2nd 3rd 4th 11th 12th 13th 21st 102nd 111th"
    assert " ".join(map(ordinal, numbers)) == words


def test_a_figure_without_records_leaves_no_figure_in_anothers_place() -> None:
    rule = protocol.TestRule(
        figures=(protocol.Group("low", ("lo",)), protocol.Group("high", ("high",)))
    )
    assert figures_of({"low_1": 1.0, "high": 5.0}, rule) == ()
