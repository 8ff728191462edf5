"""Liquid time-constant networks."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from asia.errors import UserError
from asia.models import ltc
from asia.models._network import rollout
from asia.models.methods import Adam
from tests.unit.models.black_box_systems import case, wiener


def test_training_learns_the_system() -> None:
    data = case(wiener)
    model = ltc.build(ltc.Config(hidden=16), data.context)
    method = Adam(steps=300, learning_rate=5e-3, truncation=64)
    assert data.ratio(ltc.train(model, data.training, data.context, method)) < 4


def test_one_step_is_the_published_equation() -> None:
    data = case(wiener)
    model = ltc.build(ltc.Config(hidden=5, width=7), data.context)
    p = model.params
    rng = np.random.default_rng(0)
    h, u = rng.standard_normal((1, 5)), rng.standard_normal((1, 1))
    inner = np.tanh(np.concatenate([h, u], 1) @ np.concatenate([p["f_h"], p["f_u"]]))
    decay = np.exp(-1 / np.logspace(0, np.log10(25), 5))
    expected = decay * h + (1 - decay) * np.tanh(inner @ p["f_w2"])
    state, features = model.cell.step(p, jnp.asarray(h), jnp.asarray(u))
    np.testing.assert_allclose(state, expected, rtol=1e-5)
    np.testing.assert_array_equal(state, features)


def test_untrained_output_is_zero_and_states_stay_in_the_unit_cube() -> None:
    data = case(wiener)
    model = ltc.build(ltc.Config(hidden=5), data.context)
    window, u = jnp.ones((2, 16)), 100 * jnp.ones((2, 50, 1))
    np.testing.assert_array_equal(rollout(model.cell, model.params, window, u), 0.0)
    h = model.cell.initial(model.params, window)
    for k in range(50):
        h, _ = model.cell.step(model.params, h, u[:, k])
    assert np.abs(h).max() <= 1.0


def test_bad_time_constants_are_refused() -> None:
    with pytest.raises(UserError, match="tau_min"):
        ltc.Config(tau_min=5.0, tau_max=1.0)
