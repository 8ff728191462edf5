"""Causal Transformers."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from asia.errors import UserError
from asia.models import transformer
from asia.models._networks.structure import rollout
from asia.models.methods import Adam
from tests.unit.models.systems.black_box import case, wiener

SMALL = transformer.Config(layers=1, heads=2, width=8, inner=8, span=6)


@pytest.mark.long
def test_training_learns_the_system() -> None:
    data = case(wiener)
    config = transformer.Config(layers=1, width=16, inner=32, span=32)
    model = transformer.build(config, data.context)
    method = Adam(steps=200, learning_rate=5e-3, noise=0.1)
    assert data.ratio(transformer.train(model, data.training, data.context, method)) < 6.5


def test_attention_in_blocks_is_attention_in_a_band() -> None:
    data = case(wiener)
    p = transformer.build(SMALL, data.context).params["layers"][0]
    x = np.random.default_rng(0).standard_normal((1, 24, 8))
    found = transformer.banded_attention(p, jnp.asarray(x), heads=2, span=6)
    query, key, value = np.split(x[0] @ p["qkv"], 3, axis=-1)
    for head, part in enumerate([slice(0, 4), slice(4, 8)]):
        for i in range(24):
            back = np.arange(max(0, i - 5), i + 1)
            scores = key[back, part] @ query[i, part] / 2 + p["bias"][head][i - back]
            weights = np.exp(scores - scores.max())
            expected = weights / weights.sum() @ value[back, part]
            np.testing.assert_allclose(found[0, i, part], expected, rtol=1e-3, atol=1e-4)


def test_outputs_depend_on_the_past_window_and_on_no_later_input() -> None:
    data = case(wiener)
    cell = transformer.build(SMALL, data.context).cell
    params = dict(cell.parameters(data.context))
    rng = np.random.default_rng(0)
    params["out_w"] = rng.standard_normal(params["out_w"].shape)
    simulate = jax.jit(rollout, static_argnums=0)
    window, u = rng.standard_normal((2, 16)), np.zeros((2, 40, 1))
    changed = u.copy()
    changed[:, 17:] = 1.0
    y, other = (np.asarray(simulate(cell, params, window, v)) for v in (u, changed))
    np.testing.assert_array_equal(y[:, :17], other[:, :17])
    assert np.abs(y[:, 17:] - other[:, 17:]).min() > 0
    assert np.abs(y[0, 0] - y[1, 0]) > 1e-3


def test_heads_must_divide_the_width() -> None:
    with pytest.raises(UserError, match="width is 10, expected a multiple of heads"):
        transformer.Config(width=10)
