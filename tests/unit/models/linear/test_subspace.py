"""Starts of the linear fit."""

from __future__ import annotations

import numpy as np
import pytest

from asia.models._linear.fit import solve_linear_part, spread_poles, stabilised, starts
from asia.models._numerics.training_records import ScaledTrajectory
from tests.unit.models.systems.black_box import A, filtered


def record(length: int, noise: float = 0.0) -> ScaledTrajectory:
    rng = np.random.default_rng(5)
    u = rng.standard_normal((length, 1))
    y = filtered(u)
    y = y / y.std() + noise * rng.standard_normal(y.shape)
    return ScaledTrajectory(u, y, np.ones((length, 1)), u, np.ones((length, 1)))


def test_every_method_finds_the_poles_of_clean_data() -> None:
    found = starts([record(400)], max_order=4)
    assert len(found) == 3
    for method in found:
        pair = method.start(2)
        assert pair is not None
        poles = np.sort_complex(np.linalg.eigvals(pair[0]))
        np.testing.assert_allclose(poles, np.sort_complex(np.linalg.eigvals(A)), atol=0.02)


def test_records_too_short_for_hankel_matrices_give_fewer_starts() -> None:
    assert len(starts([record(12)], max_order=6)) < 3


def test_start_beyond_the_rank_is_none() -> None:
    assert starts([record(400)], max_order=4)[0].start(50) is None


@pytest.mark.parametrize("poles", [[1.2, 0.5], [0.999, -3.0], [0.5, 0.2]])
def test_stabilised_keeps_good_poles_and_moves_bad_ones(poles: list[float]) -> None:
    rng = np.random.default_rng(1)
    t = rng.standard_normal((2, 2))
    moved = np.linalg.eigvals(stabilised(t @ np.diag(poles) @ np.linalg.inv(t)))
    assert np.abs(moved).max() <= 0.995 + 1e-9
    for pole in poles:
        if abs(pole) < 0.9:
            assert np.abs(moved - pole).min() < 1e-6


def test_linear_part_is_exact_given_the_dynamics() -> None:
    data = record(200)
    pair = starts([data], max_order=4)[0].start(2)
    assert pair is not None
    assert solve_linear_part([data], *pair).error < 1e-6
    assert solve_linear_part([data], *spread_poles(2, 1)).error > 1e-3
