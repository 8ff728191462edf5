"""Free-running autoregressive networks."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from asia.errors import UserError
from asia.models import autoregressive
from asia.models._networks.structure import OutputFeedback, rollout
from asia.models.methods import Adam
from tests.unit.models.systems.black_box import case, wiener


@pytest.mark.slow
def test_training_learns_the_system() -> None:
    data = case(wiener)
    config = autoregressive.Config(cell="gru", hidden=12)
    model = autoregressive.build(config, data.context)
    method = Adam(steps=300, learning_rate=1e-2, truncation=64)
    trained = autoregressive.train(model, data.training, data.context, method)
    assert data.ratio(trained) < 7
    steps = np.diff(data.training[0].y / data.training[0].y.std(), axis=0)
    np.testing.assert_allclose(
        trained.params["fixed"]["increment"], np.sqrt((steps**2).mean()), rtol=1e-4
    )


def test_untrained_it_holds_the_last_measured_output() -> None:
    data = case(wiener)
    model = autoregressive.build(autoregressive.Config(hidden=4), data.context)
    window = jnp.arange(32.0).reshape(2, 16)
    y = rollout(model.cell, model.params, window, jnp.ones((2, 5, 1)))
    np.testing.assert_array_equal(y, np.broadcast_to([[[15.0]], [[31.0]]], (2, 5, 1)))


def test_without_past_outputs_it_starts_from_their_mean() -> None:
    context = replace(case(wiener).context, n_past_y=0)
    model = autoregressive.build(autoregressive.Config(hidden=4), context)
    y = rollout(model.cell, model.params, jnp.ones((2, 8)), jnp.ones((2, 5, 1)))
    np.testing.assert_array_equal(y, 0.0)


def test_a_measured_output_replaces_its_own_where_asked() -> None:
    data = case(wiener)
    cell = autoregressive.build(autoregressive.Config(hidden=4), data.context).cell
    assert isinstance(cell, OutputFeedback)
    rng = np.random.default_rng(0)
    params = dict(cell.parameters(data.context))
    params["out_w"] = rng.standard_normal((4, 1))
    state = cell.initial(params, jnp.ones((2, 16)))
    state, own = cell.step(params, state, jnp.ones((2, 1)))
    fed = cell.feed(params, state, jnp.full((2, 1), 7.0), jnp.asarray([[1.0], [0.0]]))
    np.testing.assert_allclose(fed[1], [[7.0], [float(own[1, 0])]])
    # The output after that goes on from the measured one, and so do the layers.
    (inner, y), _ = cell.step(params, fed, jnp.ones((2, 1)))
    assert abs(float(y[0, 0]) - 7.0) < abs(float(own[0, 0]) - 7.0)
    assert float(jnp.abs(inner[0][0][0] - inner[0][0][1]).max()) > 0


def test_an_unknown_cell_is_refused() -> None:
    with pytest.raises(UserError, match="expected rnn, gru or lstm"):
        autoregressive.Config(cell="gated")  # type: ignore[arg-type]
