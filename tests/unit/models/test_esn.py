"""Echo state networks."""

from __future__ import annotations

import numpy as np
import pytest

from asia.errors import UserError
from asia.models import esn, linear
from asia.models.methods import LeastSquares
from tests.unit.models.systems.black_box import case, filtered
from tests.unit.models.systems.fitting import (
    against_holding,
    fitted,
    from_short_past,
    rectifying,
    short_past,
)

SMALL = esn.Config(units=40, members=2, longest=10.0)


@pytest.mark.slow
def test_half_the_error_of_the_best_linear_model() -> None:
    data = case(rectifying, noise=0.01)
    line = fitted(linear, linear.Config(order=2), data, None)
    model = fitted(esn, esn.Config(longest=10.0), data, LeastSquares())
    assert data.ratio(model) < 0.5 * data.ratio(line)


@pytest.mark.slow
def test_past_window_sets_the_state_of_the_reservoir() -> None:
    data = case(filtered, noise=0.01)
    model = fitted(esn, esn.Config(longest=10.0), data, LeastSquares())
    first = np.abs(data.simulated(model)[:10] - data.truth[8:18]).max()
    assert first < 0.3 * data.truth.std()


def test_short_past_window_and_short_record() -> None:
    data = short_past(case(filtered, lengths=(60,)))
    y = from_short_past(fitted(esn, SMALL, data, LeastSquares()), data)
    assert np.isfinite(y).all()
    assert np.std(y) > 0


def test_windows_from_one_measured_state() -> None:
    assert against_holding(esn, SMALL, LeastSquares()) < 0.5


def test_given_ridge_shrinks_the_readout() -> None:
    data = case(filtered)
    sizes = [
        np.abs(fitted(esn, SMALL, data, LeastSquares(r)).fitted.members[0].readout.weights).sum()
        for r in (1e-6, 1.0)
    ]
    assert sizes[1] < 0.5 * sizes[0]


def test_bad_settings_are_refused() -> None:
    with pytest.raises(UserError, match="density"):
        esn.Config(density=0.0)
