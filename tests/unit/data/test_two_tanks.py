from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from asia.data.sources.simulated.two_tanks import NOISE_STD, _levels, simulate_two_tanks


def test_seed_and_realisation_fix_every_number() -> None:
    first, again = simulate_two_tanks(3, 0), simulate_two_tanks(3, 0)
    assert np.array_equal(first.y, again.y)
    assert np.array_equal(first.truth, again.truth)
    for other in (simulate_two_tanks(3, 1), simulate_two_tanks(4, 0)):
        assert not np.array_equal(first.u, other.u)
        assert not np.array_equal(first.y - first.truth, other.y - other.truth)


@pytest.mark.parametrize("seed", range(2))
def test_levels_stay_in_the_tanks(seed: int) -> None:
    record = simulate_two_tanks(seed, 0)
    assert record.u.shape == record.y.shape == record.truth.shape == (1024, 1)
    assert record.truth.min() >= 0
    assert record.truth.max() <= 10
    assert record.u.min() >= 0
    assert record.u.max() <= 7
    assert (record.y - record.truth).std() == pytest.approx(NOISE_STD, rel=0.1)


def test_overflow_matters() -> None:
    """The built-in records hold saturation of the lower tank in both parts."""
    assert all((simulate_two_tanks(5, part).truth >= 10).any() for part in (0, 1))


def test_constant_input_settles_where_inflow_equals_outflow() -> None:
    levels = _levels(np.full(800, 3.0), 2.0, 2.0)
    assert levels[-1] == pytest.approx((0.048 * 3.0 / 0.055) ** 2, rel=1e-6)


def test_overflow_of_the_upper_tank_fills_the_lower() -> None:
    levels = _levels(np.full(800, 6.0), 2.0, 2.0)
    assert levels[-1] == 10.0


def test_below_the_rim_the_equations_are_integrated() -> None:
    def slopes(_: float, x: np.ndarray) -> list[float]:
        return [-0.055 * x[0] ** 0.5 + 0.048 * 2.5, 0.050 * x[0] ** 0.5 - 0.050 * x[1] ** 0.5]

    time = 4.0 * np.arange(60)
    exact = solve_ivp(slopes, (0, time[-1]), [7.0, 3.0], t_eval=time, rtol=1e-10, atol=1e-10)
    assert np.allclose(_levels(np.full(60, 2.5), 7.0, 3.0), exact.y[1], atol=1e-6)
