"""Linear recurrent units."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from asia.models import lru
from asia.models._networks.structure import diagonal_states, poles
from asia.models.methods import Adam
from tests.unit.models.systems.black_box import case, wiener


@pytest.mark.slow
def test_training_learns_the_system() -> None:
    data = case(wiener)
    model = lru.build(lru.Config(layers=1, states=8, width=8, tau_max=20.0), data.context)
    method = Adam(steps=300, learning_rate=1e-2, truncation=64)
    assert data.ratio(lru.train(model, data.training, data.context, method)) < 4


def test_states_follow_the_recursion() -> None:
    rng = np.random.default_rng(0)
    pole = 0.9 * np.exp(1j * rng.uniform(0, 1, 3))
    drive = rng.standard_normal((2, 20, 3)) + 1j * rng.standard_normal((2, 20, 3))
    start = rng.standard_normal((2, 3)) + 0j
    x, expected = start, []
    for k in range(20):
        x = pole * x + drive[:, k]
        expected.append(x)
    found = diagonal_states(jnp.asarray(pole), jnp.asarray(drive), jnp.asarray(start))
    np.testing.assert_allclose(found, np.stack(expected, axis=1), rtol=2e-4, atol=2e-4)


def test_poles_stay_in_the_unit_circle_and_states_at_unit_variance() -> None:
    rate = jnp.asarray([-80.0, -3.0, 0.0, 80.0])
    pole, gain = poles(rate, jnp.asarray([0.0, 1.0, 2.0, 3.0]))
    size = np.abs(np.asarray(pole, np.complex128))
    assert size.max() < 1.0
    np.testing.assert_allclose(size[1:3], np.exp(-np.exp([-3.0, 0.0])), rtol=1e-5)
    variance = np.asarray(gain)[1:] ** 2 / (1 - size[1:] ** 2)
    np.testing.assert_allclose(variance, 1.0, rtol=1e-4)
    assert 0 < gain[0] < 1e-2
