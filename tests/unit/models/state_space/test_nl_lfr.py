"""Linear systems with static functions in feedback."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.errors import UserError
from asia.models import linear, nl_lfr
from asia.models._least_squares import LevenbergMarquardt
from asia.models._linear.fit import LinearFit, Refinement
from asia.models._linear.system import LinearSystem
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import ScaledTrajectory, scaled
from asia.models._state_space import feedback
from asia.models._state_space.feedback import feedback_starts
from asia.models._state_space.fit import fit_states
from asia.models._state_space.programs import StabilityTerm, StateSamples
from asia.models._state_space.structure import StateSpaceStructure
from asia.problem.folds import make_folds, whole
from asia.problem.load import load_problem
from asia.search.run import search_context
from tests.unit.models.systems.black_box import PAST, case, filtered, two_by_two, wiener
from tests.unit.models.systems.fitting import fitted

METHOD = LevenbergMarquardt(40, starts=2)


def spring(u: Array) -> Array:
    """A mass on a spring that hardens."""
    x, v, y = 0.0, 0.0, np.empty((len(u), 1))
    for k, force in enumerate(u[:, 0]):
        y[k] = x
        v += 0.3 * (force - x - 0.7 * x**3 - 0.6 * v)
        x += 0.3 * v
    return y


def dry(u: Array) -> Array:
    """The velocity of a mass that friction stops."""
    v, y = 0.0, np.empty((len(u), 1))
    for k, force in enumerate(u[:, 0]):
        y[k] = v
        v += 0.2 * (force - 0.5 * v)
        v = np.sign(v) * max(abs(v) - 0.1, 0.0)
    return y


def hammerstein(u: Array) -> Array:
    return filtered(np.clip(u, -0.6, 1.2))


def heated(u: Array) -> Array:
    """A flow that heats a vessel: the input multiplies the state."""
    x, y = 0.0, np.empty((len(u), 1))
    for k, flow in enumerate(u[:, 0]):
        y[k] = x
        x += 0.15 * (flow - x - 0.5 * np.tanh(flow) * x)
    return y


SYSTEMS = {"hammerstein": hammerstein, "wiener": wiener, "spring": spring, "dry": dry}


@pytest.mark.parametrize("name", ["hammerstein", "wiener", "spring", "dry"])
def test_the_first_start_reads_what_the_function_acts_on(name: str) -> None:
    """Before any fit, its simulation leaves far less than the linear model's."""
    data = case(SYSTEMS[name], lengths=(500,), noise=0.01)
    records = scaled(data.training, Scaling.of(data.training))
    order = 1 if name == "dry" else 2
    found, _, used = linear.fit_records(
        records, data.context, linear.Config(order=order), Refinement()
    )
    structure = StateSpaceStructure(order, 1, 1, "state", "tanh", 10, 2, 1)
    starts = feedback_starts(structure, found, used, 2, np.random.default_rng(0))
    assert 1 <= len(starts) <= 2
    x0 = found.x0[:1]
    y = structure.simulate(starts[0], x0, used[0].u[None])[1][0]
    line = found.system.simulate(x0, used[0].u[None])[1][0]
    left, before = (np.std((used[0].y - out)[PAST:]) for out in (y, line))
    assert left < 0.9 * before


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("spring", marks=pytest.mark.slow),
        pytest.param("dry", marks=pytest.mark.slow),
        pytest.param("hammerstein", marks=pytest.mark.long),
        pytest.param("wiener", marks=pytest.mark.long),
    ],
)
def test_own_systems_are_simulated_far_better_than_by_a_linear_model(name: str) -> None:
    data = case(SYSTEMS[name], lengths=(600,), noise=0.02)
    order = 1 if name == "dry" else 2
    model = fitted(nl_lfr, nl_lfr.Config(order=order), data, METHOD)
    line = fitted(linear, linear.Config(), data, None)
    assert data.ratio(model) < 0.25 * data.ratio(line)


