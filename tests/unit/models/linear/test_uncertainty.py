"""The sandwich covariance, on regressions whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from asia.candidate import ParameterEstimate
from asia.data import Array
from asia.models import uncertainty

THETA = np.array([1.0, -0.5])
SAMPLES = 400


def regressors(rng: np.random.Generator) -> Array:
    slow = lfilter([1.0], [1.0, -0.9], rng.normal(size=SAMPLES + 100))[100:]
    return np.stack([slow, rng.normal(size=SAMPLES)], axis=1)


def coloured(rng: np.random.Generator, rho: float) -> Array:
    return lfilter([1.0], [1.0, -rho], rng.normal(size=SAMPLES + 200))[200:]


def report(theta: Array) -> list[ParameterEstimate]:
    return [ParameterEstimate(f"t{i}", v, 0, 0, 0) for i, v in enumerate(theta.tolist())]


def fit(x: Array, y: Array) -> tuple[Array, uncertainty.Covariance]:
    theta = np.linalg.lstsq(x, y)[0]
    return theta, uncertainty.sandwich([(x @ theta - y)[:, None]], [x[:, None]])


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_intervals_cover_the_truth_as_often_as_they_say(rho: float) -> None:
    rng, held = np.random.default_rng(1), []
    for _ in range(150):
        x = regressors(rng)
        theta, covariance = fit(x, x @ THETA + coloured(rng, rho))
        found = uncertainty.estimates(covariance, report, theta).parameters
        held += [one.low <= true <= one.high for one, true in zip(found, THETA, strict=True)]
    assert 0.90 < np.mean(held) < 0.98


def test_correlated_residuals_widen_the_error_of_a_slow_regressor_alone() -> None:
    """Against the formula for white noise, which an independent computation gives."""
    rng = np.random.default_rng(2)
    x = regressors(rng)
    y = x @ THETA + coloured(rng, 0.9)
    theta, covariance = fit(x, y)
    residual = y - x @ theta
    white = residual @ residual / (SAMPLES - 2) * np.linalg.inv(x.T @ x)
    ratio = np.sqrt(np.diagonal(covariance.matrix) / np.diagonal(white))
    assert ratio[0] > 2.0
    assert ratio[1] < 1.2


def test_under_white_noise_it_is_the_textbook_formula() -> None:
    rng = np.random.default_rng(3)
    x = regressors(rng)
    y = x @ THETA + rng.normal(size=SAMPLES)
    theta, covariance = fit(x, y)
    residual = y - x @ theta
    white = residual @ residual / (SAMPLES - 2) * np.linalg.inv(x.T @ x)
    np.testing.assert_allclose(covariance.matrix, white, rtol=0.2, atol=2e-4)


def test_unknowns_of_a_record_count_as_if_they_were_fitted() -> None:
    """Projected out, or estimated with the others: the same covariance."""
    rng = np.random.default_rng(4)
    x = regressors(rng)
    own = 0.99 ** np.arange(SAMPLES)[:, None]
    y = x @ THETA + 3 * own[:, 0] + rng.normal(size=SAMPLES)
    both = np.hstack([x, own])
    theta, joint = fit(both, y)
    residual = (both @ theta - y)[:, None]
    apart = uncertainty.sandwich([residual], [x[:, None]], nuisance=[own[:, None]])
    np.testing.assert_allclose(apart.matrix, joint.matrix[:2, :2], rtol=1e-6)


def test_a_direction_without_information_has_no_error() -> None:
    rng = np.random.default_rng(5)
    x = regressors(rng)
    double = np.hstack([x, x[:, :1] * 2.0])
    y = x @ THETA + rng.normal(size=SAMPLES)
    theta = np.linalg.lstsq(double, y)[0]
    covariance = uncertainty.sandwich([(double @ theta - y)[:, None]], [double[:, None]])
    found = uncertainty.estimates(covariance, report, theta)
    assert [np.isfinite(one.standard_error) for one in found.parameters] == [False, True, False]
    assert [one.data_share for one in found.parameters][::2] == [0.0, 0.0]


def test_jacobians_are_those_of_the_residuals() -> None:
    def residuals(theta: Array) -> list[Array]:
        t = np.arange(5.0)[:, None]
        return [np.exp(-theta[0] * t) * theta[1], np.sin(theta[0] * t[:3])]

    at, slopes = uncertainty.jacobians_of(residuals, np.array([0.3, 2.0]))
    t = np.arange(5.0)[:, None]
    np.testing.assert_allclose(slopes[0][..., 0], -2.0 * t * np.exp(-0.3 * t), atol=1e-8)
    np.testing.assert_allclose(slopes[1][..., 1], 0.0, atol=1e-8)
    assert [e.shape for e in at] == [(5, 1), (3, 1)]


def test_a_missing_effect_that_the_residuals_show_widens_the_interval() -> None:
    """y = a u + c tanh(5 u) is fitted by a u: the friction-like term shows in the residuals, and
    without it nothing does."""
    rng = np.random.default_rng(2)
    u = rng.standard_normal(600)
    found: list[float] = []
    for missing in (0.0, 0.5):
        y = 2.0 * u + missing * np.tanh(5.0 * u) + 0.1 * rng.standard_normal(600)
        a = float(u @ y / (u @ u))
        covariance = uncertainty.sandwich([(y - a * u)[:, None]], [u[:, None, None]])
        row = uncertainty.estimates(
            covariance, lambda x: [ParameterEstimate("a", float(x[0]), 0, 0, 0)], np.array([a])
        ).parameters[0]
        found.append(row.misfit_error)
        if missing:
            assert abs(a - 2.0) > 3.0 * row.standard_error  # noise alone does not hold the truth
            assert abs(a - 2.0) < row.misfit_error
    assert found[0] == 0.0


@pytest.mark.slow
def test_intervals_hold_the_truth_where_samples_are_missing() -> None:
    """The missing samples have residuals of any size; the fit did not use them."""
    rng, held = np.random.default_rng(6), []
    for _ in range(150):
        x, y = regressors(rng), coloured(rng, 0.8)
        y += x @ THETA
        mask = np.ones(SAMPLES)
        mask[[7, 8, 9, 120, 250]], mask[300:360] = 0, 0
        y[mask == 0] = 1e3
        theta = np.linalg.lstsq(x[mask > 0], y[mask > 0])[0]
        covariance = uncertainty.sandwich(
            [(x @ theta - y)[:, None]], [x[:, None]], measured=[mask[:, None]]
        )
        found = uncertainty.estimates(covariance, report, theta).parameters
        held += [one.low <= true <= one.high for one, true in zip(found, THETA, strict=True)]
    assert 0.90 < np.mean(held) < 0.98


def test_without_a_gap_the_mask_changes_nothing() -> None:
    rng = np.random.default_rng(7)
    x, own = regressors(rng), 0.99 ** np.arange(SAMPLES)[:, None, None]
    residual = coloured(rng, 0.5)[:, None]
    plain = uncertainty.sandwich([residual], [x[:, None]], nuisance=[own])
    masked = uncertainty.sandwich(
        [residual], [x[:, None]], nuisance=[own], measured=[np.ones((SAMPLES, 1))]
    )
    np.testing.assert_array_equal(plain.matrix, masked.matrix)
    assert (plain.freedom, plain.misfit) == (masked.freedom, masked.misfit)


def test_short_stretches_of_measured_samples_are_refused() -> None:
    rng = np.random.default_rng(8)
    mask = np.arange(SAMPLES) % 4 > 0
    with pytest.raises(ValueError, match="stretches of less than 20 samples"):
        uncertainty.sandwich(
            [coloured(rng, 0.5)[:, None]], [regressors(rng)[:, None]], measured=[mask[:, None]]
        )
