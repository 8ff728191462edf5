"""Neural state-space models with an encoder."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.errors import UserError
from asia.models import subnet
from asia.models.methods import Adam
from tests.unit.models.systems.black_box import case, two_by_two, wiener


@pytest.mark.slow
def test_training_learns_the_system() -> None:
    data = case(wiener)
    model = subnet.build(subnet.Config(states=2, width=16), data.context)
    method = Adam(steps=200, learning_rate=5e-3, truncation=64)
    assert data.ratio(subnet.train(model, data.training, data.context, method)) < 2.4


@pytest.mark.long
def test_with_a_horizon_it_starts_from_a_state_of_last_outputs() -> None:
    data = case(two_by_two, channels=2)
    context = replace(data.context, n_past_u=0, n_past_y=1, horizon=12)
    config = subnet.Config(states=3, width=4)
    method = Adam(steps=1, learning_rate=1e-9, truncation=12)
    model = subnet.train(subnet.build(config, context), data.training, context, method)
    record = data.training[0]
    y = model.simulate(np.zeros((1, 0, 2)), record.y[None, :1], record.u[None, 1:13])[0]
    # One-step least squares, iterated.
    known = np.column_stack([record.y[:-1], record.u[1:], np.ones(399)])
    theta = np.linalg.lstsq(known, record.y[1:])[0]
    state, expected = record.y[0], []
    for u in record.u[1:13]:
        state = np.r_[state, u, 1.0] @ theta
        expected.append(state)
    np.testing.assert_allclose(y, expected, atol=0.05)


def test_an_unstable_state_does_not_overflow() -> None:
    data = case(wiener)
    cell = subnet.build(subnet.Config(states=2), data.context).cell
    params = dict(cell.parameters(data.context))
    params["a"] = 2 * np.eye(2)
    state = jnp.ones((1, 2))
    for _ in range(200):
        state, read = cell.step(params, state, jnp.ones((1, 1)))
    assert np.isfinite(cell.output(params, read, jnp.ones((1, 1)))).all()


def test_an_unknown_start_is_refused() -> None:
    with pytest.raises(UserError, match="expected linear or random"):
        subnet.Config(start="best")  # type: ignore[arg-type]


def drifting(samples: int = 300) -> tuple[Context, list[Trajectory], Array]:
    """A lag that fills a store, which stands still at an input of 0.5; and the clean output."""
    rng = np.random.default_rng(5)
    u = 0.7 + np.repeat(rng.uniform(-1, 1, samples // 5), 5)
    flow, y = np.zeros(samples), np.zeros(samples)
    for k in range(1, samples):
        flow[k] = 0.7 * flow[k - 1] + 0.3 * (u[k - 1] - 0.5)
        y[k] = y[k - 1] + flow[k - 1]
    context = Context((Signal("u"),), (Signal("y"),), 1.0, n_past_u=5, n_past_y=5, seed=1)
    return context, [Trajectory(u, y + 0.01 * rng.standard_normal(samples), 1.0)], y


def test_it_starts_at_the_best_linear_model_with_free_integrators() -> None:
    context, records, clean = drifting()
    config = subnet.Config(states=2, width=4, integrators=1)
    method = Adam(steps=1, learning_rate=1e-9, truncation=64)
    model = subnet.train(subnet.build(config, context), records, context, method)
    u, y = records[0].u[None], records[0].y[None]
    found = model.simulate(u[:, :5], y[:, :5], u[:, 5:])[0, :, 0]
    assert np.sqrt(np.mean((found - clean[5:]) ** 2)) < 0.02 * clean.std()
    # Where nothing flows, the store stays at its level.
    still = np.full((1, 400, 1), 0.5)
    rest = model.simulate(still[:, :5], np.full((1, 5, 1), y[0, 150, 0]), still)[0, :, 0]
    assert abs(rest[-1] - rest[50]) < 0.05 * clean.std()


def test_integrators_are_fewer_than_the_states() -> None:
    with pytest.raises(UserError, match="less than the states"):
        subnet.Config(states=2, integrators=2)
