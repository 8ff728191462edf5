"""Terms that equations lack are found by the simulation error."""

from __future__ import annotations

import cloudpickle
import numpy as np
import pytest

from asia.data import Array, Trajectory
from asia.models import greybox
from asia.models._least_squares import LevenbergMarquardt
from asia.problem import ParameterRange, Physics
from tests.unit.models.systems.equations import context_for, held_steps
from tests.unit.models.systems.friction import DRIVE, Slope, stepped

METHOD = LevenbergMarquardt(iterations=40, starts=2)
NOISE = 0.005
# Of what is used up, the second equation lacks it.
REACTION = Physics(
    ("a", "b"),
    {"a": "u - k*a - r*a*b", "b": "2*u - d*b"},
    {n: ParameterRange(0.1, 2.0) for n in "krd"},
    observation={"y": "a", "z": "b"},
)


def reacting(x: Array, u: float) -> Array:
    """Two substances that are fed, decay, and use each other up."""
    a, b = x
    return np.array([u - 0.5 * a - 0.8 * a * b, 2.0 * u - 0.7 * b - 0.8 * a * b])


def stiffening(x: Array, u: float) -> Array:
    """A mass on a spring that stiffens."""
    q, v = x
    return np.array([v, 2.0 * u - 0.6 * v - 2.0 * q - 1.5 * q**3])


def dragged(x: Array, u: float) -> Array:
    """A mass on a spring in a fluid, whose drag is quadratic."""
    q, v = x
    return np.array([v, 2.0 * u - 0.2 * v - 2.0 * q - 0.8 * v * abs(v)])


def linear(x: Array, u: float) -> Array:
    """A mass on a spring, as its equations say."""
    q, v = x
    return np.array([v, 2.0 * u - 0.6 * v - 2.0 * q])


def record(slope: Slope, seed: int, length: int = 600) -> Trajectory:
    """The position, with noise."""
    u = held_steps(length, seed, -2.0, 2.0)
    y = stepped(slope, u, 2, 0.1, substeps=10)[:, :1]
    y = y + NOISE * y.std() * np.random.default_rng(seed).normal(size=y.shape)
    return Trajectory(u=u, y=y, sampling_time=0.1)


def fitted(train: Trajectory, **config) -> greybox.GreyBox:
    context = context_for(DRIVE, "u", "y", 0.1)
    model = greybox.build(greybox.Config(ridge=1e-6, **config), context)
    return greybox.train(model, [train], context, METHOD)


def error(model: greybox.GreyBox, new: Trajectory) -> float:
    """Simulation error of a record, in deviations of its output."""
    y = model.simulate(new.u[None, :5], new.y[None, :5], new.u[None, 5:])[0]
    return float(np.sqrt(np.mean((y - new.y[5:]) ** 2)) / new.y.std())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("truth", "name", "number"),
    [(stiffening, "v: q**3", -1.5), (dragged, "v: v * abs(v)", -0.8)],
)
def test_the_term_that_is_missing_is_found(truth: Slope, name: str, number: float) -> None:
    train, new = record(truth, 1), record(truth, 2)
    model = fitted(train, discover=("v",))
    assert model.parameters()[name] == pytest.approx(number, rel=0.1)
    assert error(model, new) < 3.0 * NOISE < error(fitted(train), new)
    assert name.removeprefix("v: ") in "".join(model.equations())


def test_what_lacks_nothing_gets_nothing() -> None:
    train = record(linear, 1)
    assert fitted(train, discover=("v",)).parameters() == fitted(train).parameters()


def test_products_of_two_states_are_found_in_the_equation_that_lacks_them() -> None:
    u = held_steps(500, 3, 0.1, 1.0)
    states = stepped(reacting, u, 2, 0.1, substeps=10)
    y = states + NOISE * states.std() * np.random.default_rng(3).normal(size=states.shape)
    context = context_for(REACTION, "u", "y z", 0.1)
    config = greybox.Config(ridge=1e-6, discover=("a", "b"))
    train = [Trajectory(u=u, y=y, sampling_time=0.1)]
    model = greybox.train(greybox.build(config, context), train, context, METHOD)
    found = {k: v for k, v in model.parameters().items() if ":" in k}
    assert found == pytest.approx({"b: a * b": -0.8}, rel=0.05)


@pytest.mark.slow
def test_a_model_with_terms_is_kept_and_tells_of_them() -> None:
    train = record(stiffening, 1)
    model = fitted(train, discover=("v",), most_terms=1)
    kept = cloudpickle.loads(cloudpickle.dumps(model))
    assert error(kept, train) == error(model, train)
    told = model.estimates([train], context_for(DRIVE, "u", "y", 0.1))
    term = next(p for p in told.parameters if p.name == "v: q**3")
    assert term.low < -1.5 < term.high


@pytest.mark.parametrize(
    "config", [{"most_terms": 0}, {"discover": ("q",), "residual": 2}, {"discover": ("z",)}]
)
def test_settings_that_make_no_sense(config: dict) -> None:
    with pytest.raises(ValueError, match=r"greybox\.Config"):
        greybox.build(greybox.Config(**config), context_for(DRIVE, "u", "y", 0.1))
