"""Delays, plug flow and lags in equations."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from asia.candidate import Context, simulate_steps
from asia.data import Array, Signal, Trajectory
from asia.errors import UserError
from asia.models import greybox, physics_net
from asia.models._equations.fit import FittedEquations
from asia.models._equations.simulate import Scales, simulate
from asia.models._least_squares import LevenbergMarquardt
from asia.problem import ParameterRange, Physics
from tests.unit.models.systems.memory import CONTEXT, PHYSICS, inputs, remembering

STEP = 0.5


def simulated(outputs: dict[str, str], u: Array, dynamics: str = "-x", x0: float = 0.0) -> Array:
    """Outputs (T, ny) of equations without parameters in a state x and inputs q and s."""
    physics = Physics(("x",), {"x": dynamics}, observation=outputs)
    signals = tuple(map(Signal, outputs))
    context = Context((Signal("q"), Signal("s")), signals, STEP, 0, 0, physics=physics)
    structure = greybox.build(greybox.Config(substeps=4), context).structure
    structure = replace(structure, memory=(len(u),) * len(structure.equations.delays))
    nx, ny = structure.nx, structure.ny
    ones = [np.ones((n, 1)) for n in (nx, nx, nx, nx, 2, 2, ny)]
    limits = np.full((nx, 1), -1e9), np.full((nx, 1), 1e9)
    scales = Scales(*ones, *limits, np.zeros((0, structure.nx_own + 3, 1)))
    start = np.full((nx, 1, 1), x0)
    y, _ = simulate(structure, scales, np.zeros((0, 1)), start, u[:, :, None])
    return y[:, :, 0, 0]


def test_a_constant_delay_is_linear_between_samples() -> None:
    u = inputs(60)
    u[:, 0] = 0.8
    found = simulated(
        {"a": "delay(s, 1.25)", "b": "plug_flow(s, q, 1.25*q)", "c": "delay(s, 0)"}, u
    )
    s = np.concatenate([np.repeat(u[:1, 1], 3), u[:, 1]])
    assert found[:, 0] == pytest.approx(0.5 * (s[1:-2] + s[:-3]), abs=1e-12)
    assert found[:, 1] == pytest.approx(found[:, 0], abs=1e-9)
    assert found[:, 2] == pytest.approx(u[:, 1], abs=1e-12)


def test_what_enters_a_plug_flow_stays_inside_or_leaves() -> None:
    u = inputs(200)
    u[90:95, 0] = 0.0
    u[95:100, 0] = -1.0
    y = simulated({"out": "plug_flow(s, q, 3)", "mean": "plug_mean(s, q, 3)"}, u)
    entered = STEP * np.maximum(u[:-1, 0], 0.0) * (u[:-1, 1] - y[:-1, 0])
    assert 3.0 * np.diff(y[:, 1]) == pytest.approx(entered, abs=1e-7)
    assert np.abs(np.diff(y[:, 1])).max() > 0.1


def test_the_residence_time_follows_the_flow() -> None:
    """A ramp leaves late by the time in which the flow filled the volume."""
    time = STEP * np.arange(400)
    u = np.stack([1.0 + 0.5 * np.sin(0.05 * time), time], axis=1)
    y = simulated({"out": "plug_flow(s, q, 7)"}, u)
    passed = STEP * np.concatenate([[0.0], np.cumsum(u[:, 0])])
    middle = 0.5 * (passed[1:] + passed[:-1]) - 7.0
    entered = np.interp(middle, 0.5 * (passed[1:] + passed[:-1]), time)
    assert y[40:, 0] == pytest.approx(entered[40:], abs=0.2 * STEP)


def test_a_lag_answers_a_step_exponentially() -> None:
    u = np.zeros((40, 2))
    u[:, 1] = 2.0
    y = simulated({"y": "lag(s, 3)"}, u)
    assert y[:, 0] == pytest.approx(2.0 * (1.0 - np.exp(-STEP * np.arange(40) / 3.0)), abs=1e-6)


@pytest.mark.parametrize("spread", [0.0, 0.02, 0.1])
def test_dispersion_is_the_variance_of_the_residence_time(spread: float) -> None:
    u = np.zeros((400, 2))
    u[:, 0], u[100:, 1] = 1.0, 1.0
    y = simulated({"y": f"plug_flow(s, q, 20, {spread})"}, u)[:, 0]
    density, time = np.diff(y), STEP * np.arange(-99, 300)
    mean = density @ time
    variance = density @ (time - mean) ** 2
    assert density.sum() == pytest.approx(1.0, abs=1e-3)
    assert mean == pytest.approx(20.0, abs=0.6)
    assert variance / 400.0 == pytest.approx(2.0 * spread, abs=0.003)


@pytest.mark.parametrize("spread", [0.0, 0.02, 0.1])
def test_dispersion_keeps_more_of_the_past_inside(spread: float) -> None:
    """The mean of a step lacks half of the second moment of the volume, over its mean."""
    u = np.zeros((400, 2))
    u[:, 0], u[100:, 1] = 1.0, 1.0
    y = simulated({"y": f"plug_mean(s, q, 20, {spread})"}, u)[:, 0]
    lacking = STEP * (1.0 - y[100:]).sum() - 0.5 * STEP
    assert y[-1] == pytest.approx(1.0, abs=1e-9)
    assert lacking == pytest.approx(10.0 * (1.0 + 2.0 * spread), abs=0.01)


def test_a_lag_of_an_input_that_enters_a_delay_is_no_state() -> None:
    u = np.zeros((40, 2))
    u[1:, 1] = 2.0
    y = simulated({"y": "delay(lag(s, 3), 0)", "constant": "plug_flow(4, q, 3)"}, u)
    edges = np.exp(-STEP * np.arange(40) / 3.0)
    # The mean of the exponential over each step.
    assert y[1:, 0] == pytest.approx(2.0 + 2.0 * 3.0 / STEP * np.diff(edges), abs=1e-9)
    assert y[:, 1] == pytest.approx(4.0)
    physics = replace(PHYSICS, observation={**PHYSICS.observation, "y0": "delay(lag(u1, dead), 1)"})
    model = greybox.build(greybox.Config(), replace(CONTEXT, physics=physics))
    assert model.structure.equations.states == ("x", "lag 1")


def test_a_delayed_state_feeds_back_to_second_order() -> None:
    """x' = -x(t - 1) from a constant past of 1, by the method of steps."""
    errors: list[float] = []
    for factor in (1, 2):
        u = np.zeros((6 * factor + 1, 2))
        # Time is counted in half samples where there are twice as many.
        found = simulated({"y": "x"}, u, f"-delay(x, {factor})/{factor}", 1.0)[:, 0]
        time = STEP / factor * np.arange(len(u))
        late = np.maximum(time - np.array([[0.0], [1.0], [2.0]]), 0.0)
        exact = 1.0 - late[0] + late[1] ** 2 / 2.0 - late[2] ** 3 / 6.0
        errors.append(float(np.abs(found - exact).max()))
    assert 1e-6 < errors[1] < 0.3 * errors[0] < 0.01


