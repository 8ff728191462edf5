"""Kinematic recurrent networks: pairs, integration, blindness, training."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cloudpickle
import jax.numpy as jnp
import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.errors import UserError
from asia.models import kinematic
from asia.models._equations.measured import Rate, find_rates, read_by_equations
from asia.models._networks.network import NetworkModel
from asia.models._networks.structure import OutputFeedback, Restartable
from asia.models.methods import Adam
from asia.problem import ParameterRange, Physics

TS = 0.05
NAMES = ("p", "q", "v", "w")
EQUATIONS = Physics(
    states=NAMES,
    dynamics={"p": "v", "q": "w*cos(q)", "v": "k*u1 - v", "w": "k*u2 - sin(q)"},
    parameters={"k": ParameterRange(0.1, 10.0)},
)


def context(**changes: Any) -> Context:
    found = Context(
        (Signal("u1"), Signal("u2")),
        tuple(Signal(n) for n in NAMES),
        TS,
        n_past_u=0,
        n_past_y=1,
        horizon=20,
        seed=1,
    )
    return replace(found, **changes)


def cart(seed: int, length: int = 300) -> Trajectory:
    """Two double integrators with forces that go with the squares of the inputs: a position p that
    acts on nothing, and an angle q on a spring."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0, 2, (length // 5, 2)), 5, axis=0)
    y = np.zeros((length, 4))
    y[0] = rng.standard_normal(4)
    for k in range(1, length):
        p, q, v, w = y[k - 1]
        force, turn = u[k, 0] ** 2 - 4 / 3 - v, u[k, 1] ** 2 - 4 / 3 - w - 2 * np.sin(q)
        y[k] = [p + TS * v, q + TS * w, v + TS * force, w + TS * turn]
    return Trajectory(u, y + 0.002 * rng.standard_normal(y.shape), TS, f"cart{seed}")


def trained(
    records: list[Trajectory],
    known: Context,
    method: Adam,
    config: kinematic.Config | None = None,
) -> NetworkModel:
    model = kinematic.build(config or kinematic.Config("gru", hidden=4, encoder=4), known)
    return kinematic.train(model, records, known, method)


def test_rates_are_found_in_the_records() -> None:
    found = find_rates([cart(0), cart(1)], context())
    assert [(r.output, r.rate) for r in found] == [(0, 2), (1, 3)]
    np.testing.assert_allclose([r.gain for r in found], 1.0, atol=0.02)


def test_euler_integration_has_gain_one() -> None:
    v = np.random.default_rng(0).standard_normal(50)
    p = TS * np.concatenate([[0.0], np.cumsum(v)[:-1]])
    known = context(outputs=(Signal("v"), Signal("p")))
    (rate,) = find_rates([Trajectory(v, np.stack([v, p], axis=1), TS)], known)
    assert (rate.output, rate.rate) == (1, 0)
    assert rate.gain == pytest.approx(1.0, abs=1e-12)


def test_equations_without_parameters_say_which_rate_is_whose() -> None:
    # In degrees the gain is far from one, and only the equations can tell.
    records = [replace_output(cart(i), 1, 57.3) for i in range(2)]
    by_data = find_rates(records, context())
    assert [(r.output, r.rate) for r in by_data] == [(0, 2)]
    by_equations = find_rates(records, context(physics=EQUATIONS))
    assert by_equations[0] == Rate(0, 2, 1.0)
    assert (by_equations[1].output, by_equations[1].rate) == (1, 3)
    assert by_equations[1].gain == pytest.approx(57.3, rel=0.05)


def test_outputs_never_integrate_in_a_circle() -> None:
    y = np.exp(TS * np.arange(60.0))[:, None] * [1.0, 1.0]
    known = context(outputs=(Signal("a"), Signal("b")))
    assert len(find_rates([Trajectory(np.zeros(60), y, TS)], known)) == 1


def test_the_network_reads_what_the_equations_read() -> None:
    assert read_by_equations(context(physics=EQUATIONS)) == {1, 2, 3}
    assert read_by_equations(context()) == {0, 1, 2, 3}


@pytest.mark.slow
def test_what_is_not_read_shifts_the_simulation_and_no_more() -> None:
    record = cart(0)
    model = trained([record], context(physics=EQUATIONS, n_past_y=2), Adam(steps=20))
    assert model.params["fixed"]["read"].tolist() == [0, 1, 1, 1]
    past, u = record.y[None, :2], record.u[None, 2:22]
    shift = np.array([3.0, 0.0, 0.0, 0.0])
    moved = model.simulate(np.zeros((1, 0, 2)), past + shift, u)
    still = model.simulate(np.zeros((1, 0, 2)), past, u)
    np.testing.assert_allclose(moved - shift, still, atol=1e-5)


