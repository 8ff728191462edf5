"""Koopman models with control."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from asia.models import koopman
from asia.models._networks.structure import mlp
from asia.models.methods import Adam
from tests.unit.models.systems.black_box import case, wiener

SMALL = koopman.Config(levels=2, states=3, lift=2, width=8)


@pytest.mark.slow
def test_training_learns_the_system() -> None:
    data = case(wiener)
    config = koopman.Config(levels=2, states=6, lift=4, width=16)
    model = koopman.build(config, data.context)
    method = Adam(steps=500, learning_rate=1e-2, truncation=64)
    assert data.ratio(koopman.train(model, data.training, data.context, method)) < 4.5


def test_the_latent_state_is_bilinear_in_itself_and_the_lifted_input() -> None:
    data = case(wiener)
    cell = koopman.build(SMALL, data.context).cell
    p = cell.parameters(data.context)
    rng = np.random.default_rng(0)
    window, u = rng.standard_normal((1, 16)), rng.standard_normal((1, 12, 1))
    found = np.asarray(cell.features(p, jnp.asarray(window), jnp.asarray(u)))[0]
    v = np.concatenate([u, np.asarray(mlp(p["lift"], jnp.asarray(u)))], axis=-1)[0]
    z = np.asarray(mlp(p["encoder"], jnp.asarray(window)))[0]
    for k, row in enumerate(v):
        before, after = z, []
        for i, level in enumerate(p["levels"]):
            pole = np.exp(-np.exp(level["log_rate"]) + 1j * level["angle"])
            drive = row @ level["b"]
            if i:
                drive = drive + (before[: 6 * i] @ level["left"]) * (row @ level["right"])
            drive = np.sqrt(1 - np.abs(pole) ** 2) * (drive[:3] + 1j * drive[3:])
            x = pole * (before[6 * i : 6 * i + 3] + 1j * before[6 * i + 3 : 6 * i + 6]) + drive
            after += [x.real, x.imag]
        z = np.concatenate(after)
        np.testing.assert_allclose(found[k], z, rtol=1e-3, atol=1e-3)


def test_strong_bilinear_terms_cannot_make_it_unstable() -> None:
    data = case(wiener)
    cell = koopman.build(SMALL, data.context).cell
    strong = jax.tree.map(lambda v: 10 * v, cell.parameters(data.context)["levels"])
    p = {**cell.parameters(data.context), "levels": strong}
    u = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (1, 4000, 1)))
    z = np.abs(cell.features(p, jnp.zeros((1, 16)), u))[0]
    assert z[2000:].max() < 2 * z[:2000].max()
