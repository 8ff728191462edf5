"""Additions of a grey-box to the equations: sensors, lags, smooth corrections, priors."""

from __future__ import annotations

from dataclasses import replace

import cloudpickle
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from asia.data import Array, Trajectory
from asia.errors import UserError
from asia.models import greybox
from asia.models._equations.config import GreyBoxStructure, Sensor
from asia.models._equations.extension import extended
from asia.models._equations.simulate import Scales, simulate
from asia.models._equations.starts import cut_segments
from asia.models._least_squares import LevenbergMarquardt
from asia.problem import Bounds, ParameterRange, Physics, Prior
from tests.unit.models.systems.equations import TANKS, context_for, held_steps, simulated

NOISE = 0.005
METHOD = LevenbergMarquardt(iterations=40, starts=3)
DECAY = Physics(
    ("x",),
    {"x": "-a*x + b*u"},
    {"a": ParameterRange(0.05, 2.0), "b": ParameterRange(0.05, 2.0)},
    observation={"y": "x"},
    bounds={"x": Bounds(0.0, 1.0)},
)
CASCADE = Physics(
    ("x1", "x2"),
    {"x1": "-a*x1 + a*u", "x2": "-b*x2 + b*x1"},
    {"a": ParameterRange(0.05, 2.0), "b": ParameterRange(0.05, 2.0)},
    observation={"y": "x2"},
)
DECAY_CONTEXT = context_for(DECAY, "u", "y", 1.0)
CASCADE_CONTEXT = context_for(CASCADE, "u", "y", 1.0)


def record(rate, seed: int, nx: int, sensor=lambda y: y, high: float = 0.9) -> Trajectory:
    """150 samples of the last state, through a sensor, with a little noise."""
    u = held_steps(150, seed, 0.05, high, hold=10)
    x = simulated(rate, u, np.full(nx, 0.4), 1.0)
    noise = np.random.default_rng(seed).normal(scale=NOISE, size=(150, 1))
    return Trajectory(u, sensor(x[:, -1:]) + noise, 1.0)


def decay(x: Array, u: Array) -> Array:
    return np.array([-0.3 * x[0] + 0.3 * u[0]])


def bent(y: Array) -> Array:
    """A sensor that is flat at the bottom."""
    return 0.1 + 0.9 * y**2


def fitted(config: greybox.Config, context, *records: Trajectory) -> greybox.GreyBox:
    return greybox.train(greybox.build(config, context), records, context, METHOD)


def error(model: greybox.GreyBox, new: Trajectory) -> float:
    y = model.simulate(new.u[None, :5], new.y[None, :5], new.u[None, 5:])[0]
    return float(np.sqrt(np.mean((y - new.y[5:]) ** 2)))


@pytest.mark.parametrize("kind", ["power", "spline"])
def test_a_bent_sensor_is_found(kind: Sensor) -> None:
    train, new = (record(decay, seed, 1, bent) for seed in (0, 1))
    plain = fitted(greybox.Config(), DECAY_CONTEXT, train)
    model = fitted(greybox.Config(sensor=kind, ridge=1e-6), DECAY_CONTEXT, train)
    assert error(model, new) < 2.0 * NOISE
    assert error(model, new) < 0.3 * error(plain, new)
    assert model.parameters()["a"] == pytest.approx(0.3, rel=0.1)
    if kind == "power":
        assert model.parameters()["y power"] == pytest.approx(2.0, rel=0.15)
        assert model.parameters()["y zero"] == pytest.approx(0.1, abs=0.03)


def test_a_curve_of_the_sensor_rises_everywhere() -> None:
    model = fitted(greybox.Config(sensor="spline"), DECAY_CONTEXT, record(decay, 0, 1))
    structure = model.structure
    rng = np.random.default_rng(0)
    span = np.linspace(0.0, 1.2, 200)[None]
    for _ in range(20):
        bends = structure.learned.values(3.0 * rng.normal(size=(len(structure.learned.names), 1)))
        parameters = np.concatenate([np.ones((2, 1)), bends])
        y = structure.equations.observe(parameters, span, np.zeros((1, 200)))[0]
        assert (np.diff(y) > 0).all() or (np.diff(y) < 0).all()


def late(x: Array, u: Array) -> Array:
    """Two first-order systems, the way between them a lag of 3 s."""
    return np.array([0.3 * (u[0] - x[0]), (x[0] - x[1]) / 3.0, 0.2 * (x[1] - x[2])])


def test_a_lag_between_two_states_is_found() -> None:
    train, new = (record(late, seed, 3) for seed in (0, 1))
    model = fitted(greybox.Config(lag=("x1",), ridge=1e-6), CASCADE_CONTEXT, train)
    plain = fitted(greybox.Config(), CASCADE_CONTEXT, train)
    assert error(model, new) < 1.5 * NOISE
    assert error(model, new) < 0.5 * error(plain, new)
    slow = sorted(1.0 / model.parameters()[name] for name in ("a", "b"))
    assert sorted([*slow, model.parameters()["x1 lag"]]) == pytest.approx(
        [3.0, 1 / 0.3, 5.0], rel=0.35
    )


