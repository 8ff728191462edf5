"""Temporal convolutional networks."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from asia.errors import UserError
from asia.models import cnn
from asia.models._networks.structure import rollout
from asia.models.methods import Adam
from tests.unit.models.systems.black_box import case, wiener


@pytest.mark.slow
def test_training_learns_the_system() -> None:
    data = case(wiener)
    model = cnn.build(cnn.Config(receptive_field=32, width=8), data.context)
    method = Adam(steps=300, learning_rate=1e-2, weight_decay=0.1, noise=0.1)
    assert data.ratio(cnn.train(model, data.training, data.context, method)) < 4


@pytest.mark.parametrize(("least", "dilations", "field"), [(8, (1, 2, 4), 15), (4, (1, 2), 7)])
def test_an_output_sees_its_receptive_field_and_nothing_later(
    least: int, dilations: tuple[int, ...], field: int
) -> None:
    data = case(wiener)
    config = cnn.Config(receptive_field=least, width=4)
    assert config.dilations == dilations
    cell = cnn.build(config, data.context).cell
    rng = np.random.default_rng(0)
    params = dict(cell.parameters(data.context))
    params["out_w"] = rng.standard_normal(params["out_w"].shape)
    window, u = jnp.ones((1, 16)), rng.standard_normal((1, 50, 1))
    changed = u.copy()
    changed[0, 20] += 1
    simulate = jax.jit(rollout, static_argnums=0)
    y, other = (np.asarray(simulate(cell, params, window, v)) for v in (u, changed))
    difference = np.abs(other - y)[0, :, 0]
    touched = np.flatnonzero(difference > 0)
    assert touched[0] == 20
    assert touched[-1] == 20 + field - 1


def test_the_past_window_is_felt_and_fades() -> None:
    data = case(wiener)
    cell = cnn.build(cnn.Config(receptive_field=8, width=4), data.context).cell
    p, u = cell.parameters(data.context), jnp.zeros((1, 400, 1))
    rest = cell.features(p, jnp.zeros((1, 16)), u)
    gap = np.abs(cell.features(p, jnp.ones((1, 16)), u) - rest)[0].max(axis=1)
    assert gap[0] > 1e-2
    assert gap[-1] < 1e-4


def test_too_small_a_field_is_refused() -> None:
    with pytest.raises(UserError, match="receptive_field is 1, expected at least 2"):
        cnn.Config(receptive_field=1)