@pytest.fixture(scope="module")
def fitted() -> NetworkModel:
    return trained([cart(0), cart(1)], context(), Adam(steps=30, learning_rate=1e-2))


def test_integrals_follow_their_rates_with_the_learned_gain(fitted: NetworkModel) -> None:
    model, records = fitted, [cart(0), cart(1)]
    y = model.simulate(np.zeros((1, 0, 2)), records[0].y[None, :1], records[0].u[None, 1:])[0]
    gain = 1 + model.params["gain"][:2]
    assert np.abs(gain - 1).max() > 1e-4
    own = [r.gain for r in find_rates(records, context())]
    np.testing.assert_allclose(np.diff(y[:, :2], axis=0), gain * own * TS * y[:-1, 2:], atol=1e-5)


@pytest.mark.long
def test_it_beats_holding_and_comes_back_the_same() -> None:
    records = [cart(i) for i in range(4)]
    config = kinematic.Config("gru", hidden=8, encoder=4, features=("square",))
    method = Adam(steps=150, learning_rate=1e-2, teacher=0.3, members=2)
    model = trained(records[:3], context(), method, config)
    error = against_holding(model, records[3])
    assert (error < 0.35).all(), error
    again = cloudpickle.loads(cloudpickle.dumps(model))
    case = np.zeros((1, 0, 2)), records[3].y[None, :1], records[3].u[None, 1:]
    assert again.simulate(*case).tobytes() == model.simulate(*case).tobytes()
    assert len(model.others) == 1


def test_a_measured_output_replaces_its_own_where_asked(fitted: NetworkModel) -> None:
    cell, params = fitted.cell, fitted.params
    assert isinstance(cell, OutputFeedback)
    assert isinstance(cell, Restartable)
    state = cell.initial(params, jnp.ones((2, 4)))
    state, own = cell.step(params, state, jnp.ones((2, 2)))
    fed = cell.feed(params, state, jnp.full((2, 4), 7.0), jnp.asarray([[1.0], [0.0]]))
    np.testing.assert_array_equal(fed[1], np.stack([np.full(4, 7.0), own[1]]))
    _, after = cell.step(params, fed, jnp.ones((2, 2)))
    # The position goes on from the measured one, at the measured velocity.
    moved = 7.0 * params["fixed"]["rate"][2, 0] + params["fixed"]["drift"][0]
    expected = 7.0 + float((1 + params["gain"][0]) * moved)
    assert float(after[0, 0]) == pytest.approx(expected, rel=1e-5)


def test_without_an_integral_it_is_refused() -> None:
    record = cart(0)
    rng = np.random.default_rng(0)
    loose = Trajectory(record.u, rng.standard_normal(record.y.shape), TS)
    with pytest.raises(UserError, match=r"no output is the integral of another.*autoregressive"):
        trained([loose], context(), Adam(steps=1))
    with pytest.raises(UserError, match="no output is the integral of another"):
        kinematic.build(kinematic.Config(), context(outputs=(Signal("p"),)))


def test_wrong_settings_are_refused() -> None:
    with pytest.raises(UserError, match=r"kinematic\.Config: feature 'sqare' is unknown"):
        kinematic.Config(features=("sqare",))
    with pytest.raises(UserError, match="expected rnn, gru or lstm"):
        kinematic.Config(cell="gated")  # type: ignore[arg-type]


def replace_output(record: Trajectory, channel: int, factor: float) -> Trajectory:
    size = np.ones(record.y.shape[1])
    size[channel] = factor
    return Trajectory(record.u, record.y * size, TS, record.name)


def against_holding(model: NetworkModel, record: Trajectory) -> Array:
    """Mean absolute error of each output over windows, over that of the last state held."""
    starts = np.arange(1, len(record) - 20, 20)
    rows = starts[:, None] + np.arange(20)
    past = record.y[starts - 1][:, None]
    y_hat = model.simulate(np.zeros((len(starts), 0, 2)), past, record.u[rows])
    error, held = (np.abs(y - record.y[rows]).mean(axis=(0, 1)) for y in (y_hat, past))
    return error / held
