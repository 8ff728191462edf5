"""The innovations filter against the dense whitener, in NumPy and in JAX."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from asia.data import Array
from asia.models._noise.model import ErrorWeighting, ResidualNoise, innovation_filter, innovations

DT, SAMPLES = 0.5, 90
NOISE = ResidualNoise(np.array([8.0, 3.0]), np.array([0.15, 0.4]), np.array([0.02, 0.3]))


def dense(mask: Array, residual: Array, output: int) -> Array:
    """Innovations of the samples that count, by the Cholesky factor of their covariance."""
    time = DT * np.flatnonzero(mask)
    apart = np.abs(time[:, None] - time)
    slow = NOISE.slow[output] ** 2 * np.exp(-apart / NOISE.time[output])
    factor = np.linalg.cholesky(slow + NOISE.white[output] ** 2 * np.eye(len(time)))
    return np.linalg.solve(factor, residual[mask > 0, output])


def masks() -> Array:
    """All samples, a gap, and padding at the end."""
    found = np.ones((3, SAMPLES))
    found[1, 20:50], found[2, 30:] = 0.0, 0.0
    return found


def test_innovations_are_those_of_the_dense_whitener() -> None:
    mask, residual = masks(), np.random.default_rng(0).normal(size=(3, SAMPLES, 2))
    found = innovations(innovation_filter(NOISE, DT, mask[..., None]), residual)
    for row in range(3):
        assert_array_equal(found[row, mask[row] == 0], 0.0)
        for output in range(2):
            expected = dense(mask[row], residual[row], output)
            assert_allclose(found[row, mask[row] > 0, output], expected, atol=1e-10)


def test_numpy_and_jax_agree() -> None:
    mask, residual = masks(), np.random.default_rng(1).normal(size=(3, SAMPLES, 2))
    expected = innovations(innovation_filter(NOISE, DT, mask[..., None]), residual)
    with jax.enable_x64(True):
        through = jax.jit(innovation_filter)(NOISE, DT, mask[..., None])
        assert_allclose(np.asarray(jax.jit(innovations)(through, residual)), expected, atol=1e-10)


def test_what_does_not_count_changes_nothing() -> None:
    mask, residual = masks(), np.random.default_rng(2).normal(size=(3, SAMPLES, 2))
    through = innovation_filter(NOISE, DT, mask[..., None])
    other = np.where(mask[..., None] > 0, residual, 1e6)
    assert_array_equal(innovations(through, other), innovations(through, residual))


@pytest.mark.parametrize("huber", [None, 2.0])
def test_white_noise_of_one_output_leaves_errors_as_they_are(huber: float | None) -> None:
    white = ResidualNoise(np.array([DT]), np.array([0.0]), np.array([0.3]))
    weigh = ErrorWeighting.of(white, DT, np.ones((1, SAMPLES, 1)), huber)
    error = np.random.default_rng(3).uniform(-0.5, 0.5, size=(1, SAMPLES, 1))
    assert_allclose(weigh(error), error, atol=1e-12)
    weighed = weigh(10.0 * error)
    assert (np.abs(weighed) < np.abs(10.0 * error)).any() == (huber is not None)
