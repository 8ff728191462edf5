"""Elements of friction and of play in neural state-space models."""

from __future__ import annotations

import cloudpickle
import numpy as np
import pytest

from asia.data import Trajectory
from asia.models import neural_ss
from asia.models._least_squares import LevenbergMarquardt
from asia.models._state_space.structure import lost, resisted
from asia.models.methods import Adam
from tests.unit.models.systems.equations import context_for
from tests.unit.models.systems.friction import backlash, bristle, record, sticking, yielding

CONTEXT = context_for(None, "u", "y", 0.1, n_past_u=10, n_past_y=10)
NOISE = 0.003


def fitted(
    train: Trajectory, method: LevenbergMarquardt | Adam | None = None, **config
) -> neural_ss.NeuralStateSpace:
    model = neural_ss.build(neural_ss.Config(**config), CONTEXT)
    return neural_ss.train(model, [train], CONTEXT, method or LevenbergMarquardt(60, starts=3))


def error(model: neural_ss.NeuralStateSpace, new: Trajectory) -> float:
    """Simulation error of a record, in deviations of its output."""
    y = model.simulate(new.u[None, :10], new.y[None, :10], new.u[None, 10:])[0]
    return float(np.sqrt(np.mean((y - new.y[10:]) ** 2)) / new.y.std())


@pytest.mark.long
def test_a_mass_that_sticks_is_followed() -> None:
    train, new = (record(sticking, 1, seed, samples=800) for seed in (101, 102))
    model = fitted(train, order=1, nonlinearity="none", friction=1)
    assert error(model, new) < 0.03
    assert error(fitted(train, order=1, nonlinearity="none"), new) > 0.2


@pytest.mark.long
@pytest.mark.parametrize(("system", "most"), [(bristle, 0.015), (yielding, 0.04)])
def test_presliding_and_bouc_wen_are_followed(system, most: float) -> None:
    train, new = (record(system, 3, seed, samples=800) for seed in (101, 102))
    model = fitted(train, order=2, nonlinearity="none", friction=1)
    assert error(model, new) < most
    assert error(fitted(train, order=2, nonlinearity="none"), new) > 3.0 * most


@pytest.mark.slow
def test_a_play_of_the_input_is_found() -> None:
    train, new = backlash(100), backlash(101)
    assert error(fitted(train, order=1, nonlinearity="none", play=1), new) < 2.0 * NOISE
    assert error(fitted(train, order=1, nonlinearity="none"), new) > 0.1


@pytest.mark.parametrize("element", ["friction", "play"])
def test_a_model_starts_as_the_linear_one_and_comes_back_from_bytes(element: str) -> None:
    train = backlash(100, samples=200)
    method = LevenbergMarquardt(0)
    plain = fitted(train, method, order=2)
    model = fitted(train, method, order=2, **{element: 2})
    case = train.u[None, :10], train.y[None, :10], train.u[None, 10:]
    # The encoder is fitted to more states, so that simulations start a little apart.
    parts = model.simulate(*case)[:, 100:], plain.simulate(*case)[:, 100:]
    np.testing.assert_allclose(*parts, atol=1e-2)
    again = cloudpickle.loads(cloudpickle.dumps(model))
    assert np.array_equal(again.simulate(*case), model.simulate(*case))


def test_adam_trains_a_model_with_elements() -> None:
    train = backlash(100, samples=300)
    few = fitted(train, Adam(steps=1), order=1, nonlinearity="none", play=1)
    many = fitted(train, Adam(steps=300), order=1, nonlinearity="none", play=1)
    assert error(many, train) < error(few, train)


def test_friction_holds_a_state_still_under_small_loads() -> None:
    p = {
        "w": np.array([[10.0]]), "b": np.zeros(1), "g": np.array([[0.5]]), "stiff": np.full(1, 6.0),
        "uneven": np.zeros(1), "extra": np.zeros(1), "narrow": np.zeros(1),
    }  # fmt: skip
    held, force = resisted(p, np.zeros(1), np.zeros(1), np.array([0.3]))
    assert abs(held[0]) < 1e-2
    assert force[0] == pytest.approx(0.6, rel=0.02)
    slid, force = resisted(p, np.zeros(1), np.zeros(1), np.array([-0.9]))
    assert slid[0] == pytest.approx(-0.4)
    assert force[0] == -1.0


def test_play_takes_what_lies_within_its_width() -> None:
    p = {"w": np.zeros((1, 1)), "wu": np.array([[2.0]])}
    behind, followed = np.zeros(1), []
    for u in (0.25, 1.5, 1.25, 0.25):
        missed, behind = lost(p, np.zeros(1), np.array([u]), behind)
        assert missed[0] == pytest.approx(2.0 * u - behind[0])
        followed.append(float(behind[0]))
    assert followed == pytest.approx([0.0, 2.0, 2.0, 1.5])
