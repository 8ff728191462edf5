"""Gaussian-process NARX models."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import check_grad

from asia.errors import UserError
from asia.models import gp_narx, linear
from asia.models.methods import MarginalLikelihood
from tests.unit.models.systems.black_box import case, filtered
from tests.unit.models.systems.fitting import (
    against_holding,
    fitted,
    from_short_past,
    rectifying,
    short_past,
)

QUICK = MarginalLikelihood(iterations=20, points=120)


@pytest.mark.slow
def test_half_the_error_of_the_best_linear_model() -> None:
    data = case(rectifying, noise=0.01)
    line = fitted(linear, linear.Config(), data, None)
    model = fitted(gp_narx, gp_narx.Config(2, 2), data, QUICK)
    assert data.ratio(model) < 0.5 * data.ratio(line)


def test_gradient_of_the_evidence() -> None:
    rng = np.random.default_rng(0)
    x, theta = rng.standard_normal((25, 3)), 0.3 * rng.standard_normal(5)
    y = np.sin(x[:, 0])
    error = check_grad(
        lambda t: gp_narx.negative_log_evidence(t, x, y)[0],
        lambda t: gp_narx.negative_log_evidence(t, x, y)[1],
        theta,
    )
    assert error < 1e-5


def test_evidence_tells_which_regressor_matters() -> None:
    rng = np.random.default_rng(1)
    x = rng.standard_normal((80, 2))
    y = np.sin(2 * x[:, 0])
    theta, _ = gp_narx._hyper(x, y / y.std(), MarginalLikelihood(40))
    assert theta[1] > theta[0] + 2


def test_past_window_shorter_than_the_lags_and_few_points() -> None:
    data = short_past(case(filtered, noise=0.01))
    model = fitted(gp_narx, gp_narx.Config(2, 2, 1, points=60), data, QUICK)
    y = from_short_past(model, data)
    assert np.abs(y - data.truth[1:])[30:].max() < 0.3 * data.truth.std()


@pytest.mark.slow
@pytest.mark.parametrize("mean", ["linear", "hold"])
def test_windows_from_one_measured_state(mean: str) -> None:
    config = gp_narx.Config(1, 1, mean=mean)  # type: ignore[arg-type]
    assert against_holding(gp_narx, config, QUICK) < 0.3


def test_bad_settings_are_refused() -> None:
    with pytest.raises(UserError, match="mean"):
        gp_narx.Config(mean="zero")  # type: ignore[arg-type]
