"""Neural state-space models."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Signal
from asia.errors import UserError
from asia.models import linear, neural_ss
from asia.models._least_squares import LevenbergMarquardt
from asia.models._linear.fit import LinearFit
from asia.models._linear.system import LinearSystem
from asia.models._numerics.encoder import affine
from asia.models._numerics.training_records import ScaledTrajectory
from asia.models._state_space.model import with_unit_states
from asia.models._state_space.structure import StateSpaceStructure
from asia.models._state_space.training import past_window_error
from asia.models.methods import Adam
from asia.problem.folds import make_folds, whole
from asia.problem.load import load_problem
from asia.search.run import search_context
from tests.unit.models.systems.black_box import Case, case, wiener


def fitted(
    config: neural_ss.Config, data: Case, method: LevenbergMarquardt | Adam
) -> neural_ss.NeuralStateSpace:
    model = neural_ss.build(config, data.context)
    return neural_ss.train(model, data.training, data.context, method)


@pytest.mark.parametrize(
    "options",
    [
        {"nonlinearity": "state"},
        pytest.param({"nonlinearity": "output"}, marks=pytest.mark.long),
        pytest.param({"nonlinearity": "both", "hidden": 5}, marks=pytest.mark.long),
        {"nonlinearity": "output", "basis": "polynomial", "degree": 5},
    ],
)
@pytest.mark.slow
def test_wiener_system_is_simulated_below_the_noise(options: dict[str, Any]) -> None:
    data = case(wiener, lengths=(800,))
    line = linear.train(
        linear.build(linear.Config(order=2), data.context), data.training, data.context
    )
    model = fitted(neural_ss.Config(order=2, **options), data, LevenbergMarquardt(60))
    assert data.ratio(model) < min(1.0, 0.5 * data.ratio(line))


@pytest.mark.parametrize("place", ["state", "modal"])
def test_no_iterations_leave_the_linear_model(place: Any) -> None:
    data = case(wiener, lengths=(150, 90))
    line = linear.train(
        linear.build(linear.Config(order=2), data.context), data.training, data.context
    )
    config = neural_ss.Config(order=2, nonlinearity=place)
    model = fitted(config, data, LevenbergMarquardt(0))
    # Initial states are read from the past by other maps: they decay in the first samples.
    found, expected = data.simulated(model), data.simulated(line)
    np.testing.assert_allclose(found[-60:], expected[-60:], rtol=1e-6)


def softening(u: np.ndarray, turn: float = 0.6, soft: float = 0.001) -> np.ndarray:
    """A lightly damped mode whose frequency falls with its amplitude."""
    x, y = np.zeros((2, u.shape[1])), np.zeros_like(u)
    for k in range(len(u)):
        y[k] = x[0]
        angle = turn / (1.0 + soft * (x**2).sum(axis=0))
        turned = np.cos(angle) * x[0] - np.sin(angle) * x[1]
        x = 0.97 * np.stack([turned + u[k], np.sin(angle) * x[0] + np.cos(angle) * x[1]])
    return y


@pytest.mark.long
def test_a_mode_whose_frequency_depends_on_its_amplitude() -> None:
    data = case(softening, lengths=(600,))
    method = LevenbergMarquardt(60)
    line = fitted(neural_ss.Config(order=2, nonlinearity="none"), data, method)
    model = fitted(neural_ss.Config(order=2, nonlinearity="modal", pieces=True), data, method)
    assert data.ratio(model) < 0.2 * data.ratio(line)


@pytest.mark.long
def test_a_mode_that_the_linear_model_takes_for_noise_is_found() -> None:
    data = case(lambda u: softening(u, 0.6, 0.003) - 0.7 * softening(u, 0.8, 0.003), lengths=(400,))
    line = linear.train(
        linear.build(linear.Config(delay=0), data.context), data.training, data.context
    )
    assert line.fitted is not None
    order = line.fitted.system.order
    assert order < 4
    open_order = neural_ss.Config(nonlinearity="modal", pieces=True, delay=0)
    method = LevenbergMarquardt(30)
    model = fitted(open_order, data, method)
    assert data.ratio(model) < 0.5 * data.ratio(
        fitted(replace(open_order, order=order), data, method)
    )


@pytest.mark.parametrize(("pole", "lost"), [(0.9, False), (1.1, True)])
def test_an_unstable_model_is_lost_from_the_state_of_the_past_window(
    pole: float, lost: bool
) -> None:
    """From the right initial state it simulates the record exactly, whatever its pole."""
    structure = StateSpaceStructure(1, 1, 1, "none", "tanh", 8, 3, None)
    one, zero = np.ones((1, 1)), np.zeros(1)
    p = {"a": pole * one, "b": 0.1 * one, "c": one, "d": 0 * one, "offset": zero}
    u = np.random.default_rng(0).standard_normal((200, 1))
    # The motion that stays bounded.
    x0 = np.array([[-0.1 * sum(u[k, 0] * pole ** -(k + 1) for k in range(200)) * (pole > 1)]])
    y = structure.simulate(p, x0, u[None])[1][0]
    record = ScaledTrajectory(u, y, np.ones((200, 1)), u, np.ones((200, 1)))
    context = Context((Signal("u"),), (Signal("y"),), 1.0, 2, 2)
    # The state by the past outputs, slightly wrong.
    encoder = affine(np.array([[0.0], [0.0], [0.0], [pole]]), np.array([0.01]))
    error = past_window_error(structure, p, encoder, None, [record], context)
    assert (error > 1.0) == lost


@pytest.mark.long
@pytest.mark.skipif(not os.environ.get("ASIA_DATA_DIR"), reason="needs the records of a robot arm")
def test_no_model_is_kept_that_is_lost_from_the_states_of_past_windows() -> None:
    """With initial states of their own these records are fitted well by unstable models."""
    problem = load_problem(Path(os.environ["ASIA_DATA_DIR"], "zoo", "cd_arm"))
    context, fold = search_context(problem, 0), make_folds(problem.train, problem.protocol)[0]
    model = neural_ss.build(neural_ss.Config(delay=None, past_fit=True), context)
    model = neural_ss.train(model, fold.train, context, LevenbergMarquardt(60, starts=2))
    for block in whole(fold.train, problem.protocol):
        y = model.simulate(block.past_u[None], block.past_y[None], block.u[None])[0]
        assert (np.sqrt(((y - block.y) ** 2).mean(axis=0)) < 0.5 * block.y.std(axis=0)).all()


@pytest.mark.long
def test_adam_improves_on_the_linear_start() -> None:
    data = case(wiener)
    before = fitted(neural_ss.Config(order=2), data, LevenbergMarquardt(0))
    method = Adam(steps=300, learning_rate=5e-3, truncation=64)
    assert data.ratio(fitted(neural_ss.Config(order=2), data, method)) < 0.7 * data.ratio(before)


@pytest.mark.slow
def test_same_seed_gives_the_same_model_whatever_the_precision_of_the_caller() -> None:
    data = case(wiener, lengths=(150,))
    config, method = neural_ss.Config(order=2), LevenbergMarquardt(10)
    first = data.simulated(fitted(config, data, method))
    with jax.enable_x64(True):
        second = data.simulated(fitted(config, data, method))
    assert first.tobytes() == second.tobytes()


def test_polynomials_are_the_monomials_up_to_the_degree() -> None:
    structure = StateSpaceStructure(1, 1, 1, "input", "polynomial", 1, 3, None)
    start: dict[str, Any] = {"s": {"w2": np.array([[2.0], [3.0]])}}
    u = np.array([[0.5], [-1.0]])
    np.testing.assert_allclose(structure.input(start, u), u + 2 * u**2 + 3 * u**3)


def test_channels_go_with_a_state_nonlinearity_only() -> None:
    with pytest.raises(UserError, match="channels"):
        neural_ss.Config(nonlinearity="input", channels=1)


@pytest.mark.parametrize("integrators", [0, 1])
def test_states_of_unit_size_simulate_the_same(integrators: int) -> None:
    rng = np.random.default_rng(0)
    last = 1.0 if integrators else 0.5
    a = np.array([[0.9, 1e-3, 0.0], [0.0, 0.8, 0.0], [0.3, 0.0, last]])
    system = LinearSystem(
        a, np.array([[1.0], [1e-2], [0.0]]), np.array([[1.0, 1e2, 1.0]]), np.zeros((1, 1)),
        np.zeros(1),
    )  # fmt: skip
    u = rng.standard_normal((400, 1))
    y = system.simulate(np.zeros((1, 3)), u[None])[1][0]
    record = ScaledTrajectory(u, y, np.ones((400, 1)), u, np.ones((400, 1)))
    found = with_unit_states(LinearFit(system, np.zeros((1, 3)), 0.0), (record,), integrators)
    states, outputs = found.system.simulate(found.x0, u[None])
    assert outputs[0] == pytest.approx(y, rel=1e-6)
    free = 3 - integrators
    assert np.cov(states[0, :, :free].T) == pytest.approx(np.eye(free), abs=1e-6)
    # A state that integrates stays one, and no other state reads it.
    assert found.system.a[:, free:] == pytest.approx(a[:, free:], abs=1e-9)
    lost = replace(found, system=replace(system, a=2.0 * a))
    assert with_unit_states(lost, (record,), integrators).system.order == 3
