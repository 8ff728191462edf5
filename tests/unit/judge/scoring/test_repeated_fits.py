"""The statistics of a confirmation, against closed forms, laws and simulations with known truth."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from asia.data import Array
from asia.errors import InternalError
from asia.judge.scoring.repeated_fits import (
    RepeatedFits,
    block_values,
    corrected_level,
    expected_error,
    expected_lowest,
    expected_of_ensemble,
    noise_of_seeds,
    paired_difference,
    selection_optimism,
    value_interval,
)


def fits(blocks: Array) -> RepeatedFits:
    """Make fits from blocks (seeds, folds, blocks), whose means are the values."""
    return RepeatedFits(blocks.mean(axis=2), blocks)


def test_with_one_seed_the_difference_is_the_paired_t_interval() -> None:
    random = np.random.default_rng(0)
    a, b = random.normal(1.0, 0.2, (1, 2, 8)), random.normal(1.1, 0.2, (1, 2, 8))
    found = paired_difference(fits(a), fits(b), 0.95)
    known = stats.ttest_rel(a.ravel(), b.ravel()).confidence_interval(0.95)
    assert found.value == pytest.approx(a.mean() - b.mean())
    assert (found.low, found.high) == pytest.approx((known.low, known.high))


def test_where_blocks_agree_the_difference_is_the_paired_t_interval_over_seeds() -> None:
    random = np.random.default_rng(1)
    a, b = random.normal(1.0, 0.2, 5), random.normal(1.0, 0.2, 5)
    grid = np.ones((1, 2, 8))
    found = paired_difference(fits(a[:, None, None] * grid), fits(b[:, None, None] * grid), 0.9)
    known = stats.ttest_rel(a, b).confidence_interval(0.9)
    assert (found.low, found.high) == pytest.approx((known.low, known.high))


def test_a_candidate_whose_fits_do_not_depend_on_the_seed_is_paired_with_all_of_another() -> None:
    random = np.random.default_rng(2)
    values = random.normal(1.0, 0.1, 5)
    grid = np.ones((1, 2, 4))
    fixed, free = fits(0.5 * grid), fits(values[:, None, None] * grid)
    found = paired_difference(fixed, free, 0.95)
    known = stats.ttest_1samp(0.5 - values, 0.0).confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx((known.low, known.high))


@given(st.integers(0, 10_000), st.floats(0.1, 10.0))
@settings(max_examples=30, deadline=None)
def test_a_difference_turns_with_its_sides_and_scales_with_the_unit(seed: int, by: float) -> None:
    random = np.random.default_rng(seed)
    a, b = random.uniform(0.5, 2.0, (2, 3, 2, 8))
    there, back = (
        paired_difference(fits(a), fits(b), 0.95),
        paired_difference(fits(b), fits(a), 0.95),
    )
    assert (there.low, there.high) == pytest.approx((-back.high, -back.low))
    scaled = paired_difference(fits(by * a), fits(by * b), 0.95)
    assert scaled.low == pytest.approx(by * there.low, abs=1e-12)
    same = paired_difference(fits(a), fits(a), 0.95)
    assert same.low == same.value == same.high == 0.0


@given(st.integers(1, 60))
@settings(max_examples=20, deadline=None)
def test_more_comparisons_ask_for_wider_intervals(count: int) -> None:
    assert corrected_level(0.95, count) <= corrected_level(0.95, count + 1) < 1.0
    assert 1 - corrected_level(0.95, count) == pytest.approx(0.05 / count)


def test_intervals_of_equal_candidates_hold_zero_as_often_as_they_say() -> None:
    random = np.random.default_rng(3)
    held = 0
    for _ in range(600):
        shared = random.normal(1.0, 0.3, (1, 2, 8))
        luck = random.normal(0.0, 0.05, (2, 4, 1, 1))
        own = random.normal(0.0, 0.1, (2, 1, 2, 8))
        one, other = (shared + own[i] + luck[i] for i in (0, 1))
        found = paired_difference(fits(one), fits(other), 0.9)
        held += found.low <= 0.0 <= found.high
    # 99.9 % of counts with probability 0.9 to 0.93 lie inside.
    assert 0.86 <= held / 600 <= 0.97


def test_the_value_is_inside_its_interval_and_the_noise_is_that_of_the_seeds() -> None:
    random = np.random.default_rng(4)
    luck = random.normal(0.0, 0.05, (400, 1, 1))
    one = fits(1.0 + luck + np.zeros((1, 2, 8)))
    interval = value_interval(one, 0.95)
    assert interval.low < interval.value < interval.high
    assert one.spread == pytest.approx(0.05, rel=0.1)
    assert noise_of_seeds([one, fits(np.ones((1, 2, 8)))]) == one.spread
    assert noise_of_seeds([fits(np.ones((1, 2, 8)))]) is None


def test_block_values_are_exact_for_a_mean_and_near_for_a_root() -> None:
    random = np.random.default_rng(5)
    y, scale = random.normal(size=(800, 1)), np.array([2.0])
    y_hat = y + 0.3 * random.normal(size=y.shape)
    mae = block_values([y[:300], y[300:]], [y_hat[:300], y_hat[300:]], scale, "mae")
    parts = np.abs(y - y_hat).reshape(8, 100).mean(axis=1) / 2.0
    assert mae == pytest.approx(parts)
    rmse = block_values([y], [y_hat], scale, "rmse")
    whole = math.sqrt(float(np.mean((y - y_hat) ** 2))) / 2.0
    assert rmse.mean() == pytest.approx(whole, rel=2e-3)
    assert len(block_values([y[:5]], [y_hat[:5]], scale, "rmse")) == 5


@pytest.mark.slow
def test_the_optimism_of_equal_candidates_is_that_of_the_lowest_of_random_values() -> None:
    random = np.random.default_rng(6)
    number, found = 20, []
    for k in range(30):
        tried = random.normal(1.0, 0.2, (number, 2, 8))
        found.append(selection_optimism(tried, k))
    luck = -expected_lowest(number) * 0.2 / 4.0
    assert np.mean(found) == pytest.approx(luck, rel=0.25)
    apart = np.array([1.0, 2.0, 3.0])[:, None, None] + np.zeros((3, 2, 8))
    assert selection_optimism(apart, 0) == pytest.approx(0.0, abs=1e-12)
    assert selection_optimism(tried[:1], 0) == 0.0


def test_the_lowest_of_normal_numbers() -> None:
    assert expected_lowest(1) == pytest.approx(0.0, abs=1e-6)
    assert expected_lowest(2) == pytest.approx(-1.0 / math.sqrt(math.pi), abs=1e-5)
    assert expected_lowest(3) == pytest.approx(-1.5 / math.sqrt(math.pi), abs=1e-5)


@pytest.mark.long
def test_the_interval_for_a_new_record_holds_it_as_often_as_it_says() -> None:
    random = np.random.default_rng(7)
    held = []
    for k in range(300):
        hard = random.normal(0.0, 0.15, (1, 2, 8))
        skill = random.uniform(0.0, 0.1, (12, 1, 1))
        tried = 1.0 + skill + hard + random.normal(0.0, 0.1, (12, 2, 8))
        chosen = int(np.argmin(tried.mean(axis=(1, 2))))
        expected = expected_error(fits(tried[chosen][None]), tried, 0.9, k)
        new = 1.0 + skill[chosen, 0, 0] + random.normal(0.0, math.hypot(0.15, 0.1), 8).mean()
        held.append(expected.low <= new <= expected.high)
        assert expected.low < expected.value < expected.high
    assert 0.83 <= np.mean(held) <= 0.97


def test_an_ensemble_is_expected_to_be_better_by_the_disagreement_of_its_members() -> None:
    """Members with independent errors of the same size: their mean has 1 / sqrt(K) of it."""
    random = np.random.default_rng(8)
    blocks = 1.0 + random.normal(0.0, 0.1, (1, 2, 8))
    expected = expected_error(fits(blocks), blocks, 0.9, 0)
    found = expected_of_ensemble(expected, (1.0, 1.0, 1.0, 1.0), 0.5)
    assert (found.value, found.low, found.high) == (
        expected.value / 2,
        expected.low / 2,
        expected.high / 2,
    )
    assert expected_of_ensemble(expected, (1.0, 1.0), 1.2).value == expected.value
    assert expected_of_ensemble(expected, (0.0, 0.0), 0.0).value == expected.value


def test_the_interval_is_a_point_where_nothing_varies() -> None:
    expected = expected_error(fits(np.ones((1, 2, 8))), np.ones((1, 2, 8)), 0.9, 0)
    assert expected.low == expected.value == expected.high == 1.0


def test_fits_of_another_shape_are_refused() -> None:
    with pytest.raises(InternalError, match="with blocks"):
        RepeatedFits(np.ones((2, 2)), np.ones((3, 2, 8)))
