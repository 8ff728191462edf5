"""Free integrators in linear and in neural state-space models."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asia.agents.library.registry import family
from asia.data import Trajectory
from asia.data.statistics import integrating
from asia.errors import UserError
from asia.models import linear, neural_ss
from asia.models._least_squares import LevenbergMarquardt
from asia.models._linear.fit import free_entries
from asia.models._linear.system import LinearSystem
from asia.models._state_space.structure import StateSpaceStructure
from tests.unit.agents.searches import simulation
from tests.unit.models.systems.equations import context_for, duffing_record
from tests.unit.models.systems.friction import record, sliding
from tests.unit.models.systems.integrating import motor

CONTEXT = context_for(None, "u", "y", 0.1, n_past_u=10, n_past_y=10)


def of_records(*records: Trajectory):
    return replace(simulation(physics=False), records=records)


def error(model: linear.LinearStateSpace | neural_ss.NeuralStateSpace, new: Trajectory) -> float:
    y = model.simulate(new.u[None, :10], new.y[None, :10], new.u[None, 10:])[0]
    return float(np.sqrt(np.mean((y - new.y[10:]) ** 2)))


@pytest.mark.slow
@pytest.mark.parametrize("order", [None, 2, 3])
def test_a_motor_is_followed_for_much_longer_than_the_training_records(order: int | None) -> None:
    train, new = motor(100), motor(101, samples=3000, noise=0.0)
    method = LevenbergMarquardt(30)
    config = linear.Config(order=order, integrators=1)
    model = linear.train(linear.build(config, CONTEXT), [train], CONTEXT, method)
    assert model.fitted is not None
    poles = np.linalg.eigvals(model.fitted.system.a)
    assert 1.0 in poles
    assert (np.sort(abs(poles))[:-1] < 1.0).all()
    assert error(model, new) < 0.02 * new.y.std()


def test_two_integrators_in_a_row() -> None:
    u = motor(100).u
    speed = np.cumsum(u) * 0.1
    angle = np.cumsum(np.r_[0.0, speed[:-1]])[:, None] * 0.1
    train = Trajectory(u, angle + 1e-3 * np.random.default_rng(0).normal(size=u.shape), 0.1)
    config = linear.Config(order=2, integrators=2)
    model = linear.train(linear.build(config, CONTEXT), [train], CONTEXT)
    assert error(model, train) < 0.01 * train.y.std()


def test_only_what_is_not_held_is_searched() -> None:
    assert free_entries(4, 2).tolist() == [
        [1, 1, 0, 0],
        [1, 1, 0, 0],
        [1, 1, 0, 0],
        [1, 1, 1, 0],
    ]


@pytest.mark.long
def test_a_bent_motor_needs_both() -> None:
    train, new = motor(102, bend=1.0), motor(103, noise=0.0, bend=1.0)
    errors: list[float] = []
    for config in (
        neural_ss.Config(order=2, hidden=4, ridge=1e-4, integrators=1),
        neural_ss.Config(order=2, hidden=4, ridge=1e-4),
        neural_ss.Config(order=2, nonlinearity="none", integrators=1),
    ):
        model = neural_ss.build(config, CONTEXT)
        model = neural_ss.train(model, [train], CONTEXT, LevenbergMarquardt(40, starts=2))
        errors.append(error(model, new) / float(new.y.std()))
    assert errors[0] < 0.03
    assert errors[0] < 0.3 * min(errors[1:])


def test_no_weight_of_a_network_feeds_an_integrator_back() -> None:
    structure = StateSpaceStructure(3, 1, 1, "state", "tanh", 4, 3, None, integrators=1)
    rng = np.random.default_rng(0)
    linear_part = LinearSystem(*(rng.normal(size=s) for s in ((3, 3), (3, 1), (1, 3), (1, 1), 1)))
    p = structure.start(linear_part, rng)
    p["f"]["w2"] = rng.normal(size=p["f"]["w2"].shape)
    x, v = rng.normal(size=3), rng.normal(size=1)
    moved = structure.split(p, x + np.array([0.0, 0.0, 5.0]), v)[0] - structure.split(p, x, v)[0]
    np.testing.assert_allclose(moved, [0.0, 0.0, 5.0], atol=1e-12)


def test_more_integrators_than_states_are_refused() -> None:
    with pytest.raises(UserError, match="integrators"):
        linear.Config(order=1, integrators=2)


@pytest.mark.slow
def test_integrators_are_seen_in_records_that_drift_and_in_no_others() -> None:
    assert integrating([motor(100)]) == (0,)
    assert integrating([motor(101, 3000), motor(102, 200)]) == (0,)
    assert integrating([duffing_record(400, 100, 0.003)]) == ()
    assert integrating([record(sliding, 2, 100)]) == ()


def test_what_forgets_is_not_offered_and_a_first_model_integrates() -> None:
    drifting, still = of_records(motor(100)), of_records(duffing_record(400, 100))
    for name, suits in (("cnn", False), ("transformer", False), ("neural_ss", True)):
        row = family(name)
        assert row is not None
        assert row.suits(drifting) == suits
        assert row.suits(still)
    for name in ("linear", "neural_ss"):
        row = family(name)
        assert row is not None
        assert row.trial(drifting).get("integrators") == 1
        assert not row.trial(still).has("integrators")
