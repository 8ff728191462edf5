"""Responses by the level of a signal: what depends on it, and what does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asia.data import Array, Signal, Trajectory
from asia.data.level_responses import LevelResponse, describe_levels, level_responses

SAMPLES = 1200


def inputs(seed: int) -> Array:
    """A flow above 0 and a load (T, 2), in steps."""
    rng = np.random.default_rng(seed)
    flow = np.repeat(rng.uniform(0.4, 1.6, SAMPLES // 20), 20)
    return np.column_stack([flow, np.repeat(rng.normal(size=SAMPLES // 8), 8)])


def lag(u: Array, seed: int, *, pace: Array | None = None, gain: Array | None = None) -> Trajectory:
    """First-order lag of the load; pace and gain (T,) are 1 by default."""
    ones, y = np.ones(len(u)), np.zeros(len(u))
    pace, gain = (ones if v is None else v for v in (pace, gain))
    for k in range(len(u) - 1):
        y[k + 1] = y[k] + (1.0 - np.exp(-pace[k] / 5.0)) * (gain[k] * u[k, 1] - y[k])
    y += 0.03 * np.random.default_rng([seed, 1]).normal(size=len(u))
    return Trajectory(u, y, 1.0)


@pytest.fixture(autouse=True)
def open_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Records are open loop and integrate nothing; these statistics have their own tests, and take
    longer."""
    chances = np.ones((2, 1))
    monkeypatch.setattr("asia.data.level_responses.feedback", lambda records: chances)
    monkeypatch.setattr("asia.data.level_responses.integrating", lambda records: ())


def of_load(found: tuple[LevelResponse, ...]) -> LevelResponse:
    (one,) = [r for r in found if r.input == 1]
    assert (one.of, one.signal) == ("input", 0)
    return one


@pytest.mark.parametrize("seed", range(4))
def test_a_linear_system_depends_on_no_level(seed: int) -> None:
    assert level_responses([lag(inputs(seed), seed)]) == ()


def test_a_time_constant_that_goes_as_one_over_the_flow() -> None:
    u = inputs(0)
    found = of_load(level_responses([lag(u, 0, pace=u[:, 0])]))
    assert found.time_constant.changes
    assert found.time_constant.power == pytest.approx(-1.0, abs=0.3)
    assert found.time_constant.values[1] == pytest.approx(5.0, rel=0.2)
    assert not found.gain.changes


def test_a_gain_that_changes_its_sign_and_no_time_that_changes() -> None:
    u = inputs(1)
    found = of_load(level_responses([lag(u, 1, gain=u[:, 0] - 1.0)]))
    assert found.gain.changes
    assert found.gain.values[0] < -0.1
    assert found.gain.values[2] > 0.1
    assert np.isnan(found.gain.power)


def test_units_change_numbers_and_no_finding() -> None:
    u = inputs(2)
    record = lag(u, 2, pace=u[:, 0])
    scaled = Trajectory(record.u * np.array([10.0, 1.0]), 3.0 * record.y + 7.0, 1.0)
    one, other = (of_load(level_responses([r])) for r in (record, scaled))
    assert other.gain.values == pytest.approx(3.0 * one.gain.values, rel=1e-6)
    assert other.levels == pytest.approx(10.0 * one.levels, rel=1e-6)
    assert other.time_constant.power == pytest.approx(one.time_constant.power, rel=1e-6)
    assert other.chance == one.chance


def test_the_sentence_names_signals_values_and_power() -> None:
    u = inputs(3)
    record = lag(u, 3, pace=u[:, 0])
    lines = describe_levels([record], (Signal("flow", "l/s"), Signal("load")), (Signal("x"),))
    (line,) = [one for one in lines if "input load" in one]
    assert line.startswith("response of output x to input load depends on the level of input flow")
    assert "time constant falls from" in line
    assert "as flow^(-" in line


def test_samples_that_were_not_measured_are_left_out() -> None:
    u = inputs(4)
    record = lag(u, 4, pace=u[:, 0])
    missing = np.random.default_rng(0).random((SAMPLES, 1)) < 0.02
    found = of_load(level_responses([replace(record, missing=missing)]))
    assert found.time_constant.change < 0.0
    assert found.time_constant.values[1] == pytest.approx(5.0, rel=0.2)


def test_a_short_record_says_nothing() -> None:
    u = inputs(0)[:60]
    assert level_responses([lag(u, 0, pace=u[:, 0])]) == ()
