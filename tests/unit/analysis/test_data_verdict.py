"""Verdict on training records: good ones of known systems, and ones spoilt in one way each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from asia.analysis.data_verdict import DataVerdict, judge_data
from asia.data import Signal, Trajectory
from asia.problem.check import check_problem
from asia.problem.load import load_problem
from asia.problem.problem import Problem, Seal

TANKS = load_problem("two_tanks_sim")
SEAL = Seal("0" * 64, ("t",), (500,))


def spread_input(samples: int, seed: int = 0, hold: int = 4) -> np.ndarray:
    """Random levels, each held for some samples."""
    levels = np.random.default_rng(seed).uniform(-1, 1, samples // hold + 1)
    return np.repeat(levels, hold)[:samples, None]


def second_order(u: np.ndarray, delay: int = 1, noise: float = 0.01, seed: int = 0) -> np.ndarray:
    """Poles 0.9 and 0.6, static gain 1."""
    b = [0.0] * delay + [0.1 * 0.4]
    y = lfilter(b, np.convolve([1, -0.9], [1, -0.6]), u[:, 0])
    return (y + noise * np.random.default_rng(seed).normal(size=len(y)))[:, None]


def problem_of(u: np.ndarray, y: np.ndarray) -> Problem:
    inputs = tuple(Signal(f"u{i}") for i in range(u.shape[1]))
    record = Trajectory(u, y, 4.0, "r")
    return replace(TANKS, train=(record,), inputs=inputs, physics=None, symmetry={})


def judged(u: np.ndarray, y: np.ndarray) -> DataVerdict:
    problem = problem_of(u, y)
    return judge_data(problem, check_problem(problem, SEAL))


@pytest.mark.parametrize("delay", [5, *(pytest.param(d, marks=pytest.mark.slow) for d in (1, 2))])
def test_good_records_show_order_delay_and_time_constants(delay: int) -> None:
    u = spread_input(1500)
    found = judged(u, second_order(u, delay))
    assert found.verdict == "good"
    assert found.experiment == ""
    assert len(found.reasons) == 3
    assert found.linear is not None
    assert (found.linear.order, found.linear.delays) == (2, {"u0": delay})
    expected = [-4.0 / np.log(0.9), -4.0 / np.log(0.6)]
    assert found.linear.time_constants == pytest.approx(expected, rel=0.1)
    text = "\n".join(found.lines())
    assert f"order 2, delay {delay} sample" in text
    assert "verdict   good" in text


@pytest.mark.long
def test_records_spoilt_in_one_way_name_that_way_and_what_would_help() -> None:
    u = spread_input(1500)
    y = second_order(u)
    rng = np.random.default_rng(3)
    fed_back = rng.normal(size=(1500, 1))
    response = np.zeros((1500, 1))
    for k in range(1, 1500):
        response[k] = 0.9 * response[k - 1] + 0.1 * fed_back[k - 1] + 0.3 * rng.normal()
        fed_back[k] -= 1.5 * response[k]
    slow = lfilter([0, 1 - 0.997], [1, -0.997], u[:, 0])[:, None]
    slow += 0.002 * rng.normal(size=slow.shape)
    binary = np.sign(u)
    cases = [
        ((u, np.ones_like(y)), "not enough", "is constant", ""),
        ((u, rng.normal(size=y.shape)), "not enough", "no effect of an input", "larger and faster"),
        ((u[:40], y[:40]), "not enough", "samples for each parameter", "more records"),
        ((u, slow), "usable with limits", "slowest time constant", "records of"),
        ((binary, second_order(binary)), "usable with limits", "two values", "several levels"),
        ((fed_back, response), "usable with limits", "from a controller", "an open loop"),
        (
            (u, second_order(u, noise=0.35)),
            "usable with limits",
            "noise or nonlinearity",
            "periods",
        ),
        ((np.hstack([u, u]), y), "usable with limits", "collinear", "independently"),
    ]
    for (inputs, outputs), verdict, reason, helps in cases:
        found = judged(inputs, outputs)
        assert found.verdict == verdict, found.lines()
        assert reason in found.reasons[0], found.lines()
        assert helps in found.experiment, found.lines()


@pytest.mark.slow
def test_one_experiment_gives_one_reason() -> None:
    y = np.arange(1500.0)[:, None]
    both = np.hstack([y, -y]) + 0.1 * np.random.default_rng(0).normal(size=(1500, 2))
    problem = replace(problem_of(spread_input(1500), both), outputs=(Signal("a"), Signal("b")))
    found = judge_data(problem, check_problem(problem, SEAL))
    assert sum("rises" in one or "falls" in one for one in found.reasons) == 1
