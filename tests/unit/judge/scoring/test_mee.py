"""The table of Mean Euclidean Errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from asia.errors import CandidateError, InternalError, Reason
from asia.judge.scoring.euclidean_error import GroupError, geodesic, mee_table, rotation
from asia.problem.protocol import OutputGroup

angle = st.floats(-3.1, 3.1)
angles = st.tuples(angle, st.floats(-1.5, 1.5), angle).map(np.array)


@given(angles)
def test_rotations_are_those_of_yaw_then_pitch_then_roll(a: np.ndarray) -> None:
    expected = Rotation.from_euler("ZYX", a[::-1]).as_matrix()
    assert np.allclose(rotation(a), expected, atol=1e-12)


@given(angles, angles)
def test_geodesic_distance_is_the_angle_between_two_attitudes(a: np.ndarray, b: np.ndarray) -> None:
    one, two = (Rotation.from_euler("ZYX", x[::-1]) for x in (a, b))
    assert geodesic(a, b) == pytest.approx((one.inv() * two).magnitude(), abs=1e-7)
    assert geodesic(a, b) == pytest.approx(geodesic(b, a), abs=1e-12)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-9, 1e-5, np.pi - 1e-9, np.pi])
def test_small_and_half_turns_keep_their_digits(size: float) -> None:
    base = np.array([0.3, 0.0, 0.0])
    assert geodesic(base, base + np.array([size, 0.0, 0.0])) == pytest.approx(
        size, rel=1e-6, abs=1e-15
    )


def test_a_turn_of_yaw_across_pi_is_small() -> None:
    a, b = np.array([0.0, 0.0, np.pi - 0.01]), np.array([0.0, 0.0, -np.pi + 0.01])
    assert geodesic(a, b) == pytest.approx(0.02)


def test_steps_are_averaged_over_windows_and_summed() -> None:
    y = [np.zeros((3, 4)), np.zeros((3, 4))]
    y_hat = [np.zeros((3, 4)), np.zeros((3, 4))]
    y_hat[0][:, :2] = [[3, 4], [6, 8], [0, 0]]
    y_hat[1][2, 2] = 1.0
    groups = (OutputGroup("late", ("c",)), OutputGroup("p", ("a", "b")))
    table = mee_table(y, y_hat, ["a", "b", "c", "d"], groups, (1, 3))
    assert table.horizons == (1, 3)
    late, p = table.groups
    assert (late.name, late.steps, late.total) == ("late", (0.0, 0.0, 0.5), 0.5)
    assert p.steps == (2.5, 5.0, 0.0)
    assert (p.at(1), p.at(2), p.total) == (2.5, 5.0, 7.5)
    assert mee_table(y, y_hat, ["a", "b", "c", "d"], groups, ()).horizons == (3,)


def test_a_simulation_that_ran_away_is_the_candidates_failure() -> None:
    y, group = [np.zeros((2, 1))], (OutputGroup("p", ("a",)),)
    with pytest.raises(CandidateError) as caught:
        mee_table(y, [np.full((2, 1), np.nan)], ["a"], group, ())
    assert caught.value.reason is Reason.NOT_FINITE
    with pytest.raises(CandidateError):
        mee_table(y, [np.zeros((1, 1))], ["a"], group, ())
    with pytest.raises(InternalError):
        GroupError("p", (0.0, float("nan")))
