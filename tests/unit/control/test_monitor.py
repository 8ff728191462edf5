"""The monitor: filters on known systems, the noise from residuals, thresholds, drifts, C."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asia.control.observer import (
    Filter,
    Method,
    MonitorSample,
    Noise,
    Observer,
    TimeVarying,
    alarm_threshold,
    augmented,
    increments,
    make_observer,
)
from asia.data.segment import Segment, SimulatedSegment
from asia.data.trajectory import Array
from asia.lowering.evaluation import evaluate
from asia.lowering.program import Builder, LoweredModel

POLE, GAIN = 0.75, 0.4


def tank(pole: float = POLE, gain: float = GAIN) -> LoweredModel:
    """x' = pole x + 0.15 tanh x + p u, y = x; the last state is the parameter p."""
    step = Builder(((1,), (1,), (1,)))
    flow = step.add("mul", (1, 2))
    bent = step.add("mul", (step.add("tanh", (0,)), step.constant(0.15)))
    after = step.add("add", (step.add("mul", (0, step.constant(pole))), bent))
    program = step.program([0, step.add("add", (after, flow)), 1])
    first = Builder(((1, 1), (1, 1), (1,)))
    start = first.program([first.add("reshape", (1,), (1,)), first.constant([gain])])
    return LoweredModel(1, 1, 1, 1, False, start, program)


