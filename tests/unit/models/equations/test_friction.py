"""Dry friction, hysteresis and play written into equations that lack them."""

from __future__ import annotations

import cloudpickle
import numpy as np
import pytest

from asia.data import Trajectory
from asia.errors import UserError
from asia.models import greybox, hybrid
from asia.models._least_squares import LevenbergMarquardt
from asia.problem import ParameterRange, Physics
from tests.unit.models.systems.equations import context_for
from tests.unit.models.systems.friction import (
    DRIVE,
    MASS,
    backlash,
    bristle,
    record,
    sliding,
    sticking,
    yielding,
)

METHOD = LevenbergMarquardt(iterations=60, starts=4)
NOISE = 0.003
LAG = Physics(
    ("x",),
    {"x": "-a*x + b*u"},
    {"a": ParameterRange(0.05, 20.0), "b": ParameterRange(0.05, 20.0)},
    observation={"y": "x"},
)


def fitted(physics: Physics, train: Trajectory, **config) -> greybox.GreyBox:
    context = context_for(physics, "u", "y", 0.1)
    model = greybox.build(greybox.Config(ridge=1e-6, **config), context)
    return greybox.train(model, [train], context, METHOD)


def error(model: greybox.GreyBox, new: Trajectory) -> float:
    """Simulation error of a record, in deviations of its output."""
    y = model.simulate(new.u[None, :5], new.y[None, :5], new.u[None, 5:])[0]
    return float(np.sqrt(np.mean((y - new.y[5:]) ** 2)) / new.y.std())


@pytest.mark.long
def test_stick_slip_with_uneven_friction_is_found() -> None:
    train, new = (record(sliding, 2, seed) for seed in (100, 101))
    model = fitted(DRIVE, train, friction=("v",), substeps=8)
    assert error(model, new) < 3.0 * NOISE
    assert error(fitted(DRIVE, train), new) > 0.1
    found = model.parameters()
    assert found["b"] == pytest.approx(2.0, rel=0.02)
    assert found["k"] == pytest.approx(2.0, rel=0.02)
    # 1 in one direction and 0.7 in the other.
    ratio = found["v dry asymmetry"] / found["v dry friction"]
    assert ratio == pytest.approx(0.15 / 0.85, abs=0.08)
    assert not {"v rate", "v low"} & set(found)


@pytest.mark.long
def test_a_mass_that_sticks_is_followed_by_its_measured_velocity() -> None:
    train, new = (record(sticking, 1, seed) for seed in (100, 101))
    assert error(fitted(MASS, train, friction=("v",), substeps=8), new) < 2.0 * NOISE
    assert error(fitted(MASS, train), new) > 0.1


@pytest.mark.long
def test_friction_that_gives_way_before_it_slides() -> None:
    train, new = (record(bristle, 3, seed) for seed in (100, 101))
    model = fitted(DRIVE, train, friction=("v",), presliding=True)
    assert error(model, new) < 2.0 * NOISE
    assert model.parameters()["c"] == pytest.approx(0.3, abs=0.05)
    assert error(fitted(DRIVE, train, friction=("v",)), new) > 0.02


@pytest.mark.long
def test_a_bouc_wen_force_is_found() -> None:
    train, new = (record(yielding, 3, seed) for seed in (100, 101))
    model = fitted(DRIVE, train, hysteresis=("v",))
    assert error(model, new) < 2.0 * NOISE
    found = model.parameters()
    for name, truth in (("b", 2.0), ("c", 0.3), ("k", 1.0)):
        assert found[name] == pytest.approx(truth, rel=0.05)
    assert error(fitted(DRIVE, train), new) > 0.1


def test_the_width_of_a_play_is_found() -> None:
    train, new = backlash(100), backlash(101)
    model = fitted(LAG, train, play=("u",))
    assert error(model, new) < 0.3 * error(fitted(LAG, train), new)
    span = float(np.ptp(train.u))
    assert model.parameters()["u play"] * span == pytest.approx(0.5, rel=0.1)


@pytest.mark.slow
def test_a_hybrid_takes_friction_in_its_base_and_comes_back_from_bytes() -> None:
    context = context_for(MASS, "u", "y", 0.1)
    train = record(sticking, 1, 100, samples=200)
    base = greybox.Config(friction=("v",), hysteresis=("v",))
    model = hybrid.build(hybrid.Config(base, units=2), context)
    model = hybrid.train(model, [train], context, LevenbergMarquardt(iterations=5, starts=2))
    again = cloudpickle.loads(cloudpickle.dumps(model))
    case = train.u[None, :5], train.y[None, :5], train.u[None, 5:]
    assert np.array_equal(model.simulate(*case), again.simulate(*case))


def test_simulations_far_outside_the_training_range_are_finite() -> None:
    train = record(bristle, 3, 100, samples=200)
    context = context_for(DRIVE, "u", "y", 0.1)
    config = greybox.Config(friction=("v",), presliding=True, hysteresis=("v",), play=("u",))
    method = LevenbergMarquardt(iterations=3, starts=2)
    model = greybox.train(greybox.build(config, context), [train], context, method)
    wild = 1e3 * train.u[None]
    assert np.isfinite(model.simulate(wild[:, :5], train.y[None, :5], wild)).all()


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="presliding needs a velocity"):
        greybox.Config(presliding=True)
    with pytest.raises(ValueError, match="a lag or a play"):
        greybox.Config(lag=("u",), play=("u",))
    with pytest.raises(ValueError, match="friction names 'w', known are q, v"):
        greybox.build(greybox.Config(friction=("w",)), context_for(DRIVE, "u", "y", 0.1))
    hidden = greybox.Config(hysteresis=("v",), initial="measured")
    with pytest.raises(UserError, match="does not show every state"):
        greybox.build(hidden, context_for(MASS, "u", "y", 0.1))
