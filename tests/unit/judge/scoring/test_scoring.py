import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asia.errors import CandidateError, InternalError, Reason
from asia.judge.scoring.outcome import FoldRecord, Score, combine, fit_index, score_fold, score_test
from asia.judge.scoring.residuals import diagnose


def made(seed: int, length: int = 60, channels: int = 2) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    y = rng.normal(size=(length, channels))
    return y, y + 0.1 * rng.normal(size=y.shape)


def test_v_is_the_mean_over_channels_of_the_normalised_pooled_rmse() -> None:
    a, a_hat = made(0, 40)
    b, b_hat = made(1, 70)
    scale = np.array([2.0, 0.5])
    score = score_fold([a, b], [a_hat, b_hat], scale, "rmse")
    errors = np.concatenate([a - a_hat, b - b_hat])
    expected = np.mean([math.sqrt(np.mean(errors[:, c] ** 2)) / scale[c] for c in (0, 1)])
    assert score.value == pytest.approx(expected, rel=1e-12)


@given(factor=st.floats(0.01, 100.0), seed=st.integers(0, 50))
def test_v_does_not_depend_on_units(factor: float, seed: int) -> None:
    y, y_hat = made(seed)
    scale = y.std(axis=0)
    plain = score_fold([y], [y_hat], scale, "mae").value
    scaled = score_fold([factor * y], [factor * y_hat], factor * scale, "mae").value
    assert scaled == pytest.approx(plain, rel=1e-9)


def test_fit_index_of_the_mean_is_zero_and_of_the_truth_a_hundred() -> None:
    y, _ = made(3)
    assert np.allclose(fit_index(y, np.tile(y.mean(axis=0), (len(y), 1))), 0.0)
    assert np.allclose(fit_index(y, y), 100.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_one_bad_sample_is_a_failure(bad: float) -> None:
    y, y_hat = made(0)
    y_hat[7, 1] = bad
    with pytest.raises(CandidateError) as caught:
        score_fold([y], [y_hat], np.ones(2), "rmse")
    assert caught.value.reason is Reason.NOT_FINITE


def test_a_short_reply_is_a_failure() -> None:
    y, y_hat = made(0)
    with pytest.raises(CandidateError) as caught:
        score_fold([y], [y_hat[:-1]], np.ones(2), "rmse")
    assert caught.value.reason is Reason.WRONG_LENGTH


def test_a_score_that_is_not_finite_cannot_exist() -> None:
    with pytest.raises(InternalError):
        FoldRecord(math.nan, (), (), (), ())
    with pytest.raises(InternalError):
        FoldRecord(1.0, (1.0,), (1.0,), (-math.inf,), (0.5,))
    with pytest.raises(InternalError):
        Score(math.inf, ())


def test_a_held_out_output_at_rest_has_an_error_but_no_fit_index() -> None:
    y, y_hat = made(0)
    y[:, 1] = 3.0
    score = combine([score_fold([y], [y_hat], np.ones(2), "rmse")])
    assert score.folds[0].fit_index[1] is None
    assert score.folds[0].r2[1] is None
    assert score.folds[0].worst_fit == score.folds[0].fit_index[0]
    assert score.folds[0].rmse[1] > 0


def test_residuals_too_large_to_analyse_are_a_failure() -> None:
    y, _ = made(0)
    with pytest.raises(CandidateError):
        diagnose([y], [y], [y + 1e99], np.full(2, 1e-120), 1.0)


def test_test_score_is_pooled_and_skips() -> None:
    y = [np.zeros((5, 1)), np.zeros((3, 1))]
    y_hat = [np.array([[9.0], [9.0], [1.0], [1.0], [1.0]]), np.array([[9.0], [9.0], [2.0]])]
    score = score_test(y, y_hat, "rmse", skip=2)
    assert score.value == pytest.approx(math.sqrt(7 / 4))
    assert score.per_trajectory == pytest.approx((1.0, 2.0))


def test_diagnostics_see_planted_defects() -> None:
    rng = np.random.default_rng(0)
    u = rng.normal(size=(2000, 1))
    y = np.cumsum(rng.normal(size=(2000, 1)), axis=0)
    white = rng.normal(size=y.shape)
    scale = np.ones(1)
    clean = diagnose([u], [y], [y - white], scale, 1.0)
    assert clean.whiteness < 0.1
    assert clean.input_correlation < 0.1
    late = diagnose([u], [y], [y - white - np.roll(u, 3, axis=0)], scale, 1.0)
    assert late.input_correlation > 0.5
    biased = diagnose([u], [y], [y - white - 2.0], scale, 1.0)
    assert biased.bias == pytest.approx(2.0, abs=0.1)
    high = y >= np.quantile(y, 0.9)
    top = diagnose([u], [y], [y - white - 5.0 * high], scale, 1.0)
    assert top.top_error > 2.0


def windows(values: np.ndarray, length: int) -> list[np.ndarray]:
    return list(values.reshape(-1, length, values.shape[-1]))


def test_diagnostics_of_many_windows_pool_the_pairs_inside_them() -> None:
    rng = np.random.default_rng(1)
    u, y, white = (rng.normal(size=(6000, 2)) for _ in range(3))
    scale = np.ones(2)
    parts = [windows(a, 30) for a in (u, y, y - white)]
    clean = diagnose(*parts, scale, 1.0)
    assert clean.whiteness < 0.1
    assert clean.input_correlation < 0.1
    held = np.repeat(rng.normal(size=(200, 2)), 30, axis=0)
    steady = diagnose(parts[0], parts[1], windows(y - held, 30), scale, 1.0)
    assert steady.whiteness > 0.99
    driven = diagnose(parts[0], parts[1], windows(y - np.roll(u, 2, axis=0), 30), scale, 1.0)
    assert driven.input_correlation > 0.9


def test_windows_of_one_sample_have_no_lag() -> None:
    y, y_hat = made(2, 40)
    single = diagnose(windows(y, 1), windows(y, 1), windows(y_hat, 1), np.ones(2), 1.0)
    assert single.whiteness == 0.0
    assert 0.0 < single.input_correlation <= 1.0
