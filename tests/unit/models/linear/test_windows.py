"""Models of an unstable system, judged on windows of a horizon: linear and neural state space."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asia.candidate import Context, Model
from asia.data import Array, Signal, Trajectory
from asia.models import linear, neural_ss
from asia.models._least_squares import LevenbergMarquardt
from asia.models._linear.window_predictor import (
    WindowLags,
    WindowPredictor,
    held,
    normal_by_lags,
    normal_by_steps,
    one_step,
    refined,
)
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import SegmentBatch, cut_windows, scaled, stretches
from asia.models._state_space.structure import StateSpaceStructure
from asia.models.methods import Adam

HORIZON = 12


def pendulum(length: int, seed: int) -> Trajectory:
    """An inverted pendulum held up by feedback; angle and rate are measured, in odd units."""
    rng = np.random.default_rng(seed)
    x, u, rows = np.zeros(2), np.empty(length), np.empty((length, 2))
    for k in range(length):
        u[k] = -2.0 * x[0] - 1.5 * x[1] + rng.standard_normal()
        rows[k] = x
        x = x + 0.1 * np.array([x[1], np.sin(x[0]) + u[k]])
    noisy = rows + 0.002 * rng.standard_normal(rows.shape)
    return Trajectory(u[:, None], 10.0 * noisy + 3.0, 0.1, f"run{seed}")


@pytest.fixture(scope="module")
def runs() -> list[Trajectory]:
    return [pendulum(length, i) for i, length in enumerate((150, 120, 100, 260))]


@pytest.fixture(scope="module")
def context() -> Context:
    outputs = Signal("angle"), Signal("rate")
    return Context((Signal("u"),), outputs, 0.1, n_past_u=1, n_past_y=1, horizon=HORIZON, seed=1)


def window_error(model: Model, context: Context, trajectory: Trajectory) -> Array:
    """Root mean square error (ny,) over windows, against the output's standard deviation."""
    starts = np.arange(4, len(trajectory) - HORIZON, HORIZON)
    rows = starts[:, None] + np.arange(HORIZON)
    past_u = trajectory.u[starts[:, None] + np.arange(-context.n_past_u, 0)]
    past_y = trajectory.y[starts[:, None] + np.arange(-context.n_past_y, 0)]
    y = model.simulate(past_u, past_y, trajectory.u[rows])
    error = np.sqrt(((y - trajectory.y[rows]) ** 2).mean(axis=(0, 1)))
    return error / trajectory.y.std(axis=0)


@pytest.mark.long
def test_unstable_system_is_followed_over_the_horizon(runs, context):
    logged: list[float] = []
    watched = replace(context, log=lambda _, loss: logged.append(loss))
    model = linear.build(linear.Config(delay=None), context)
    model = linear.train(model, runs[:3], watched, LevenbergMarquardt(30))
    assert model.fitted is not None
    assert model.fitted.system.radius > 1.0
    assert window_error(model, context, runs[3]).max() < 0.15
    assert logged


@pytest.mark.long
def test_the_state_may_hold_several_past_samples(runs, context):
    angle = [Trajectory(t.u, t.y[:, :1], 0.1, t.name) for t in runs]
    context = replace(context, outputs=context.outputs[:1], n_past_u=3, n_past_y=4)
    model = linear.train(linear.build(linear.Config(), context), angle[:3], context)
    assert model.fitted is not None
    assert model.fitted.system.order > 2
    assert window_error(model, context, angle[3]).max() < 0.35


@pytest.mark.parametrize(
    "method", [LevenbergMarquardt(6), Adam(steps=40, learning_rate=1e-3)], ids=["lm", "adam"]
)
@pytest.mark.slow
def test_neural_state_space_keeps_the_past_window_as_its_state(runs, context, method):
    model = neural_ss.build(neural_ss.Config(hidden=3), context)
    model = neural_ss.train(model, runs[:3], context, method)
    assert model.fitted is not None
    assert model.fitted.structure.lags is not None
    assert window_error(model, context, runs[3]).max() < 0.15