def test_steps_simulate_as_whole_records_do() -> None:
    model, u = remembering(), inputs(80)
    past_u, past_y = inputs(3, 1)[None], np.random.default_rng(2).standard_normal((1, 3, 2))
    expected = model.simulate(past_u, past_y, u[None])[0]
    state, found = model.initial(past_u, past_y, u[None, 0]), list[Array]()
    for sample in u:
        state, y = model.step(state, sample[None])
        found.append(y[0])
    assert np.abs(expected).max() > 1.0
    assert np.array(found) == pytest.approx(expected, abs=1e-9)


def test_gradients_agree_with_finite_differences() -> None:
    model, rng = remembering(), np.random.default_rng(3)
    assert isinstance(model.fitted, FittedEquations)
    structure, scales = model.structure, model.fitted.scales.for_rows()
    z, u = model.fitted.z[:, None], inputs(120)[:, :, None]
    x0 = rng.standard_normal((structure.nx, 1, 1))
    weights = rng.standard_normal((120, 2, 1, 1))

    def total(z, x0):
        return (weights * simulate(structure, scales, z, x0, u)[0]).sum()

    with jax.enable_x64(True):
        by_z, by_x = jax.grad(
            lambda z, x0: (weights * simulate(structure, scales, z, x0, jnp.asarray(u))[0]).sum(),
            (0, 1),
        )(jnp.asarray(z), jnp.asarray(x0))
    move = 1e-6
    for i in range(len(z)):
        way = move * np.eye(len(z))[:, [i]]
        slope = (total(z + way, x0) - total(z - way, x0)) / (2.0 * move)
        assert float(by_z[i, 0]) == pytest.approx(slope, rel=1e-5, abs=1e-5)
    for i in range(len(x0)):
        way = move * np.eye(len(x0))[:, [i], None]
        slope = (total(z, x0 + way) - total(z, x0 - way)) / (2.0 * move)
        assert float(by_x[i, 0, 0]) == pytest.approx(slope, rel=1e-5, abs=1e-5)


