"""Cascade of a slow and a fast liquid time-constant layer."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from asia.models import cascaded_ltc
from asia.models.methods import Adam
from tests.unit.models.systems.black_box import case, wiener


@pytest.mark.slow
def test_training_learns_the_system() -> None:
    data = case(wiener)
    model = cascaded_ltc.build(cascaded_ltc.Config(slow=4, fast=8, width=16), data.context)
    method = Adam(steps=300, learning_rate=1e-2, truncation=64)
    assert data.ratio(cascaded_ltc.train(model, data.training, data.context, method)) < 4


def test_a_time_constant_stays_in_its_range() -> None:
    place = jnp.asarray([-1e3, -1.0, 0.0, 1.0, 1e3])
    tau = np.asarray(cascaded_ltc.time_constants(place, 10.0, 200.0))
    assert np.all(np.diff(tau) > 0)
    np.testing.assert_allclose(tau[[0, 2, 4]], [10, np.sqrt(2000), 200], rtol=1e-5)


def test_the_fast_layer_reads_the_slow_one_and_not_the_other_way() -> None:
    data = case(wiener)
    cell = cascaded_ltc.build(cascaded_ltc.Config(slow=3, fast=4), data.context).cell
    params = cell.parameters(data.context)
    u, slow, fast = jnp.ones((1, 1)), jnp.zeros((1, 3)), jnp.zeros((1, 4))
    (slow1, fast1), _ = cell.step(params, (slow, fast), u)
    (slow2, fast2), _ = cell.step(params, (slow + 1, fast), u)
    (slow3, fast3), _ = cell.step(params, (slow, fast + 1), u)
    assert np.abs(slow2 - slow1).max() > 0
    assert np.abs(fast2 - fast1).max() > 0
    np.testing.assert_array_equal(slow3, slow1)
    assert np.abs(fast3 - fast1).max() > 0
