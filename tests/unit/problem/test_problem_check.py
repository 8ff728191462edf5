from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asia.data import Signal, Trajectory
from asia.problem import Correction, Prior
from asia.problem.check import between_lines, check_problem
from asia.problem.folds import make_folds
from asia.problem.load import load_problem
from asia.problem.problem import Problem, Seal
from asia.problem.protocol import Group


@pytest.fixture
def tanks() -> Problem:
    return load_problem("two_tanks_sim")


def with_signals(problem: Problem, u: np.ndarray, y: np.ndarray) -> Problem:
    inputs = tuple(Signal(f"u{i}") for i in range(u.shape[1]))
    return replace(problem, train=(Trajectory(u, y, 4.0, "r"),), inputs=inputs, physics=None)


def test_folds_match_the_papers_ranges(tanks: Problem) -> None:
    report = check_problem(tanks, Seal(None))
    ranges = [(h.first, h.last) for f in report.folds for h in f.held_out]
    assert ranges == [(6, 515), (516, 1024)]
    assert [f.training_samples for f in report.folds] == [509, 510]


def test_priors_next_to_the_equations_are_printed(tanks: Problem) -> None:
    assert tanks.physics is not None
    dynamics = {**tanks.physics.dynamics, "x1": "-k1*sqrt(x1) + k4*pump_voltage + leak"}
    physics = replace(
        tanks.physics,
        dynamics=dynamics,
        priors={"k2/k1": Prior(1.0, 0.15, "two alike tanks")},
        corrections={"leak": Correction(0.01)},
    )
    known = replace(tanks, physics=physics, symmetry={"odd": {"pump_voltage": "-pump_voltage"}})
    lines = check_problem(known, Seal(None)).lines()
    assert "prior k2/k1 = 1 +- 0.15: two alike tanks" in lines
    assert "correction leak: unknown, about 0.01 large" in lines
    assert "symmetry odd: pump_voltage -> -pump_voltage" in lines


def test_training_samples_are_those_the_folds_train_on(tanks: Problem) -> None:
    long = tanks.train[0]
    # Half of 11 samples after the past window of 5: the rest of 5 is dropped, that of 6 is not.
    problem = replace(tanks, train=(long, replace(long[:16], name="short")))
    counted = [f.training_samples for f in check_problem(problem, Seal(None)).folds]
    folds = make_folds(problem.train, problem.protocol)
    assert counted == [sum(len(t) for t in fold.train) for fold in folds] == [509, 510 + 6]


def test_bandwidth_and_order_of_a_sine(tanks: Problem) -> None:
    k = np.arange(1000)
    u = np.sin(2 * np.pi * 0.1 * k)[:, None]
    report = check_problem(with_signals(tanks, u, u + 1), Seal(None))
    check = report.signals[0]
    assert check.excitation_order == 2
    assert check.bandwidth_share == pytest.approx(0.2, abs=0.01)
    assert check.bandwidth == pytest.approx(0.1 / 4.0, rel=0.05)
    assert any("excites at most 2 modes" in w for w in report.warnings)


def test_white_noise_excites_every_order(tanks: Problem) -> None:
    u = np.random.default_rng(0).standard_normal((1000, 1))
    check = check_problem(with_signals(tanks, u, u), Seal(None)).signals[0]
    assert check.excitation_order == 50
    assert check.bandwidth_share > 0.9


def test_inputs_between_samples_are_described(tanks: Problem) -> None:
    random = np.random.default_rng(0)
    u = random.standard_normal((400, 4))
    u[:, 1] = np.repeat(u[:100, 1], 4)
    u[:, 3] = 1.0
    problem = with_signals(tanks, u, u[:, :1] + 0.1 * random.standard_normal((400, 1)))
    names = problem.inputs
    problem = replace(
        problem, inputs=(*names[:2], replace(names[2], intersample="first"), names[3])
    )
    lines = between_lines(problem)
    assert len(lines) == 3
    assert lines[0].startswith("input u0: tank2_level depends on it in the same sample")
    assert lines[1] == "input u1: held between samples: it is constant over several at a time"
    assert lines[2] == "input u2: linear between samples, by the problem file"
    assert set(lines) <= set(check_problem(problem, Seal(None)).lines())


