"""Outputs that are an absolute value or a rectified state, as a tachometer without sign gives."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from asia.data import Array, Trajectory
from asia.models import greybox
from asia.models._equations.ode import equations
from asia.models._least_squares import LevenbergMarquardt
from asia.problem import ParameterRange, Physics
from tests.unit.models.systems.equations import context_for, held_steps, simulated

MAPS = {"abs(v)": np.abs, "max(v, 0)": lambda v: np.maximum(v, 0.0)}


def drive(output: str) -> Physics:
    """A motor whose speed reverses."""
    return Physics(
        ("v",),
        {"v": "-a*v + b*u"},
        {"a": ParameterRange(0.05, 10.0), "b": ParameterRange(0.05, 10.0)},
        observation={"y": output},
    )


def record(seed: int, output: str, noise: float = 0.005) -> Trajectory:
    def rate(x: Array, u: Array) -> Array:
        return np.array([-0.8 * x[0] + 1.5 * u[0]])

    u = held_steps(300, seed, -1.5, 1.5, hold=10)
    v = simulated(rate, u, np.zeros(1), 0.2)
    y = MAPS[output](v) + noise * np.random.default_rng(seed).normal(size=v.shape)
    return Trajectory(u, y, 0.2, f"run{seed}")


@pytest.mark.parametrize("output", MAPS)
def test_parameters_are_found_from_an_output_without_sign(output: str) -> None:
    train, new = record(100, output), record(101, output, noise=0.0)
    context = context_for(drive(output), "u", "y", 0.2, n_past_u=20, n_past_y=20)
    model = greybox.build(greybox.Config(ridge=1e-6), context)
    model = greybox.train(model, [train], context, LevenbergMarquardt(40, starts=4))
    assert model.parameters() == pytest.approx({"a": 0.8, "b": 1.5}, rel=0.03)
    assert model.structure.measured_states == {}
    y = model.simulate(new.u[None, :20], new.y[None, :20], new.u[None, 20:])[0]
    assert np.sqrt(np.mean((y - new.y[20:]) ** 2)) < 0.02


@pytest.mark.parametrize("output", MAPS)
def test_derivatives_are_finite_at_the_corner(output: str) -> None:
    system = equations(drive(output), ["u"], ["y"])

    def observed(v: jax.Array) -> jax.Array:
        return system.observe(np.ones((2, 1)), v, np.zeros((1, 1)))[0, 0]

    slope = jax.grad(observed)
    with jax.enable_x64(True):
        found = [float(slope(jax.numpy.array([[v]]))[0, 0]) for v in (-1.0, 0.0, 2.0)]
    assert found[0] == (-1.0 if output == "abs(v)" else 0.0)
    assert abs(found[1]) <= 1.0
    assert found[2] == 1.0