def record(
    rng: np.random.Generator, samples: int, noise: float = 0.05, gains: Array | None = None
) -> tuple[Array, Array]:
    u = np.repeat(rng.uniform(-1, 1, samples // 8 + 1), 8)[:samples, None]
    gains = np.full(samples, GAIN) if gains is None else gains
    x, y = 0.0, np.empty((samples, 1))
    for k in range(samples):
        y[k] = x
        x = POLE * x + 0.15 * math.tanh(x) + gains[k] * u[k, 0]
    return u, y + noise * rng.normal(size=y.shape)


def tank_observer(rng: np.random.Generator, spread: float = 0.2) -> Observer:
    parts = [record(rng, 400) for _ in range(2)]
    held_out = [(tank(), Segment(u[:1], y[:1], u[1:], y[1:])) for u, y in parts]
    parameter = TimeVarying("p", GAIN, spread * GAIN, 0.01, 10.0)
    made, inside = make_observer(
        tank(), held_out, parts[0][0].var(axis=0), [parameter], [],
        math.exp(-1 / 300), 1e-4,
    )  # fmt: skip
    assert 0.92 < inside < 0.98
    return made


def through(observer: Observer, u: Array, y: Array, method: Method = "ekf") -> list[MonitorSample]:
    one = Filter(observer, method)
    one.start(u[:1], y[:1], u[1])
    return [one.update(*pair) for pair in zip(u[1:], y[1:], strict=True)]


@pytest.fixture(scope="module")
def observer() -> Observer:
    return tank_observer(np.random.default_rng(0))


def test_the_noise_of_the_residuals_is_found(observer: Observer) -> None:
    assert observer.noise.output[0] == pytest.approx(0.05**2, rel=0.15)
    # No slow disturbance, no noise of the inputs: both explain less than a tenth.
    assert observer.noise.disturbance[0] < 0.1 * 0.05**2
    assert observer.noise.input[0] < 0.05**2


def test_slow_disturbances_are_told_from_white_noise() -> None:
    rng = np.random.default_rng(1)
    parts: list[tuple[Array, Array]] = []
    for _ in range(2):
        u, y = record(rng, 500, noise=0.02)
        slow = np.zeros(len(y))
        for k in range(1, len(slow)):
            slow[k] = 0.95 * slow[k - 1] + 0.1 * math.sqrt(1 - 0.95**2) * rng.normal()
        parts.append((u, y + slow[:, None]))
    held_out = [(tank(), Segment(u[:1], y[:1], u[1:], y[1:])) for u, y in parts]
    made, inside = make_observer(
        tank(), held_out, parts[0][0].var(axis=0),
        [TimeVarying("p", GAIN, 0.0)], [], 1.0, 1e-4,
    )  # fmt: skip
    assert made.noise.disturbance[0] == pytest.approx(0.1**2, rel=0.5)
    assert made.noise.pole == pytest.approx(0.95, abs=0.03)
    assert made.noise.output[0] == pytest.approx(0.02**2, rel=0.5)
    assert 0.92 < inside < 0.98


@pytest.mark.parametrize("method", ["ekf", pytest.param("ukf", marks=pytest.mark.slow)])
def test_a_drift_is_reported_since_it_began_and_the_parameter_is_found(
    observer: Observer, method: Method
) -> None:
    gains = np.where(np.arange(1400) < 800, GAIN, 0.8 * GAIN)
    u, y = record(np.random.default_rng(2), 1400, gains=gains)
    found = through(observer, u, y, method)
    assert all(one.valid for one in found[:795])
    raised = next(k for k, one in enumerate(found) if not one.valid)
    assert raised < 900
    since = found[raised].since
    assert since is not None
    assert 700 <= since <= raised
    last = found[-1]
    assert last.parameters[0] == pytest.approx(0.8 * GAIN, abs=3 * last.deviations[0] + 1e-3)
    assert last.deviations[0] < 0.05 * GAIN
    assert not last.valid  # The parameter is another one than that of the run.


def test_without_a_drift_the_innovations_are_white_and_as_large_as_expected(
    observer: Observer,
) -> None:
    u, y = record(np.random.default_rng(3), 3000)
    found = through(observer, u, y)
    nis = np.array([one.nis for one in found])
    assert nis.mean() == pytest.approx(1.0, abs=0.12)
    assert np.mean((nis > 0.00098) & (nis < 5.02)) == pytest.approx(0.95, abs=0.015)
    assert sum(not one.valid for one in found) == 0


def test_the_filters_agree_with_the_kalman_filter_of_a_linear_model() -> None:
    # x' = 0.8 x + 0.5 u, y = x: no parameter, so that both filters are exact.
    step = Builder(((1,), (1,)))
    after = step.add("add", (step.add("mul", (0, step.constant(0.8))),
                             step.add("mul", (1, step.constant(0.5)))))  # fmt: skip
    first = Builder(((1, 1), (1, 1), (1,)))
    low = LoweredModel(
        1, 1, 1, 1, False, first.program([first.constant([0.0])]), step.program([0, after])
    )
    one = np.ones(1)
    noise = Noise(0.04 * one, 0.01 * one, 0.7, 0.02 * one)
    made = Observer(augmented(low, (), 0.7), (), noise, 0.3 * one, 1.0, 1e9, 5.0)
    rng = np.random.default_rng(4)
    u, y = rng.normal(size=(50, 1)), rng.normal(size=(50, 1))
    y[20] = np.nan
    a, c = np.diag([0.8, 0.7]), np.array([[1.0, 1.0]])
    z, p = np.zeros(2), np.diag([0.3, 0.01])
    q = np.diag([0.25 * 0.02, 0.01 * (1 - 0.49)])
    filters = {method: Filter(made, method) for method in ("ekf", "ukf")}
    for each in filters.values():
        each.start(u[:1], y[:1], u[0])
    for row, seen in zip(u, y, strict=True):
        spread = float((c @ p @ c.T)[0, 0] + 0.04)
        error = float(seen[0] - c[0] @ z)
        for each in filters.values():
            sample = each.update(row, seen)
            assert sample.y_hat[0] == pytest.approx(float(c[0] @ z), abs=1e-9)
            if np.isfinite(error):
                assert sample.nis == pytest.approx(error**2 / spread, rel=1e-9)
            else:
                assert (sample.measured, sample.nis) == (0, 0.0)
        if np.isfinite(error):
            gain = (p @ c.T)[:, 0] / spread
            z, p = z + gain * error, p - np.outer(gain, gain) * spread
        z, p = a @ z + np.array([0.5 * row[0], 0.0]), a @ p @ a.T + q


def alarms(threshold: float, nis: Array) -> int:
    """Alarms of Page's test that begins anew after each."""
    total, count = 0.0, 0
    for gained in increments(nis, 1).tolist():
        total = max(total + gained, 0.0)
        if total > threshold:
            count, total = count + 1, 0.0
    return count


def test_the_threshold_gives_the_stated_rate_of_false_alarms() -> None:
    rng = np.random.default_rng(5)
    white = [rng.chisquare(1, 1000)]
    threshold = alarm_threshold(white, 1, 1e-3)
    count = alarms(threshold, rng.chisquare(1, 300_000))
    assert 90 < count < 330  # At most the stated rate, 300, but not far below.
    # Clusters of large innovations ask for a higher threshold.
    wild = np.where(np.arange(1000) // 25 % 4 == 0, 2.5, 0.5) * rng.chisquare(1, 1000)
    assert alarm_threshold([wild], 1, 1e-3) > 1.5 * threshold


@pytest.mark.parametrize(
    ("changes", "u_factor", "u_plus", "y_factor", "y_plus"),
    [
        ([("gain", True, 0)], 1.3, 0.0, 1.0, 0.0),
        ([("offset", False, 0)], 1.0, 0.0, 1.0, 1.3),
        ([("gain", False, 0), ("offset", True, 0)], 1.0, 0.7, 1.3, 0.0),
    ],
)
def test_gains_and_offsets_of_signals_are_states(
    changes: Sequence[tuple[str, bool, int]], u_factor: float, u_plus: float, y_factor: float,
    y_plus: float,
) -> None:  # fmt: skip
    low = tank()
    flat = augmented(low, changes, 0.5)
    flat.check()
    (z,) = evaluate(flat.initial, [np.zeros((1, 1)), np.array([[0.6]]), np.ones(1)])
    assert z[2:-1].tolist() == [1.0 if kind == "gain" else 0.0 for kind, _, _ in changes]
    z[2:-1] = [1.3, 0.7][: len(changes)]
    z[-1] = 0.25
    u = np.array([0.4])
    y, after = evaluate(flat.step, [z, u])
    plain_y, plain_x, _ = evaluate(
        low.step, [np.array([0.6]), np.array([GAIN]), u_factor * u + u_plus]
    )
    assert y == pytest.approx(y_factor * plain_y + y_plus + 0.25)
    assert after[0] == pytest.approx(plain_x[0])
    assert after[-1] == pytest.approx(0.125)


def test_the_observer_in_c_gives_the_same_to_1e_9(observer: Observer, tmp_path: Path) -> None:
    from asia.control.observer_c import observed, observer_files
    from asia.data.trajectory import Signal
    from asia.export.model import ExportModel
    from asia.export.targets.c import c_compiler

    compiler = c_compiler()
    if compiler is None:
        pytest.skip("no C compiler")
    ends = np.zeros((1, 2))
    signals = (Signal("u"),), (Signal("y"),)
    model = ExportModel("run", "refit", "tank", observer.low, *signals, 1.0, ends, ends)
    for name, data in observer_files(model, observer).items():
        (tmp_path / name).write_bytes(data)
    gains = np.where(np.arange(900) < 500, GAIN, 0.7 * GAIN)
    u, y = record(np.random.default_rng(6), 900, gains=gains)
    y[40:60] = np.nan
    y[700] = 1e200
    found = through(observer, u, y)
    expected = np.array(
        [[*s.y_hat, s.nis, s.statistic, *s.parameters, *s.deviations,
          -1 if s.since is None else s.since] for s in found]
    )  # fmt: skip
    window = SimulatedSegment(u[:1], y[:1], u[1:], y[1:], y_hat=y[1:])
    (printed,), _ = observed(compiler, tmp_path, [window], 6)
    assert {s.since for s in found} > {None}
    np.testing.assert_allclose(printed[:650], expected[:650], rtol=1e-9, atol=1e-9)
    # After an absurd measurement both still agree, and report it.
    np.testing.assert_allclose(printed[650:], expected[650:], rtol=1e-6, atol=1e-6)


def test_a_value_that_is_no_number_does_not_stay(observer: Observer) -> None:
    u, y = record(np.random.default_rng(7), 300)
    u[100] = 1e200
    found = through(observer, u, y)
    assert np.isfinite([one.y_hat[0] for one in found]).all()
    assert found[-1].nis < 20.0


def test_forgetting_keeps_a_parameter_uncertain(observer: Observer) -> None:
    u, y = record(np.random.default_rng(9), 800)
    short, long = (
        through(replace(observer, forgetting=f), u, y)[-1].deviations[0]
        for f in (math.exp(-1 / 50), 1.0)
    )
    assert long < 0.5 * short < 0.5 * 0.2 * GAIN
