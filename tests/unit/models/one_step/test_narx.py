"""Polynomial NARX models."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asia.data import Array, Trajectory
from asia.errors import UserError
from asia.models import linear, narx
from asia.models._least_squares import LevenbergMarquardt
from asia.models.methods import LeastSquares
from tests.unit.models.systems.black_box import case, filtered
from tests.unit.models.systems.fitting import (
    against_holding,
    fitted,
    from_short_past,
    short_past,
)


def bilinear(u: Array) -> Array:
    """y[k] = 0.6 y[k-1] - 0.1 y[k-2] + 0.4 u[k-1] + 0.15 u[k-1]^2 - 0.1 y[k-1] u[k-2]."""
    y = np.zeros((len(u), 1))
    for k in range(2, len(u)):
        line = 0.6 * y[k - 1] - 0.1 * y[k - 2] + 0.4 * u[k - 1]
        y[k] = line + 0.15 * u[k - 1] ** 2 - 0.1 * y[k - 1] * u[k - 2]
    return y


def test_own_system_is_simulated_below_the_noise() -> None:
    data = case(bilinear)
    line = fitted(linear, linear.Config(order=2), data, None)
    model = fitted(narx, narx.Config(2, 3), data, LevenbergMarquardt(30))
    assert data.ratio(model) < min(0.5, 0.3 * data.ratio(line))


def test_terms_come_in_the_order_of_their_error_reduction() -> None:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((400, 6))
    x[:, 3] = x[:, 1] + 1e-7 * x[:, 3]
    y = 3.0 * x[:, 1] + 1.0 * x[:, 4] - 0.3 * x[:, 0]
    order = narx.error_reduction_order(x.T @ x, x.T @ y, 5)
    assert order[0] in (1, 3)
    assert order[1:3] == [4, 0]
    assert not {1, 3} <= set(order)


def test_noise_free_terms_are_found_exactly() -> None:
    data = case(bilinear, noise=0.0)
    model = fitted(narx, narx.Config(2, 3, terms=9), data, LeastSquares(0.0))
    error = data.simulated(model) - data.truth[8:]
    assert np.abs(error).max() < 1e-3 * data.truth.std()


def test_free_run_stays_within_the_margin() -> None:
    data = case(bilinear)
    config = narx.Config(2, 3, degree=3, terms=12, margin=0.1)
    model = fitted(narx, config, data, LeastSquares(0.0))
    loud = replace(data, unseen=Trajectory(50 * data.unseen.u, data.unseen.y, 1.0))
    y, seen = loud.simulated(model), data.training[0].y
    width = float(np.ptp(seen))
    assert y.max() <= seen.max() + 0.1001 * width
    assert y.min() >= seen.min() - 0.1001 * width
    assert np.ptp(y) > 0


def without(record: Trajectory, share: float, seed: int) -> Trajectory:
    y = record.y.copy()
    y[10:][np.random.default_rng(seed).random(y[10:].shape) < share] = np.nan
    return replace(record, y=y)


@pytest.mark.slow
def test_records_with_gaps_give_nearly_the_model_of_whole_ones() -> None:
    data = case(bilinear)
    lost = replace(data, training=tuple(without(r, 0.5, k) for k, r in enumerate(data.training)))
    config, method = narx.Config(2, 3, max_terms=9), LevenbergMarquardt(10)
    whole, gaps = (d.ratio(fitted(narx, config, d, method)) for d in (data, lost))
    assert gaps < 1.5 * whole


def test_past_window_shorter_than_the_lags() -> None:
    data = short_past(case(filtered, noise=0.01))
    model = fitted(narx, narx.Config(3, 3), data, LevenbergMarquardt(10))
    y = from_short_past(model, data)
    assert np.abs(y - data.truth[1:])[30:].max() < 0.1 * data.truth.std()


def test_windows_from_one_measured_state() -> None:
    config = narx.Config(1, 1, degree=3)
    assert against_holding(narx, config, LevenbergMarquardt(10)) < 0.3


def test_bad_settings_are_refused() -> None:
    with pytest.raises(UserError, match="at least 1"):
        narx.Config(degree=0)
