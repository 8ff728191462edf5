"""Hammerstein, Wiener and Wiener-Hammerstein models."""

from __future__ import annotations

import numpy as np
import pytest

from asia.data import Array
from asia.errors import UserError
from asia.models import block_oriented, linear
from asia.models._least_squares import LevenbergMarquardt
from asia.models._linear.fit import Refinement
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import scaled
from asia.models._state_space.wiener_hammerstein import (
    WienerHammersteinStructure,
    wiener_hammerstein_starts,
)
from tests.unit.models.systems.black_box import case, filtered, wiener
from tests.unit.models.systems.fitting import fitted

LAG = np.array([[0.8]]), np.array([[0.4]]), np.array([[1.0]])


def wiener_hammerstein(u: Array) -> Array:
    return filtered(np.tanh(2 * filtered(u)), *LAG)


def hammerstein(u: Array) -> Array:
    return filtered(np.tanh(2 * u))


@pytest.mark.parametrize(
    ("structure", "system", "order"),
    [
        ("hammerstein", hammerstein, 2),
        pytest.param("wiener", wiener, 2, marks=pytest.mark.long),
        pytest.param("hammerstein_wiener", wiener, 2, marks=pytest.mark.long),
        ("wiener_hammerstein", wiener_hammerstein, 3),
    ],
)
@pytest.mark.slow
def test_own_system_is_simulated_below_the_noise(
    structure: str, system: object, order: int
) -> None:
    data = case(system, lengths=(600,))  # type: ignore[arg-type]
    config = block_oriented.Config(structure, order=order, hidden=4)  # type: ignore[arg-type]
    model = fitted(block_oriented, config, data, LevenbergMarquardt(40))
    line = fitted(linear, linear.Config(order=order), data, None)
    assert data.ratio(model) < min(0.66, 0.5 * data.ratio(line))


def test_poles_are_shared_out_as_they_are_in_the_system() -> None:
    data = case(wiener_hammerstein, lengths=(600,), noise=0.01)
    records = scaled(data.training, Scaling.of(data.training))
    found, _, used = linear.fit_records(records, data.context, linear.Config(order=3), Refinement())
    template = WienerHammersteinStructure(3, 1, 1, "state", "polynomial", 1, 5, None)
    starts = wiener_hammerstein_starts(used, found.system, template, np.random.default_rng(0), 3)
    assert starts[0].structure.first == 2
    assert [s.error for s in starts] == sorted(s.error for s in starts)
    x0 = np.zeros((1, 3))
    y = starts[0].structure.simulate(starts[0].params, x0, used[0].u[None])[1][0]
    assert ((y - used[0].y)[50:] ** 2).mean() == pytest.approx(starts[0].error, rel=1e-3)


def test_unknown_structure_is_refused() -> None:
    with pytest.raises(UserError, match="wiener_hammerstein"):
        block_oriented.Config("hammer")  # type: ignore[arg-type]


def asymmetric(u: Array) -> Array:
    """A lag that rings, a saturation on one side, and a lag with a zero."""
    v = 3.0 * filtered(u)
    low = filtered(-np.logaddexp(0.0, 1.0 - 4.0 * v) / 4.0, *LAG)
    return low - 0.4 * np.concatenate([np.zeros((1, 1)), low[:-1]])


@pytest.mark.long
def test_search_finds_order_and_shares_of_two_filters() -> None:
    data = case(asymmetric, lengths=(2000,), noise=0.01)
    config = block_oriented.Config(
        "wiener_hammerstein", hidden=10, ridge=1e-8, delay=None, searched=True
    )
    model = fitted(block_oriented, config, data, LevenbergMarquardt(30))
    line = fitted(linear, linear.Config(order=3), data, None)
    # The start from a past window of few samples is part of it.
    assert data.ratio(model) < 0.1 * data.ratio(line)
