"""Liquid time-constant networks."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from asia.errors import UserError
from asia.models import ltc
from asia.models._networks.structure import rollout
from asia.models.methods import Adam
from tests.unit.models.systems.black_box import case, wiener


@pytest.mark.slow
def test_training_learns_the_system() -> None:
    data = case(wiener)
    model = ltc.build(ltc.Config(hidden=16), data.context)
    method = Adam(steps=300, learning_rate=5e-3, truncation=64)
    assert data.ratio(ltc.train(model, data.training, data.context, method)) < 4


def test_one_step_is_the_published_equation() -> None:
    data = case(wiener)
    model = ltc.build(ltc.Config(hidden=5), data.context)
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
    with pytest.raises(UserError, match="tau_max is 0"):
        ltc.Config(tau_max=0.5)


def test_uniform_start_and_linear_ends_are_what_they_say() -> None:
    data = case(wiener)
    config = ltc.Config(hidden=5, start="uniform", bounded=False)
    model = ltc.build(config, data.context)
    p, cell = model.params, ltc.LTCCell(config)
    assert np.abs(p["out_w"]).max() <= 1 / np.sqrt(6)
    rng = np.random.default_rng(0)
    h, u, window = (rng.standard_normal((1, n)) for n in (5, 1, 16))
    inner = np.tanh(np.concatenate([h, u], 1) @ np.concatenate([p["f_h"], p["f_u"]]) + p["f_b1"])
    decay = np.exp(-1 / np.logspace(0, np.log10(25), 5))
    expected = decay * h + (1 - decay) * (inner @ p["f_w2"] + p["f_b2"])
    np.testing.assert_allclose(cell.step(p, jnp.asarray(h), jnp.asarray(u))[0], expected, rtol=1e-4)
    inner = np.tanh(window @ p["enc_w1"] + p["enc_b1"])
    np.testing.assert_allclose(
        cell.initial(p, jnp.asarray(window)), inner @ p["enc_w2"] + p["enc_b2"], rtol=1e-3
    )
    still = Adam(steps=1, learning_rate=1e-9, weight_decay=0.0)
    trained = ltc.train(model, data.training, data.context, still)
    np.testing.assert_allclose(trained.params["out_w"], p["out_w"], atol=1e-6)


@pytest.mark.long
def test_coupled_decay_acts_through_the_gradient() -> None:
    data = case(wiener, lengths=(100,))
    model = ltc.build(ltc.Config(hidden=4), data.context)
    method = Adam(steps=30, learning_rate=1e-3, weight_decay=10.0)
    sizes = [
        float(np.abs(ltc.train(model, data.training, data.context, m).params["f_h"]).sum())
        for m in (method, replace(method, coupled=True))
    ]
    # Decoupled, weights shrink by 1 % a step at most; coupled, each one by the learning rate.
    start = float(np.abs(model.params["f_h"]).sum())
    assert sizes[0] < 0.95 * start
    assert sizes[1] > sizes[0]
