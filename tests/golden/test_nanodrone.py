"""Published figures of the nanodrone benchmark's trivial references, on its real flights."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from asia.judge.evaluation.references import constant_velocity, find_rates
from asia.judge.scoring.euclidean_error import mee_table
from asia.judge.scoring.outcome import score_fold
from asia.problem.folds import Fold, make_folds, whole
from asia.problem.load import load_lock, load_problem
from asia.problem.lock import lock_text
from asia.problem.physics import parse_expression
from asia.problem.problem import Problem, Seal
from asia.problem.seal import open_test, seal

pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(not os.environ.get("ASIA_DATA_DIR"), reason="ASIA_DATA_DIR is not set"),
]


@pytest.fixture(scope="module")
def problem() -> Problem:
    return load_problem("nanodrone")


@pytest.fixture(scope="module")
def folds(problem: Problem) -> tuple[Fold, ...]:
    return make_folds(problem.train, problem.protocol)


def test_windows_are_those_of_the_paper(problem: Problem, folds: tuple[Fold, ...]) -> None:
    assert [g.name for g in problem.protocol.folds.groups] == ["chirp", "random", "square"]
    assert [len(fold.held_out) for fold in folds] == [480, 480, 152]
    assert seal(problem).lengths == (6499, 6499, 6499)


def test_holding_the_last_state(folds: tuple[Fold, ...]) -> None:
    found = [
        score_fold(
            [b.y for b in fold.held_out],
            [np.tile(b.past_y[-1], (50, 1)) for b in fold.held_out],
            fold.scale,
            "mae",
        ).value
        for fold in folds
    ]
    assert found == pytest.approx([0.310, 0.355, 0.954], abs=5e-4)
    assert np.mean(found) == pytest.approx(0.540, abs=5e-4)


def test_constant_velocity(folds: tuple[Fold, ...]) -> None:
    found: list[float] = []
    for fold in folds:
        rates = find_rates(fold, 50)
        assert rates == (3, 4, 5, None, None, None, 9, 10, 11, None, None, None)
        y_hat = [constant_velocity(b, rates, 0.01) for b in fold.held_out]
        measured = [b.y for b in fold.held_out]
        found.append(score_fold(measured, y_hat, fold.scale, "mae").value)
    assert np.mean(found) == pytest.approx(0.429, abs=5e-4)


def test_the_equations_have_the_signs_of_the_flights(problem: Problem) -> None:
    """Measured changes from 3 samples before to 3 after go with those of the equations."""
    physics = problem.physics
    assert physics is not None
    u = np.concatenate([t.u[4:-3] for t in problem.train])
    y = np.concatenate([t.y[4:-3] for t in problem.train])
    change = np.concatenate([t.y[7:] - t.y[1:-6] for t in problem.train])
    values = {s.name: u[:, i] for i, s in enumerate(problem.inputs)}
    values |= {s.name: y[:, i] for i, s in enumerate(problem.outputs)}
    values |= {name: np.float64(value) for name, value in physics.constants.items()}
    values |= dict.fromkeys(physics.corrections, np.float64(0.0))
    for name, span in physics.parameters.items():
        values[name] = np.float64(np.sqrt(span.min * span.max) if span.min > 0 else 0.0)
    functions = {"sin": np.sin, "cos": np.cos, "tan": np.tan}
    for name in physics.definitions:
        values[name] = parse_expression(physics.definitions[name], name).evaluate(values, functions)
    least = 3 * [0.9] + 3 * [0.7] + 3 * [0.7] + 3 * [0.1]
    for i, name in enumerate(physics.states):
        rate = parse_expression(physics.dynamics[name], name).evaluate(values, functions)
        assert np.corrcoef(rate, change[:, i])[0, 1] > least[i], name


def test_the_naive_row_of_the_test(problem: Problem) -> None:
    """Holds the last state; no model is ever looked at on these flights outside of unsealing."""
    rule = problem.protocol
    blocks = whole(open_test(problem), rule)
    assert len(blocks) == 390
    held = [np.tile(b.past_y[-1], (50, 1)) for b in blocks]
    names = [s.name for s in problem.outputs]
    table = mee_table([b.y for b in blocks], held, names, rule.test.groups, rule.test.horizons)
    rows = {g.name: (g.at(10), g.at(50), g.total) for g in table.groups}
    assert rows["p"] == pytest.approx((0.141, 0.672, 17.57), rel=5e-3)
    assert rows["v"] == pytest.approx((0.313, 1.468, 38.83), rel=2e-3)
    assert rows["R"] == pytest.approx((0.068, 0.302, 8.13), rel=5e-3)
    assert rows["omega"] == pytest.approx((0.338, 0.861, 28.63), rel=2e-3)


def test_its_lock_restores_it(problem: Problem, tmp_path: Path) -> None:
    path = tmp_path / "problem.lock.toml"
    path.write_text(lock_text(problem, Seal(None)), encoding="utf-8")
    assert load_lock(path).protocol == problem.protocol