def test_neural_state_space_starts_as_the_windowed_linear_model(runs, context):
    records = scaled(runs, Scaling.of(runs))
    windows, lags = cut_windows(records, context, 10), WindowLags(1, 1, 1, 1, 1, 2)
    line = one_step(windows, lags, 1e-6)
    structure = StateSpaceStructure(lags.order, 1, 2, "state", "tanh", 3, 3, None, lags)
    params = structure.start_windowed(line, np.random.default_rng(0))
    _, y = structure.simulate(params, lags.state(windows.window), windows.u)
    np.testing.assert_allclose(y, line.simulate(windows), atol=1e-12)


def test_state_space_form_is_the_predictor(runs, context):
    records = scaled(runs, Scaling.of(runs))
    context = replace(context, n_past_u=2, n_past_y=3)
    windows = cut_windows(records, context, 40)
    model = one_step(windows, WindowLags(2, 3, 1, 2, 1, 2), 1e-6)
    system, encoder = model.system()
    _, y = system.simulate(encoder(windows.window), windows.u)
    np.testing.assert_allclose(y, model.simulate(windows), atol=1e-9)


def test_refinement_lowers_the_error_over_the_horizon_and_a_great_ridge_holds(runs, context):
    records = scaled(runs, Scaling.of(runs))
    windows = cut_windows(records, context, 60)
    lags = WindowLags(1, 1, 1, 1, 1, 2)
    start = WindowPredictor(lags, held(lags))
    better = refined(start, windows, 1e-6, 20, 1e-6)
    assert better.error(windows) < 0.2 * start.error(windows)
    stuck = refined(start, windows, 1e6, 20, 1e-9)
    np.testing.assert_allclose(stuck.theta, start.theta, atol=1e-4)


@pytest.mark.parametrize("sizes", [(2, 3, 2, 2, 9), (1, 1, 3, 2, 1), (2, 2, 0, 1, 6)])
def test_normal_equations_are_the_same_by_lags_and_by_steps(sizes):
    nu, ny, past_u, past_y, samples = sizes
    rng, lags = np.random.default_rng(0), WindowLags(past_u, past_y, past_u, past_y, nu, ny)
    features, u, y = (
        rng.standard_normal((7, *shape))
        for shape in ((past_u * nu + past_y * ny,), (samples, nu), (samples, ny))
    )
    theta = 0.1 * rng.standard_normal((lags.order + nu + 1, ny))
    model, windows = WindowPredictor(lags, theta), SegmentBatch(features, u, y, np.ones_like(y))
    for one, other in zip(
        normal_by_lags(model, windows), normal_by_steps(model, windows), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-12)
    # The gradient of half the squared error, by differences.
    _, gradient = normal_by_lags(model, windows)
    moved = WindowPredictor(lags, theta + 1e-6)
    change = (moved.error(windows) - model.error(windows)) * y.size / 2
    assert change == pytest.approx(-1e-6 * gradient.sum(), rel=1e-3)


def test_windows_are_bounded_in_number_and_come_from_every_record(runs, context):
    records = scaled(runs, Scaling.of(runs))
    windows = cut_windows(records, context, 20)
    assert isinstance(windows, SegmentBatch)
    assert 15 <= len(windows.u) <= 24
    assert windows.u.shape[1:] == (HORIZON, 1)
    for record in records:
        firsts = record.y[1 : len(record) - HORIZON + 1]
        assert any((firsts == first).all(axis=1).any() for first in windows.y[:, 0])
    # The past window is the sample before the first simulated one.
    before = _first(records[0].y, windows) - 1
    np.testing.assert_array_equal(windows.window[0, 1:], records[0].y[before])


def _first(y: Array, windows: SegmentBatch) -> int:
    return int(np.flatnonzero((y == windows.y[0, 0]).all(axis=1))[0])


def test_a_horizon_longer_than_all_records_takes_what_there_is(runs, context):
    records = scaled(runs, Scaling.of(runs))
    windows = cut_windows(records, replace(context, horizon=10_000), 20)
    assert windows.u.shape == (1, 259, 1)


def test_stretches_keep_their_number_of_samples_and_are_spread(runs):
    records = scaled(runs, Scaling.of(runs))
    assert stretches(records, 5000, 50) == records
    parts = stretches(records, 250, 20)
    assert 200 <= sum(len(p) for p in parts) <= 300
    assert min(len(p) for p in parts) >= 20
    assert any((p.y[-1] == records[0].y[-1]).all() for p in parts)
