"""Pictures of problems with windows, and of comparisons of searches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from asia.data import Signal
from asia.judge.scoring.euclidean_error import mee_table
from asia.judge.scoring.residuals import cross_correlation
from asia.ledger.run import open_run
from asia.ledger.simulated import representative_windows
from asia.problem.problem import Problem
from asia.problem.protocol import FoldRule, Group, OutputGroup
from asia.problem.protocol import TestRule as SealedRule
from asia.report.drawing.style import drawing
from asia.report.files import pictures
from asia.report.pictures.check import draw_data
from asia.report.pictures.progress import draw_comparison

from .made_up import Shape, make_problem, write_run
from .test_report_pictures import FIVE, assert_readable

SHAPE = Shape(
    samples=(101,) * 12,
    inputs=tuple(Signal(f"motor_{i}", "rad/s") for i in range(4)),
    outputs=tuple(Signal(f"state_{i}", "m/s") for i in range(12)),
    sampling_time=0.01,
    skip=0,
    name="drone",
)


def windows_problem(groups: bool = True) -> Problem:
    """Twelve records in three groups, windows of 20 samples."""
    problem = make_problem(SHAPE)
    names = [t.name for t in problem.train]
    held_out = tuple(Group(f"flight{k}", tuple(names[4 * k : 4 * k + 4])) for k in range(3))
    outputs = [s.name for s in problem.outputs]
    tested = SealedRule(
        metrics=("mae",),
        groups=(
            OutputGroup("p", tuple(outputs[:3])),
            OutputGroup("R", tuple(outputs[6:9]), "geodesic"),
        )
        if groups
        else (),
    )
    rule = replace(
        problem.protocol,
        kind="windows",
        horizon=20,
        past_inputs=0,
        past_outputs=1,
        metric="mae",
        folds=FoldRule("leave_one_group_out", 3, held_out),
        test=tested,
    )
    return replace(problem, protocol=rule)


@pytest.mark.long
@pytest.mark.parametrize("groups", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_every_picture_of_windows_can_be_read(tmp_path: Path, groups: bool) -> None:
    problem = windows_problem(groups)
    run = open_run(write_run(tmp_path / "run", problem, FIVE[:2], unsealed=2))
    with drawing():
        figures = {name: draw() for name, draw in pictures(run, problem)}
        figures["data"] = draw_data(problem)
        assert set(figures) == {
            "progress", "simulation", "horizon", "residuals", "test", "test_horizon", "data",
        }  # fmt: skip
        for figure in figures.values():
            assert_readable(figure)
            assert len(figure.axes) <= 17
            assert max(figure.get_size_inches()) < 13


def test_the_data_picture_shows_every_group_and_output() -> None:
    problem = windows_problem()
    with drawing():
        figure = draw_data(problem)
        texts = {t.get_text() for axes in figure.axes for t in axes.texts}
        labels = {axes.get_ylabel() for axes in figure.axes}
    assert {"flight0", "flight1", "flight2"} <= texts
    assert {f"{s.name} [{s.unit}]" for s in problem.outputs} <= labels


def test_the_horizon_is_drawn_from_the_recorded_simulations(tmp_path: Path) -> None:
    problem = windows_problem()
    run = open_run(write_run(tmp_path / "run", problem, FIVE[:1]))
    with drawing():
        figure = dict(pictures(run, problem))["horizon"]()
        first, second = figure.axes[:2]
        titles = [axes.get_title(loc="left") for axes in (first, second)]
        curve = np.array(first.get_lines()[0].get_ydata())
    assert titles == ["p", "R"]
    assert first.get_ylabel() == "Distance [m/s]"
    assert second.get_ylabel().startswith("Angle")
    from asia.ledger.simulated import fold_outputs
    from asia.problem.folds import make_folds

    fold = make_folds(problem.train, problem.protocol)[0]
    best = run.view.best
    assert best is not None
    y_hat = fold_outputs(run.store, best.folds, make_folds(problem.train, problem.protocol))[0]
    names = [s.name for s in problem.outputs]
    groups = problem.protocol.test.groups
    table = mee_table([b.y for b in fold.held_out], y_hat, names, groups, ())
    assert curve == pytest.approx(table.groups[0].steps)


def test_the_telling_windows() -> None:
    measured = [np.zeros((4, 2)) for _ in range(5)]
    simulated = [np.full((4, 2), size) for size in (3.0, 1.0, 5.0, 2.0, 4.0)]
    assert list(representative_windows(measured, simulated, np.ones(2))) == [
        ("best", 1), ("median", 0), ("worst", 2),
    ]  # fmt: skip
    assert list(representative_windows(measured[:1], simulated[:1], np.ones(2))) == [("best", 0)]
    scale = np.array([1.0, 100.0])
    mixed = [np.tile([1.0, 0.0], (4, 1)), np.tile([0.0, 10.0], (4, 1))]
    assert dict(representative_windows(measured[:2], mixed, scale)) == {"best": 1, "median": 0}


def test_windows_of_one_length_correlate_as_one_by_one() -> None:
    rng = np.random.default_rng(0)
    a = [rng.standard_normal(n) for n in (30, 20, 30)]
    b = [rng.standard_normal(n) for n in (30, 20, 30)]
    products, energy = np.zeros(7), [0.0, 0.0]
    for x, y in zip(a, b, strict=True):
        x, y = x - x.mean(), y - y.mean()
        energy = [energy[0] + x @ x, energy[1] + y @ y]
        for lag in range(-3, 4):
            pairs = [(t, t - lag) for t in range(len(x)) if 0 <= t - lag < len(x)]
            products[3 + lag] += sum(x[t] * y[s] for t, s in pairs)
    expected = products / np.sqrt(energy[0] * energy[1])
    assert cross_correlation(a, b, 3) == pytest.approx(expected)


def made_up_searches(seeds: int) -> dict[str, list[list[float | None]]]:
    rng = np.random.default_rng(0)
    levels = {"expert": 0.1, "random, library space": 0.2, "random, paper's space": 0.4}
    return {
        name: [[None, *(level * rng.uniform(1, 3, 14)).tolist(), 40.0] for _ in range(seeds)]
        for name, level in levels.items()
    }


def lines_of(figure: Figure, label: str) -> np.ndarray:
    handles, labels = figure.axes[0].get_legend_handles_labels()
    (line,) = (h for h, text in zip(handles, labels, strict=True) if text.startswith(label))
    return np.array(line.get_ydata())


@pytest.mark.parametrize("seeds", [1, 3])
def test_searches_against_each_other(seeds: int) -> None:
    agents = made_up_searches(seeds)
    levels = {"linear model": 0.39, "paper: agentic search, best of 15": 0.25}
    with drawing():
        figure = draw_comparison(agents, levels, "rmse", "tanks: expert against random search")
        assert_readable(figure)
    drawn = lines_of(figure, "expert")
    best = np.minimum.accumulate(np.array([c[1:] for c in agents["expert"]], float), axis=1)
    assert drawn[:-1] == pytest.approx(np.median(best, axis=0))
    assert figure.axes[0].get_ylim()[1] < 40.0
    assert list(lines_of(figure, "paper")) == [0.25, 0.25]


def test_best_so_far_of_searches_of_different_lengths() -> None:
    agents = {"a": [[None, 0.5, None, 0.7, 0.2]], "b": [[0.9] * 6]}
    with drawing():
        drawn = lines_of(draw_comparison(agents, {}, "rmse", ""), "a")
    assert list(drawn) == [0.5, 0.5, 0.5, 0.2, 0.2, 0.2]
