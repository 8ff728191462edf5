"""Advice on delay, feedback, drift, steps and outliers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from asia.data import Array, Signal, Trajectory
from asia.data.statistics import limit_shares
from asia.problem.check import data_doubts, delay_lines
from asia.problem.load import load_problem
from asia.problem.problem import Problem

SAMPLES = 1000


@pytest.fixture(scope="module")
def tanks() -> Problem:
    return load_problem("two_tanks_sim")


def clean(seed: int, delay: int = 3) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    u = rng.normal(size=SAMPLES)
    y = np.zeros(SAMPLES)
    for k in range(1, SAMPLES):
        y[k] = 0.8 * y[k - 1] + (u[k - delay] if k >= delay else 0.0)
    return u, y + 0.05 * rng.normal(size=SAMPLES)


def of(tanks: Problem, u: Array, y: Array) -> Problem:
    records = (Trajectory(u[:, None], y[:, None], 0.5, "r"),)
    return replace(
        tanks, train=records, inputs=(Signal("u", "V"),), outputs=(Signal("y", "m"),),
        sampling_time=0.5,
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(2))
def test_a_clean_record_has_its_delay_and_no_doubts(tanks: Problem, seed: int) -> None:
    problem = of(tanks, *clean(seed))
    assert data_doubts(problem) == []
    (line,) = delay_lines(problem)
    assert line.startswith("delay of output y in samples: u 3")


def test_each_fault_is_said_once(tanks: Problem) -> None:
    u, y = clean(1)
    spiked = y.copy()
    spiked[[200, 700]] += 40.0
    faults = {
        "rises by": y + np.linspace(0.0, 20.0, SAMPLES),
        "is quantized in steps of 0.8 m": 0.8 * np.round(y / 0.8),
        "2 samples jump away from both neighbours, the first at row 201 of record 'r'": spiked,
    }
    for said, values in faults.items():
        (doubt,) = map(str, data_doubts(of(tanks, u, values)))
        assert said in doubt


def test_logger_codes_of_missing_values_are_reported(tanks: Problem) -> None:
    u, y = clean(2)
    coded, held, stuck = u.copy(), y.copy(), y.copy()
    coded[400] = -9999.0
    held[300:305] = -999.9
    stuck[300:303] = 32767.0
    faults = {
        "input u is -9999 in row 401 of record 'r'": (coded, y),
        "output y is -999.9 in 5 samples, the first in row 301": (u, held),
        "output y is 32767 in 3 samples, the first in row 301": (u, stuck),
    }
    for said, signals in faults.items():
        doubts = [str(one) for one in data_doubts(of(tanks, *signals))]
        assert [said in doubt for doubt in doubts] == [True]
    kicked = u * 1e-3
    kicked[[200, 600]] = 50.0
    assert data_doubts(of(tanks, kicked, y)) == []


def test_an_input_that_reads_the_output_of_the_same_sample_is_doubted(tanks: Problem) -> None:
    rng = np.random.default_rng(3)
    u, y = np.zeros(SAMPLES), np.zeros(SAMPLES)
    for k in range(SAMPLES - 1):
        u[k] = rng.normal() - 1.5 * y[k]
        y[k + 1] = 0.9 * y[k] + 0.1 * u[k] + rng.normal()
    problem = of(tanks, u, y)
    lines = delay_lines(problem)
    assert any("delay 0: output y" in line and "controller" in line for line in lines)


def test_feedback_is_distinguished_from_an_open_loop(tanks: Problem) -> None:
    rng = np.random.default_rng(0)
    u, y, x, disturbance = np.zeros(SAMPLES), np.zeros(SAMPLES), 0.0, 0.0
    for k in range(SAMPLES):
        disturbance = 0.9 * disturbance + 0.5 * rng.normal()
        x = 0.9 * x + 0.1 * (u[k - 1] if k else 0.0)
        y[k] = x + disturbance
        u[k] = -0.3 * (y[k - 1] if k else 0.0) + 0.05 * rng.normal()
    (doubt,) = map(str, data_doubts(of(tanks, u, y)))
    assert "input u follows earlier values of output y" in doubt


def test_feedback_to_a_sine_is_not_judged(tanks: Problem) -> None:
    u = np.sin(2 * np.pi * np.arange(SAMPLES) / 37)
    problem = of(tanks, u, np.roll(u, 3))
    assert any(line.startswith("feedback: not tested for input u") for line in delay_lines(problem))
    assert not any("follows earlier" in str(doubt) for doubt in data_doubts(problem))


def test_a_limit_is_held_while_inputs_move_and_a_rest_or_a_frozen_sensor_is_none() -> None:
    rng = np.random.default_rng(2)
    u = np.repeat(rng.uniform(-1.0, 1.0, 200), 5)
    y = np.zeros(SAMPLES)
    for k in range(1, SAMPLES):
        y[k] = 0.9 * y[k - 1] + 0.1 * u[k - 1]
    y += 0.01 * rng.normal(size=SAMPLES)
    top = float(np.quantile(y, 0.8))

    def shares(u: Array, y: Array) -> tuple[float, float]:
        return limit_shares((Trajectory(u[:, None], y[:, None], 1.0, "r"),))[0]

    assert shares(u, np.minimum(y, top))[1] > 0.1
    assert shares(u, y) == (0.0, 0.0)
    frozen = y.copy()
    frozen[300:500] = y.max() + 1.0
    assert shares(u, frozen) == (0.0, 0.0)
    steps = np.repeat([0.0, 1.0, 0.0, 1.0, 0.0], 200)
    assert shares(steps, np.round(lfilter([0.0, 0.5], [1.0, -0.5], steps), 6)) == (0.0, 0.0)
