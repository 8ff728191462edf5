"""ARX and output-error models."""

from __future__ import annotations

import numpy as np
import pytest

from asia.errors import UserError
from asia.models import arx
from asia.models._least_squares import LevenbergMarquardt
from asia.models._numerics.lags import Lags, OutputRange, fit_history
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.segments import segments, simulation_error
from asia.models._numerics.training_records import scaled
from asia.models._one_step import Polynomial, PolynomialRun, _normal, all_terms
from asia.models.methods import LeastSquares
from tests.unit.models.systems.black_box import case, filtered, late, two_by_two
from tests.unit.models.systems.fitting import (
    against_holding,
    fitted,
    from_short_past,
    short_past,
)

OE = arx.Config(na=2, nb=2, delay=1)


def test_output_error_model_simulates_below_the_noise_where_arx_is_biased() -> None:
    data = case(filtered, noise=0.2)
    biased = fitted(arx, arx.Config(2, 2, 1, "arx"), data, LeastSquares(0.0))
    model = fitted(arx, OE, data, LevenbergMarquardt(30))
    assert data.ratio(model) < 0.3
    assert data.ratio(model) < 0.5 * data.ratio(biased)


@pytest.mark.slow
def test_lags_and_delay_are_chosen() -> None:
    data = case(late)
    model = fitted(arx, arx.Config(delay=None, structure="arx"), data, LeastSquares())
    assert model.run.history.lags.delay in (5, 6)
    assert data.ratio(model) < 0.4


def test_two_inputs_and_outputs_from_records_of_unequal_length() -> None:
    data = case(two_by_two, channels=2, lengths=(250, 120, 60))
    assert data.ratio(fitted(arx, arx.Config(3, 3), data, LevenbergMarquardt(15))) < 0.8


def test_past_window_shorter_than_the_lags() -> None:
    data = short_past(case(filtered, noise=0.01))
    for config, method in ((OE, LevenbergMarquardt(10)), (arx.Config(4, 4, 1, "arx"), None)):
        y = from_short_past(fitted(arx, config, data, method or LeastSquares()), data)
        assert np.abs(y - data.truth[1:])[30:].max() < 0.1 * data.truth.std()


def test_gradient_is_that_of_the_simulation_error() -> None:
    data = case(filtered, lengths=(60,))
    records = scaled(data.training, Scaling.of(data.training))
    lags = Lags(2, 2, 1)
    terms = all_terms(4, 2)
    rng = np.random.default_rng(0)
    theta = 0.1 * rng.standard_normal((len(terms), 1))
    used = np.ones(theta.shape, bool)
    history, limits = fit_history(records, lags, data.context), OutputRange.of(records, 5.0)
    stretch = segments(records, data.context)
    assert stretch is not None

    def error(theta: np.ndarray) -> float:
        return simulation_error(
            PolynomialRun(Polynomial(terms, theta, used), history, limits), stretch
        )

    run = PolynomialRun(Polynomial(terms, theta, used), history, limits)
    gradient = 2 * _normal(run, run.one_step, stretch)[1]
    steps = 1e-6 * np.eye(len(terms))[:, :, None]
    numeric = [(error(theta + s) - error(theta - s)) / 2e-6 for s in steps]
    np.testing.assert_allclose(gradient, numeric, rtol=1e-5, atol=1e-7)


def test_windows_from_one_measured_state() -> None:
    assert against_holding(arx, arx.Config(1, 1), LevenbergMarquardt(10)) < 0.5
    assert against_holding(arx, arx.Config(structure="arx"), LeastSquares()) < 0.5


def test_bad_settings_are_refused() -> None:
    data = case(filtered)
    with pytest.raises(UserError, match="LevenbergMarquardt"):
        fitted(arx, OE, data, LeastSquares())
    with pytest.raises(UserError, match="structure"):
        arx.Config(structure="armax")  # type: ignore[arg-type]
    with pytest.raises(UserError, match="fewer lags"):
        fitted(arx, arx.Config(500, 1, 0, "arx"), data, LeastSquares(0.0))
    with pytest.raises(UserError, match="not trained"):
        data.simulated(arx.build(OE, data.context))
