"""Networks fitted under slow disturbances of the output."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.errors import UserError
from asia.models import recurrent
from asia.models._networks.objective import NoiseWeighting, objective
from asia.models._noise.model import ResidualNoise, innovation_filter, innovations
from asia.models.methods import LBFGS, Adam, MultipleShooting, NetworkMethod
from tests.unit.models.noise.drawn import slow_disturbance

SAMPLES, PAST = 500, 4
CONTEXT = Context((Signal("u"),), (Signal("y"),), 1.0, n_past_u=PAST, n_past_y=PAST, seed=1)


def response(u: np.ndarray) -> np.ndarray:
    """A first-order lag of a bent input."""
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = 0.85 * y[k - 1] + 0.15 * np.tanh(1.5 * u[k - 1])
    return y / 0.3


def error(method: NetworkMethod, seed: int, slow: float) -> float:
    """Simulation error against the truth, without its mean."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((2, SAMPLES))
    truth = np.stack([response(row) for row in u])
    noise = slow * slow_disturbance(SAMPLES, 0.98, rng) + 0.02 * rng.standard_normal(SAMPLES)
    record = Trajectory(u[0][:, None], (truth[0] + noise)[:, None], 1.0)
    model = recurrent.build(recurrent.Config(hidden=4), CONTEXT)
    model = recurrent.train(model, [record], CONTEXT, method)
    past = u[1][None, :PAST, None], truth[1][None, :PAST, None]
    y = model.simulate(*past, u[1][None, PAST:, None])[0, :, 0]
    return float(np.std((y - truth[1][PAST:])[50:]))


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "most"), [(LBFGS(100), 0.9), (Adam(600, 1e-2, truncation=100), 0.75)]
)
def test_a_slow_disturbance_costs_less_with_its_model(method: NetworkMethod, most: float) -> None:
    slow = replace(method, noise_model="slow")
    assert error(slow, 0, 0.8) < most * error(method, 0, 0.8)


@pytest.mark.long
def test_under_white_noise_the_error_is_much_the_same() -> None:
    method = LBFGS(150)
    ratio = error(replace(method, noise_model="slow"), 2, 0.0) / error(method, 2, 0.0)
    assert ratio == pytest.approx(1.0, abs=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("huber", [None, 1.0])
def test_the_objective_squares_innovations(huber: float | None) -> None:
    rng = np.random.default_rng(0)
    residual, weight = rng.normal(size=(3, 40, 2)), np.ones((3, 40, 2))
    weight[1, 25:], weight[2, 5:9] = 0.0, 0.0
    noise = ResidualNoise(np.array([8.0, 3.0]), np.array([0.5, 0.4]), np.array([0.2, 0.3]))
    whiten = NoiseWeighting.of(noise, 0.5, huber)
    found = objective("mse", jnp.asarray(residual), jnp.asarray(weight), whiten=whiten)
    white = innovations(innovation_filter(noise, 0.5, weight), residual)
    loss = white**2
    if huber is not None:
        loss = np.where(np.abs(white) < huber, loss, 2 * huber * np.abs(white) - huber**2)
    expected = noise.variance.mean() * loss.sum() / weight.sum()
    assert_allclose(float(found), expected, rtol=1e-4)


def test_what_cannot_be_combined() -> None:
    with pytest.raises(UserError, match="MultipleShooting: free starts"):
        MultipleShooting(noise_model="slow")
    with pytest.raises(UserError, match="loss is 'mae' beside a noise model"):
        Adam(loss="mae", noise_model="slow")