def test_the_functions_go_on_as_straight_lines_beyond_the_records() -> None:
    data = case(spring, lengths=(300,), noise=0.02)
    model = fitted(nl_lfr, nl_lfr.Config(order=2), data, LevenbergMarquardt(iterations=8))
    assert model.fitted is not None
    structure, layer = model.fitted.structure, model.fitted.params["f"]

    def slopes(z: np.ndarray) -> np.ndarray:
        return np.diff(structure.units(layer, z[:, None]) @ layer["w2"], axis=0) / np.diff(z)[0]

    inside, beyond = slopes(np.linspace(-2.0, 2.0, 9)), slopes(np.linspace(1e3, 2e3, 9))
    assert np.ptp(inside) > 1e-3  # Not a straight line where there are samples.
    assert np.ptp(beyond) < 1e-3 * np.ptp(inside)
    assert np.abs(beyond).max() > 0.0


@pytest.mark.parametrize("held", [False, True])
def test_a_fit_of_growing_outputs_stays_stable_with_the_stability_term(held: bool) -> None:
    length = 150
    y = 1.002 ** np.arange(length)[None, :, None]
    samples = StateSamples(
        np.ones((1, 1)), np.zeros((1, length, 1)), y, np.ones((1, length, 1)), known=False
    )
    structure = StateSpaceStructure(1, 1, 1, "none", "tanh", 1, 2, None)
    a = np.array([[0.995]])
    start = {"a": a, "b": np.zeros((1, 1)), "c": np.ones((1, 1)), "d": np.zeros((1, 1)),
             "offset": np.zeros(1)}  # fmt: skip
    ridge = dict.fromkeys([*start, "x0"], 1e-9)
    term = StabilityTerm.of(a, length, 1.0) if held else None
    fit = fit_states(
        structure, [start], samples, ridge, METHOD, lambda *_: None, stability=term
    )[0]  # fmt: skip
    assert (abs(fit.params["a"][0, 0]) < 1.0) == held
    assert StabilityTerm.of(np.array([[1.0]]), length, 1.0) is None


@pytest.mark.long
def test_no_mode_follows_the_drift_of_a_record() -> None:
    data = case(lambda u: filtered(u) + np.linspace(-0.7, 0.7, len(u))[:, None] ** 2)
    every = [
        linear.fit_records(
            scaled(data.training, Scaling.of(data.training)), data.context,
            linear.Config(order=order, delay=0), Refinement(),
        )
        for order in (2, 3, 4)
    ]  # fmt: skip
    slow = np.exp(-3.0 / max(len(r) for r in data.training))
    assert any((np.abs(np.linalg.eigvals(found.system.a)) > slow).any() for found, _, _ in every)
    config = nl_lfr.Config(delay=0, hidden=2)
    model = fitted(nl_lfr, config, data, LevenbergMarquardt(4, starts=1))
    assert model.fitted is not None
    a = model.fitted.params["a"]
    assert np.abs(np.linalg.eigvals(a)).max() < slow


@pytest.mark.long
@pytest.mark.skipif(not os.environ.get("ASIA_DATA_DIR"), reason="needs records of a hair dryer")
def test_the_fit_that_is_kept_simulates_from_past_windows() -> None:
    """The fit with the least cost has a state that does not decay, and is lost from any initial
    state but its own."""
    problem = load_problem(Path(os.environ["ASIA_DATA_DIR"], "zoo", "hairdryer"))
    context, fold = search_context(problem, 1), make_folds(problem.train, problem.protocol)[1]
    model = nl_lfr.build(nl_lfr.Config(), context)
    model = nl_lfr.train(model, fold.train, context, LevenbergMarquardt(60, starts=2))
    for block in whole(fold.train, problem.protocol):
        past = block
        y = model.simulate(past.past_u[None], past.past_y[None], past.u[None])[0]
        assert np.sqrt(((y - block.y) ** 2).mean()) < 0.2 * block.y.std()


@pytest.mark.long
def test_a_product_of_state_and_input_takes_two_channels() -> None:
    data = case(heated, lengths=(600,), noise=0.02)
    two = fitted(nl_lfr, nl_lfr.Config(order=1, channels=2), data, METHOD)
    line = fitted(linear, linear.Config(order=1), data, None)
    assert data.ratio(two) < 0.3 * data.ratio(line)


