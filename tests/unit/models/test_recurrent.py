"""Recurrent networks."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from asia.errors import UserError
from asia.models import recurrent
from asia.models._network import NetworkModel
from asia.models.methods import Adam
from tests.unit.models.black_box_systems import Case, case, filtered, two_by_two


def fitted(config: recurrent.Config, data: Case, method: Adam) -> NetworkModel:
    model = recurrent.build(config, data.context)
    return recurrent.train(model, data.training, data.context, method)


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


def test_same_seed_gives_the_same_model_and_another_seed_another() -> None:
    data = case(filtered, lengths=(120,))
    method = Adam(steps=20, noise=0.1, truncation=32)
    config = recurrent.Config(hidden=4)
    first, second = (data.simulated(fitted(config, data, method)) for _ in range(2))
    assert first.tobytes() == second.tobytes()
    other = replace(data, context=replace(data.context, seed=4))
    assert first.tobytes() != other.simulated(fitted(config, other, method)).tobytes()


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
    with pytest.raises(UserError, match="truncation must be longer"):
        Adam(truncation=10, washout=10)