def test_a_fit_finds_volume_and_dead_time() -> None:
    physics = Physics(
        ("x",),
        {"x": "(plug_flow(u1, k*u0, 2) - x)/2"},
        {"k": ParameterRange(0.2, 3.0), "dead": ParameterRange(0.2, 5.0)},
        observation={"y0": "delay(x, dead)"},
    )
    context = replace(CONTEXT, outputs=(Signal("y0"),), n_past_u=8, n_past_y=8, physics=physics)
    u, noise = inputs(200), np.random.default_rng(4).normal(scale=0.01, size=(200, 1))
    y = simulated(
        {"y": "delay(x, 1.7)"},
        np.stack([u[:, 0], u[:, 1]], axis=1),
        "(plug_flow(s, 0.7*q, 2) - x)/2",
    )
    record = Trajectory(u, y + noise, STEP)
    model = greybox.build(greybox.Config(), context)
    model = greybox.train(model, [record], context, LevenbergMarquardt(iterations=20, starts=2))
    found = model.parameters()
    assert found["k"] == pytest.approx(0.7, rel=0.02)
    assert found["dead"] == pytest.approx(1.7, abs=0.05)
    # The buffer of the constant delay holds it, and no more.
    assert sorted(model.structure.memory)[0] == int(np.ceil(found["dead"] / STEP)) + 2
    assert "y0 = delay(x, 1." in "\n".join(model.equations())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"observation": {"y0": "delay(u1, x)"}}, "depend on inputs and parameters only"),
        ({"observation": {"y0": "delay(u1)"}}, "delay takes 2 plain arguments"),
        ({"observation": {"y0": "plug_flow(u1, u0)"}}, "takes 3 or 4 plain arguments"),
    ],
)
def test_what_a_delay_cannot_do_is_refused(change: dict[str, dict[str, str]], message: str) -> None:
    physics = replace(PHYSICS, **{k: {**getattr(PHYSICS, k), **v} for k, v in change.items()})
    with pytest.raises(UserError, match=message):
        greybox.build(greybox.Config(), replace(CONTEXT, physics=physics))


def test_a_prior_remembers_nothing() -> None:
    config = greybox.Config(priors=(("delay(a, dead)", 1.0, 0.1, ""),))
    with pytest.raises(UserError, match="delay remembers past samples"):
        greybox.build(config, CONTEXT)


def test_networks_of_measured_states_refuse_delays() -> None:
    with pytest.raises(UserError, match="the equations delay a signal; use greybox"):
        physics_net.build(physics_net.Config(), CONTEXT)


def test_delays_need_held_inputs_and_lags_do_not() -> None:
    u = np.random.default_rng(0).normal(size=(60, 1))
    record = Trajectory(u, u, STEP, "r")
    config, method = greybox.Config(intersample="first"), LevenbergMarquardt(1, starts=1)
    for term in ("delay(u, k)", "plug_flow(u, 1, k)", "plug_mean(u, 1, k)", "lag(u, k)"):
        physics = Physics(("y",), {"y": f"{term} - y"}, {"k": ParameterRange(0.5, 2.0)})
        context = Context((Signal("u"),), (Signal("y"),), STEP, 2, 2, physics=physics)
        model = greybox.build(config, context)
        if term == "lag(u, k)":
            trained = greybox.train(model, [record], context, method)
            assert trained.structure.between.kinds == ("first",)
            past_u, past_y, later = u[None, :2], u[None, :2], u[None, 2:]
            y = trained.simulate(past_u, past_y, later)
            assert simulate_steps(trained, past_u, past_y, later) == pytest.approx(y, abs=1e-10)
        else:
            with pytest.raises(UserError, match="need inputs that are held"):
                greybox.train(model, [record], context, method)
