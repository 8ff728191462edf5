"""Hammerstein, Wiener and Wiener-Hammerstein models."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from asia.data import Array
from asia.errors import UserError
from asia.models import block_oriented, linear, neural_ss
from asia.models._least_squares import LevenbergMarquardt
from tests.unit.models.systems.black_box import case, filtered, two_by_two, wiener
from tests.unit.models.systems.fitting import fitted

LAG = np.array([[0.8]]), np.array([[0.4]]), np.array([[1.0]])


def wiener_hammerstein(u: Array) -> Array:
    return filtered(np.tanh(2 * filtered(u)), *LAG)


def hammerstein(u: Array) -> Array:
    return filtered(np.tanh(2 * u))


@pytest.mark.parametrize(
    ("family", "config", "system"),
    [
        (neural_ss, neural_ss.Config(order=2, nonlinearity="input", hidden=4), hammerstein),
        pytest.param(
            neural_ss, neural_ss.Config(order=2, nonlinearity="output", hidden=4), wiener,
            marks=pytest.mark.long,
        ),
        pytest.param(
            neural_ss, neural_ss.Config(order=2, nonlinearity="both", hidden=4), wiener,
            marks=pytest.mark.long,
        ),
        (block_oriented, block_oriented.Config(order=3, hidden=8), wiener_hammerstein),
    ],
)  # fmt: skip
@pytest.mark.slow
def test_own_system_is_simulated_below_the_noise(family: Any, config: Any, system: Any) -> None:
    data = case(system, lengths=(600,))
    model = fitted(family, config, data, LevenbergMarquardt(40))
    line = fitted(linear, linear.Config(order=config.order), data, None)
    assert data.ratio(model) < min(0.66, 0.5 * data.ratio(line))


def test_more_than_one_input_is_refused() -> None:
    data = case(two_by_two, channels=2)
    with pytest.raises(UserError, match="nl_lfr"):
        fitted(block_oriented, block_oriented.Config(), data, LevenbergMarquardt())


def asymmetric(u: Array) -> Array:
    """A lag that rings, a saturation on one side, and a lag with a zero."""
    v = 3.0 * filtered(u)
    low = filtered(-np.logaddexp(0.0, 1.0 - 4.0 * v) / 4.0, *LAG)
    return low - 0.4 * np.concatenate([np.zeros((1, 1)), low[:-1]])


@pytest.mark.long
def test_search_finds_order_and_shares_of_two_filters() -> None:
    data = case(asymmetric, lengths=(2000,), noise=0.01)
    config = block_oriented.Config(hidden=10, ridge=1e-8, delay=None)
    model = fitted(block_oriented, config, data, LevenbergMarquardt(30))
    line = fitted(linear, linear.Config(order=3), data, None)
    # The start from a past window of few samples is part of it.
    assert data.ratio(model) < 0.1 * data.ratio(line)