def test_a_lagged_input_acts_late() -> None:
    """A pump that follows its command in 4 s."""

    def rate(x: Array, u: Array) -> Array:
        return np.array([(u[0] - x[0]) / 4.0, 0.3 * x[0] - 0.3 * x[1]])

    train, new = (record(rate, seed, 2) for seed in (0, 1))
    model = fitted(greybox.Config(lag=("u",), ridge=1e-6), DECAY_CONTEXT, train)
    assert error(model, new) < 1.5 * NOISE
    # Two lags in a row have no order.
    times = sorted([model.parameters()["u lag"], 1.0 / model.parameters()["a"]])
    assert times == pytest.approx([1 / 0.3, 4.0], rel=0.3)


def test_a_smooth_correction_finds_how_a_signal_enters() -> None:
    """An inflow that goes with u * (0.7 + 0.6 u), where the equations have it in proportion."""

    def rate(x: Array, u: Array) -> Array:
        return np.array([-0.3 * x[0] + 0.3 * u[0] * (0.7 + 0.6 * u[0])])

    train, new = (record(rate, seed, 1) for seed in (0, 1))
    plain = fitted(greybox.Config(), DECAY_CONTEXT, train)
    config = greybox.Config(smooth=("u",), smooth_width=0.5, ridge=1e-6)
    model = fitted(config, DECAY_CONTEXT, train)
    assert error(model, new) < 2.0 * NOISE
    assert error(model, new) < 0.5 * error(plain, new)
    held = fitted(replace(config, smooth_width=1e-4), DECAY_CONTEXT, train)
    assert error(held, new) == pytest.approx(error(plain, new), rel=0.05)


ALL = greybox.Config(
    saturation=("x1",), spill=True, offset=("x1", "level"), linear=True, sensor="spline",
    lag=("x1", "pump"), smooth=("x2", "pump"), residual=2,
)  # fmt: skip


def structure_with_everything() -> GreyBoxStructure:
    context = context_for(TANKS, "pump", "level", 1.0)
    structure = greybox.build(ALL, context).structure
    rng = np.random.default_rng(0)
    some = Trajectory(rng.uniform(0, 1, (30, 1)), rng.uniform(0, 1, (30, 1)), 1.0)
    return extended(structure, cut_segments(structure, [some], None))


def scales_of(structure: GreyBoxStructure) -> Scales:
    one = np.ones((structure.nx, 1))
    units = structure.config.residual
    return Scales(
        one, one, 2 * one, one, np.ones((1, 1)), np.ones((1, 1)), np.ones((1, 1)), -50 * one,
        50 * one, np.random.default_rng(1).normal(size=(units, structure.nx_own + 2, 1)),
    )  # fmt: skip


@pytest.mark.slow
def test_numpy_and_jax_simulate_the_same() -> None:
    structure = structure_with_everything()
    assert (structure.nx, structure.nx_own) == (4, 2)
    rng, scales = np.random.default_rng(2), scales_of(structure)
    z = 0.2 * rng.normal(size=(structure.layout.size, 1))
    x0, u = np.full((4, 1, 1), 1.0), rng.uniform(0, 1, (20, 1, 1))
    y, x = simulate(structure, scales, z, x0, u)
    with jax.enable_x64(True):
        again = Scales(*(jnp.asarray(a) for a in scales))
        y_jax, x_jax = simulate(structure, again, *(jnp.asarray(a) for a in (z, x0, u)))
    np.testing.assert_allclose(y, y_jax, rtol=1e-9)
    np.testing.assert_allclose(x, x_jax, rtol=1e-9)
    assert np.isfinite(y).all()


def test_linear_terms_and_networks_see_the_persons_states_alone() -> None:
    structure = structure_with_everything()
    layout = structure.layout
    assert layout.linear.stop - layout.linear.start == 2 * (2 + 1)
    assert layout.readout.stop - layout.readout.start == 2 * 2


def test_additions_do_nothing_at_their_prior_mean() -> None:
    """But for lags, which are never without effect."""
    context = context_for(TANKS, "pump", "level", 1.0)
    rng = np.random.default_rng(0)
    some = Trajectory(rng.uniform(0, 1, (30, 1)), rng.uniform(0, 1, (30, 1)), 1.0)
    for kind in ("power", "spline"):
        plain = greybox.build(greybox.Config(), context).structure
        config = greybox.Config(sensor=kind, smooth=("x1", "x2", "pump"))
        bare = greybox.build(config, context).structure
        full = extended(bare, cut_segments(bare, [some], None))
        x0, u = np.full((2, 1, 1), 0.5), rng.uniform(0, 1, (20, 1, 1))
        y = [
            simulate(s, scales_of(s), np.zeros((s.layout.size, 1)), x0, u)[0] for s in (plain, full)
        ]
        np.testing.assert_allclose(*y, rtol=1e-9)