def test_doubts_are_said(tanks: Problem) -> None:
    random = np.random.default_rng(0)
    u = random.standard_normal((1000, 3))
    u[:, 1] = 2 * u[:, 0]
    u[:, 2] = 1.0
    y = np.clip(random.standard_normal((1000, 1)), -9, 1)
    problem = replace(with_signals(tanks, u, y), description=" ", warnings=("clock",))
    seal = Seal("0" * 64, ("t",), (1000,), shared_samples=7, outside_inputs=(10, 11, 0))
    report = check_problem(problem, seal)
    text = "\n".join(report.warnings)
    for expected in (
        "clock",
        "output tank2_level is at its limit 1 V",
        "input u2 is constant",
        "inputs u0 and u1 are collinear",
        "the description is empty",
        "7 test samples also occur",
        "11 of 1000 test samples of input u1 are outside",
    ):
        assert expected in text
    assert len(report.warnings) == 7


def test_missing_outputs_are_counted(tanks: Problem) -> None:
    u = np.random.default_rng(0).standard_normal((1000, 1))
    y = np.where(np.arange(1000)[:, None] % 10 == 3, np.nan, u)
    problem = replace(
        with_signals(tanks, u, y),
        warnings=("a.csv: 100 of 1000 output values were not measured; they do not count", "else"),
    )
    lines = check_problem(problem, Seal(None)).lines()
    assert "missing outputs, in samples, left out of fit and V: tank2_level 100 of 1000" in lines
    # Once is enough.
    assert "not measured" not in "\n".join(lines)
    assert "warning: else" in lines


def test_constant_signal_has_no_shares(tanks: Problem) -> None:
    y = np.random.default_rng(0).standard_normal((1000, 1))
    # The mean of many 0.1 is not 0.1: such a signal has a standard deviation above 0.
    report = check_problem(with_signals(tanks, np.full((1000, 1), 0.1), y), Seal(None))
    line = next(line for line in report.lines() if line.startswith("input u0"))
    assert line == "input u0: constant at 0.1"
    assert "input u0 is constant: nothing can be learned from it" in report.warnings


def test_few_scored_test_samples_are_said(tanks: Problem) -> None:
    beyond = tanks.protocol.past + tanks.protocol.test.skip
    seal = Seal("0" * 64, ("short", "enough"), (beyond + 49, beyond + 50))
    report = check_problem(tanks, seal)
    doubts = [w for w in report.warnings if w.startswith("test record")]
    assert len(doubts) == 1
    assert "'short' has 49 samples to score" in doubts[0]
    text = "\n".join(report.lines())
    assert f"short ({beyond + 49} samples, 49 scored)" in text
    assert f"enough ({beyond + 50} samples, 50 scored)" in text


def test_slow_output_is_said(tanks: Problem) -> None:
    random = np.random.default_rng(0)
    u = random.standard_normal((5000, 1))
    y = np.sin(2 * np.pi * np.arange(5000) / 2500)[:, None]
    report = check_problem(with_signals(tanks, u, y), Seal("0" * 64, ("t",), (5,)))
    assert any("sampled much faster than it changes" in w for w in report.warnings)


def test_lines_name_everything(
    write_problem: Callable[..., Path], minimal: str, tanks: Problem
) -> None:
    lines = check_problem(tanks, Seal("ab" * 32, ("two_tanks_test",), (1024,))).lines()
    text = "\n".join(lines)
    for expected in (
        "sampled every 4 s",
        "input pump_voltage [V]",
        "1024 samples, 4096 s",
        "missing values: none",
        "fold 2: holds out two_tanks_train 516-1024",
        "test: two_tanks_test (1024 samples, 974 scored); 45 samples",
        "sha256 abababababab",
        "2 states (x1, x2), 4 parameters to fit",
    ):
        assert expected in text
    plain = check_problem(load_problem(write_problem(minimal)), Seal(None)).lines()
    assert "test: none" in plain
    assert "physics: no equations in problem.toml" in plain


def test_a_workspace_has_no_test_of_its_own(tanks: Problem) -> None:
    found = check_problem(tanks, Seal(None), in_workspace=True)
    assert "test: none" not in found.lines()
    assert any(line.startswith("test: not in a workspace;") for line in found.lines())
    assert not any("no test data" in line for line in found.warnings)


def test_an_official_figure_without_test_records_is_doubted() -> None:
    tanks = load_problem("two_tanks_sim")
    figures = (Group("all", ("two_*",)), Group("late", ("melon_*",)))
    rule = replace(tanks.protocol, test=replace(tanks.protocol.test, figures=figures))
    seal = Seal("ab" * 32, ("two_tanks_test",), (1024,))
    lines = check_problem(replace(tanks, protocol=rule), seal).lines()
    doubts = [line for line in lines if "protocol.test.figures" in line]
    assert len(doubts) == 1
    assert "late names no test record" in doubts[0]
