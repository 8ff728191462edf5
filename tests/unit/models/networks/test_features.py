"""Functions of the inputs as additional inputs."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from asia.data import Trajectory
from asia.errors import UserError
from asia.models import cnn
from asia.models._networks.structure import FUNCTIONS, Features, drive_size
from asia.models._numerics.scaling import Scaling


def record(seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    return Trajectory(rng.uniform([200.0, -3.0], [2000.0, 5.0], (300, 2)), np.zeros(300), 1.0)


def test_functions_see_physical_inputs_and_are_standardised() -> None:
    data = record()
    features = Features(("square", "abs")).fitted([data])
    scaling = Scaling.of([data])
    found = np.asarray(features(jnp.asarray(scaling.inputs(data.u), jnp.float32)))
    expected = np.concatenate([data.u, data.u**2, np.abs(data.u)], axis=1)
    expected = (expected - expected.mean(axis=0)) / expected.std(axis=0)
    assert found.shape == (300, drive_size(features.names, 2))
    np.testing.assert_allclose(found, expected, atol=2e-4)


def test_statistics_are_those_of_the_training_records() -> None:
    features = Features(("square",)).fitted([record()])
    elsewhere = np.full((1, 2), 3.0, np.float32)
    assert np.abs(np.asarray(features(jnp.asarray(elsewhere)))).max() > 3
    assert hash(features) == hash(Features(("square",)).fitted([record()]))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_an_input_at_rest_gives_finite_features(name: str) -> None:
    features = Features((name,)).fitted([Trajectory(np.zeros(20), np.zeros(20), 1.0)])
    np.testing.assert_array_equal(features(jnp.zeros((4, 1))), 0.0)


def test_an_unknown_function_is_refused() -> None:
    with pytest.raises(UserError, match=r"cnn\.Config: feature 'sqare' is unknown"):
        cnn.Config(features=("sqare",))
