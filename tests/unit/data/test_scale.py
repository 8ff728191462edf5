"""Signals in any unit: nothing depends on the unit that a signal is recorded in."""

import numpy as np
import pytest

from asia.data.frequency import find_period
from asia.data.trajectory import Trajectory, deviations, is_constant
from asia.lowering.linear import LinearModel
from asia.models._numerics.scaling import Scaling

SCALES = (1e-12, 1e-6, 1.0, 1e9, 1e12)


def record(scale: float) -> Trajectory:
    rng = np.random.default_rng(1)
    u = np.tile(rng.normal(size=(60, 1)), (4, 1))
    return Trajectory(scale * u, scale * (u + 3.0), 0.5, "record")


@pytest.mark.parametrize("scale", SCALES)
def test_deviations_and_periods_follow_the_unit(scale: float) -> None:
    one, other = record(1.0), record(scale)
    assert not is_constant(other.u)
    np.testing.assert_allclose(deviations(other.y), scale * deviations(one.y), rtol=1e-9)
    np.testing.assert_allclose(
        Scaling.of([other]).outputs(other.y), Scaling.of([one]).outputs(one.y), atol=1e-9
    )
    assert find_period([other]) == find_period([one]) == 60


def test_a_constant_signal_has_no_deviation_in_any_unit() -> None:
    for scale in SCALES:
        values = np.full((50, 1), 0.1 * scale)
        values[::2] = np.nextafter(values[::2], np.inf)
        assert is_constant(values)
        assert deviations(values).tolist() == [1.0]


@pytest.mark.parametrize("scale", SCALES)
def test_a_delay_does_not_depend_on_the_unit_of_one_channel(scale: float) -> None:
    a = np.diag([0.0, 0.7])
    a[1, 0] = 1.0
    b, c = np.array([[1.0, 0.0], [0.0, 1.0]]), np.array([[0.0, 1.0], [0.0, 1.0]])
    for rows, columns in (([scale, 1.0], [1.0, 1.0]), ([1.0, 1.0], [scale, 1.0])):
        model = LinearModel(
            a, b * columns, np.array(rows)[:, None] * c, np.zeros((2, 2)), 0.5,
            np.zeros(2), np.zeros(2),
        )  # fmt: skip
        assert model.delay.tolist() == [[2, 1], [2, 1]]


@pytest.mark.parametrize("scale", SCALES)
def test_an_integrator_does_not_depend_on_the_unit_of_time(scale: float) -> None:
    none = np.zeros((2, 0))
    a = np.array([[0.0, 1.0], [0.0, -1.0]]) * scale
    model = LinearModel(a, none, none.T, np.zeros((0, 0)), 0.0, none[0], none[0])
    assert [model.integrates(p) for p in model.poles] == [True, False]
    assert not model.is_unstable