TIED = replace(CASCADE, priors={"b/a": Prior(1.0, 0.05)})


def test_a_prior_decides_what_the_records_do_not_tell() -> None:
    """The records of two first-order systems in a row do not show which is the slow one."""

    def rate(x: Array, u: Array) -> Array:
        return np.array([0.4 * (u[0] - x[0]), 0.15 * (x[0] - x[1])])

    train = record(rate, 0, 2)
    for mean in (0.15 / 0.4, 0.4 / 0.15):
        physics = replace(CASCADE, priors={"b/a": Prior(mean, 0.1 * mean)})
        found = fitted(greybox.Config(), replace(CASCADE_CONTEXT, physics=physics), train)
        assert found.parameters()["b"] / found.parameters()["a"] == pytest.approx(mean, rel=0.1)


def test_the_width_of_priors_is_a_setting() -> None:
    def rate(x: Array, u: Array) -> Array:
        return np.array([0.5 * (u[0] - x[0]), 0.15 * (x[0] - x[1])])

    train = record(rate, 0, 2)
    context = replace(CASCADE_CONTEXT, physics=TIED)

    def unlike(config: greybox.Config) -> float:
        found = fitted(config, context, train).parameters()
        return abs(np.log(found["b"] / found["a"]))

    free = unlike(greybox.Config(prior_width=None))
    assert unlike(greybox.Config(ridge=1.0, prior_width=0.1)) < 0.1 * free
    assert unlike(greybox.Config(ridge=1.0, prior_width=1e4)) == pytest.approx(free, rel=0.05)
    own = greybox.Config(ridge=1.0, prior_width=1.0, priors=(("b/a", 1.0, 0.001, "alike"),))
    assert unlike(own) < 0.1 * free


def test_a_prior_of_something_else_than_parameters_is_refused() -> None:
    config = greybox.Config(priors=(("a/x1", 1.0, 0.1, "wrong"),))
    with pytest.raises(UserError, match="'x1' is no parameter, known are a, b"):
        greybox.build(config, CASCADE_CONTEXT)


def test_a_bent_sensor_does_not_show_the_state() -> None:
    physics = replace(DECAY, observation={"y": "x"})
    context = replace(context_for(physics, "u", "y", 1.0), horizon=10)
    assert greybox.build(greybox.Config(), context).structure.states_measured
    assert not greybox.build(greybox.Config(sensor="power"), context).structure.states_measured
    with pytest.raises(UserError, match="does not show every state"):
        greybox.build(greybox.Config(sensor="power", initial="measured"), context)


def test_windows_that_start_at_measured_states_can_have_a_lag() -> None:
    physics = replace(CASCADE, observation={"y1": "x1", "y2": "x2"})
    context = replace(context_for(physics, "u", "y1 y2", 1.0), horizon=20)
    u = held_steps(150, 0, 0.05, 0.9, hold=10)
    y = simulated(late, u, np.full(3, 0.4), 1.0)[:, [0, 2]]
    model = fitted(greybox.Config(lag=("x1",)), context, Trajectory(u, y, 1.0))
    # Too short a lag: a window starts as if the lag had caught up with its state.
    assert 1.2 < model.parameters()["x1 lag"] < 3.5
    with pytest.raises(UserError, match="lag of an input"):
        greybox.build(greybox.Config(lag=("u",)), context)


def test_a_model_with_everything_survives_a_pickle() -> None:
    context = context_for(TANKS, "pump", "level", 1.0)
    rng = np.random.default_rng(0)
    some = Trajectory(rng.uniform(0, 1, (40, 1)), rng.uniform(0, 1, (40, 1)), 1.0)
    quick = LevenbergMarquardt(iterations=2)
    model = greybox.train(greybox.build(ALL, context), [some], context, quick)
    case = some.u[None, :5], some.y[None, :5], some.u[None, 5:]
    again = cloudpickle.loads(cloudpickle.dumps(model))
    np.testing.assert_array_equal(model.simulate(*case), again.simulate(*case))


@pytest.mark.parametrize(
    "arguments",
    [
        {"sensor": "cubic"},
        {"smooth_width": 0.0},
        {"prior_width": 0.0},
        {"priors": (("a", 1.0, 0.0, "no width"),)},
    ],
)
def test_settings_out_of_range_are_refused(arguments) -> None:
    with pytest.raises(ValueError, match=r"greybox\.Config"):
        greybox.Config(**arguments)


@pytest.mark.parametrize("field", ["lag", "smooth"])
def test_names_that_are_no_signals_are_refused(field: str) -> None:
    with pytest.raises(ValueError, match=rf"{field} names 'speed', known are x, u"):
        greybox.build(greybox.Config(**{field: ("speed",)}), DECAY_CONTEXT)
