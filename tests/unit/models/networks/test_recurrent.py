"""Recurrent networks."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from asia.errors import UserError
from asia.models import recurrent
from asia.models._networks.compiled import compiled
from asia.models._networks.network import NetworkModel
from asia.models._networks.structure import rollout
from asia.models._numerics.training_records import window_size
from asia.models.methods import Adam
from tests.unit.models.systems.black_box import Case, case, filtered, two_by_two


def fitted(config: recurrent.Config, data: Case, method: Adam) -> NetworkModel:
    model = recurrent.build(config, data.context)
    return recurrent.train(model, data.training, data.context, method)


@pytest.mark.slow
@pytest.mark.parametrize("cell", ["rnn", "gru", "lstm"])
def test_training_learns_the_system(cell: Literal["rnn", "gru", "lstm"]) -> None:
    data = case(filtered)
    method = Adam(steps=200, learning_rate=1e-2, truncation=64)
    model = fitted(recurrent.Config(cell, hidden=8, layers=2), data, method)
    # An output held at its mean has ratio 20.
    assert data.ratio(model) < 8


def test_two_inputs_and_outputs_from_records_of_unequal_length() -> None:
    data = case(two_by_two, channels=2, lengths=(200, 90, 40))
    model = fitted(recurrent.Config(hidden=8), data, Adam(steps=150, learning_rate=1e-2))
    assert data.ratio(model) < 10


def test_batch_of_cases_is_simulated_case_by_case() -> None:
    data = case(filtered, lengths=(120,))
    model = fitted(recurrent.Config(hidden=4), data, Adam(steps=5))
    u, y = data.unseen.u, data.unseen.y
    starts = (8, 50)
    parts = [(u[k - 8 : k], y[k - 8 : k], u[k : k + 30]) for k in starts]
    together = model.simulate(*(np.stack(p) for p in zip(*parts, strict=True)))
    assert together.shape == (2, 30, 1)
    assert together.dtype == np.float64
    for row, part in zip(together, parts, strict=True):
        np.testing.assert_allclose(row, model.simulate(*(p[None] for p in part))[0], rtol=1e-4)


def test_bad_configuration_is_refused() -> None:
    with pytest.raises(UserError, match="expected rnn, gru or lstm"):
        recurrent.Config("elman")  # type: ignore[arg-type]


def test_reference_recipe_starts_as_written() -> None:
    """Uniform weights, h0 = c0 of one hidden ReLU layer, an output linear in h alone."""
    context = case(filtered).context
    config = recurrent.Config(
        "lstm", 6, encoder=3, activation="relu", tied=True, direct=False, start="uniform"
    )
    model = recurrent.build(config, context)
    p, cell = model.params, recurrent.RecurrentCell(config)
    window = np.random.default_rng(0).standard_normal((2, 16))
    inner = np.maximum(window @ p["enc_w1"] + p["enc_b1"], 0.0)
    ((h, c),) = cell.initial(p, window)  # type: ignore[arg-type]
    np.testing.assert_allclose(h, inner @ p["enc_w2"] + p["enc_b2"], rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(h, c)
    assert p["out_w"].shape == (6, 1)
    np.testing.assert_allclose(cell.output(p, h, window[:, :1]), h @ p["out_w"] + p["out_b"], 1e-5)  # type: ignore[arg-type]
    for weights, fan_in in ((p["enc_w1"], 16), (p["enc_w2"], 3), (p["layers"][0]["h"], 6)):
        assert 0.8 / np.sqrt(fan_in) < np.abs(weights).max() <= 1 / np.sqrt(fan_in)


@pytest.mark.long
def test_uniform_start_is_trained_from_as_it_is_and_ridge_start_is_solved() -> None:
    data = case(filtered, lengths=(150,))
    still = Adam(steps=1, learning_rate=1e-9, weight_decay=0.0)
    for start, unchanged in (("uniform", True), ("ridge", False)):
        config = recurrent.Config(hidden=4, start=start)  # type: ignore[arg-type]
        before = recurrent.build(config, data.context).params["out_w"]
        after = fitted(config, data, still).params["out_w"]
        assert np.allclose(before, after, atol=1e-6) == unchanged


@pytest.mark.parametrize("cell", ["rnn", "lstm"])
@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_every_kind_of_cell_simulates_in_numpy_as_in_jax(
    cell: Literal["rnn", "lstm"], activation: Literal["tanh", "relu"]
) -> None:
    kind = {"activation": activation, "tied": activation == "relu", "start": "uniform"}
    config = recurrent.Config(cell, 4, layers=2, direct=activation == "tanh", **kind)
    data = case(two_by_two, channels=2)
    model = recurrent.build(config, data.context)
    rng = np.random.default_rng(0)
    window = rng.standard_normal((3, window_size(data.context))).astype(np.float32)
    arrays = window, rng.standard_normal((3, 50, 2)).astype(np.float32)
    in_jax = compiled(rollout, model.cell, model.params, *arrays)
    np.testing.assert_allclose(
        rollout(model.cell, model.params, *arrays), in_jax, rtol=1e-4, atol=1e-6
    )