def test_two_inputs_and_outputs_and_missing_samples() -> None:
    data = case(two_by_two, channels=2, lengths=(160,))
    config = nl_lfr.Config(order=3, channels=2, hidden=3)
    model = fitted(nl_lfr, config, data, LevenbergMarquardt(3, starts=1))
    assert data.ratio(model) < 1.2
    again = fitted(nl_lfr, config, data, LevenbergMarquardt(3, starts=1))
    np.testing.assert_array_equal(data.simulated(model), data.simulated(again))


@pytest.mark.long
def test_a_free_integrator_is_not_read() -> None:
    data = case(lambda u: np.cumsum(np.clip(u, -0.5, 1.0), axis=0) * 0.05, lengths=(400,))
    config = nl_lfr.Config(order=2, integrators=1, hidden=6)
    model = fitted(nl_lfr, config, data, LevenbergMarquardt(20, starts=2))
    assert model.fitted is not None
    order = model.fitted.structure.order
    read = model.fitted.params["read"]
    assert read.shape == (order - 1 + 1, 1)
    line = fitted(linear, linear.Config(order=2, integrators=1), data, None)
    assert data.ratio(model) < 0.7 * data.ratio(line)


def test_without_training_it_says_so() -> None:
    data = case(wiener, lengths=(100,))
    model = nl_lfr.build(nl_lfr.Config(), data.context)
    with pytest.raises(UserError, match="not trained"):
        model.simulate(data.unseen.u[None, :PAST], data.unseen.y[None, :PAST], data.unseen.u[None])
    with pytest.raises(UserError, match="channels"):
        nl_lfr.Config(channels=0)


@pytest.mark.slow
def test_models_of_several_orders_are_the_same_in_one_program(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = nl_lfr.Config(hidden=3, integrators=1)
    context = Context((Signal("u"),), (Signal("y"),), 1.0, n_past_u=10, n_past_y=10, seed=1)
    u = np.random.default_rng(0).normal(size=150)
    y = np.cumsum(0.1 * np.tanh(filtered(u[:, None])), axis=0)[:, 0]
    record = Trajectory(u[:, None], y[:, None], 1.0)
    found: list[np.ndarray] = []
    for most in (feedback._WIDENED, 0):
        monkeypatch.setattr(feedback, "_WIDENED", most)
        model = nl_lfr.train(
            nl_lfr.build(config, context), [record], context, LevenbergMarquardt(4, starts=1)
        )
        found.append(model.simulate(u[None, :10, None], y[None, :10, None], u[None, 10:, None]))
    assert_allclose(found[0], found[1], rtol=1e-6, atol=1e-6)


def test_normal_equations_of_regressors_are_those_of_their_columns() -> None:
    rng = np.random.default_rng(0)
    system = LinearSystem(
        np.array([[0.8, 0.1], [-0.1, 0.6]]), rng.normal(size=(2, 1)), rng.normal(size=(2, 2)),
        rng.normal(size=(2, 1)), rng.normal(size=2),
    )  # fmt: skip
    structure = StateSpaceStructure(2, 1, 2, "state", "tanh", 3, 2, 1)
    u, weight = rng.normal(size=(80, 1)), np.ones((80, 2))
    weight[20:30], weight[50:60, 1] = 0.0, 0.0
    y = system.simulate(np.zeros((1, 2)), u[None])[1][0] + 0.1 * rng.normal(size=(80, 2))
    record = ScaledTrajectory(u, y, weight, u, weight)
    (r,) = prepared = feedback.prepared_records([record], LinearFit(system, np.zeros((1, 2)), 0.1))
    search = feedback.RegressorSearch(structure, system, prepared, rng)
    direction = rng.normal(size=(3, 1))
    layer = search.layer(direction, observed=False)
    ((gram, side, power),) = search.normal([(direction, False, layer)])
    units = np.tanh(r.read(direction, observed=False) @ layer["w1"] + layer["b1"])
    columns = feedback.responses(system, units).reshape(160, -1) * weight.reshape(-1, 1)
    residual = r.residual.ravel()
    columns, residual = (one - r.basis @ (r.basis.T @ one) for one in (columns, residual))
    whole = columns.T @ columns
    ridge = gram - whole / 160
    assert_allclose(ridge, np.eye(len(gram)) * ridge[0, 0], atol=1e-12)
    assert_allclose(side, columns.T @ residual / 160, atol=1e-12)
    assert_allclose(power, residual @ residual / 160)
