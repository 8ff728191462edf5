"""Equations with measured states: a mass on a rail, pulled by a force, with drag that the equations
do not have."""

from dataclasses import replace

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.errors import UserError
from asia.models import physics_net
from asia.models._equations.measured import MeasuredCell
from asia.models._least_squares import LevenbergMarquardt
from asia.models.methods import Adam
from asia.problem import Bounds, ParameterRange, Physics

HORIZON, TS, PULL, DRAG = 20, 0.05, 3.0, 0.8
PHYSICS = Physics(
    states=("p", "v"),
    dynamics={"p": "v", "v": "pull*force"},
    parameters={"pull": ParameterRange(0.3, 10.0)},
)
CONTEXT = Context(
    inputs=(Signal("force"),),
    outputs=(Signal("v"), Signal("p")),
    sampling_time=TS,
    n_past_u=0,
    n_past_y=1,
    horizon=HORIZON,
    metric="mae",
    physics=PHYSICS,
    seed=1,
)
LM = LevenbergMarquardt(iterations=10)


def record(seed: int, length: int = 400, cubic: float = 0.0, gain: float = 1.0) -> Trajectory:
    """Outputs are ordered v, p: not as the states."""
    rng = np.random.default_rng(seed)
    force = np.repeat(rng.standard_normal(length // 5), 5)
    p, v, rows = 0.0, 0.0, []
    for f in force:
        for _ in range(10):
            p += TS / 10 * gain * v
            v += TS / 10 * (PULL * f - DRAG * v - cubic * v**3)
        rows.append((v, p))
    return Trajectory(force, np.array(rows), TS, f"r{seed}")


def error(model: physics_net.PhysicsNet, test: Trajectory) -> float:
    """Mean absolute error over windows, both outputs normalised."""
    starts = range(1, len(test) - HORIZON, HORIZON)
    past_y = np.stack([test.y[k - 1 : k] for k in starts])
    u = np.stack([test.u[k : k + HORIZON] for k in starts])
    y = np.stack([test.y[k : k + HORIZON] for k in starts])
    y_hat = model.simulate(np.zeros((len(u), 0, 1)), past_y, u)
    return float((np.abs(y_hat - y) / test.y.std(axis=0)).mean())


def fitted(
    config: physics_net.Config, method: object = LM, context: Context = CONTEXT, **system: float
) -> physics_net.PhysicsNet:
    records = [record(1, **system), record(2, **system)]  # pyright: ignore[reportArgumentType]
    return physics_net.train(physics_net.build(config, context), records, context, method)  # pyright: ignore[reportArgumentType]


@pytest.fixture(scope="module")
def linear() -> physics_net.PhysicsNet:
    return fitted(physics_net.Config(linear=True, lag=False))


@pytest.mark.slow
def test_sparse_linear_terms_are_the_drag_and_nothing_else(linear: physics_net.PhysicsNet) -> None:
    cell, params = linear.network.cell, linear.network.params
    assert isinstance(cell, MeasuredCell)
    assert cell.read == ("v",)  # no equation reads the position
    assert (cell.physics.dynamic, cell.physics.kinematic) == ((1,), (0,))
    slope = params["linear"][0, 0] * params["fixed"]["rate"][0] / params["fixed"]["s_std"][0]
    assert slope == pytest.approx(-DRAG, rel=0.1)
    assert cell.physics.physical(params["physical"])[0] == pytest.approx(PULL, rel=0.1)
    assert error(linear, record(9)) < 0.02
    assert error(fitted(physics_net.Config(lag=False)), record(9)) > 0.04


def test_known_kinematics_get_a_gain() -> None:
    model = fitted(physics_net.Config(linear=True, lag=False), gain=0.9)
    assert list(model.parameters().values()) == [pytest.approx(PULL, rel=0.2)]
    assert model.network.params["gain"][0] == pytest.approx(-0.1, abs=0.02)


@pytest.mark.slow
def test_a_network_learns_what_the_equations_lack() -> None:
    system = {"cubic": 1.5}
    alone = fitted(physics_net.Config(linear=True, lag=False), **system)
    config = physics_net.Config(linear=True, lag=False, network="gru", hidden=8, equations=10)
    method = Adam(steps=150, learning_rate=1e-2, batch=32, loss="mae")
    test = record(9, cubic=1.5)
    assert error(fitted(config, method, **system), test) < 0.7 * error(alone, test)


def test_the_validation_score_keeps_the_best_iterate() -> None:
    test, asked = record(9), list[float]()

    def score(model: object) -> float:
        """The second one asked about is said to be the best."""
        assert isinstance(model, physics_net.NetworkModel)
        asked.append(error(physics_net.PhysicsNet(physics_net.Config(), model), test))
        return abs(len(asked) - 2.0)

    context = replace(CONTEXT, validation_score=score)
    model = physics_net.build(physics_net.Config(linear=True, lag=False), context)
    method = LevenbergMarquardt(iterations=10, stop="validation")
    found = physics_net.train(model, [record(1), record(2)], context, method)
    assert len(asked) > 3
    assert error(found, test) == asked[1] != asked[-1]


@pytest.mark.long
def test_a_disturbance_is_bounded_and_trained() -> None:
    model = fitted(physics_net.Config(linear=True, lag=False, disturbance=True))
    assert error(model, record(9)) < 0.05


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"physics": None}, "no \\[physics\\]"),
        ({"outputs": (Signal("p"),), "physics": replace(PHYSICS, observation={"p": "p"})}, "v"),
        ({"n_past_y": 0}, "past window"),
    ],
)
def test_what_it_cannot_be_used_on(change: dict[str, object], words: str) -> None:
    with pytest.raises(UserError, match=words):
        physics_net.build(physics_net.Config(), replace(CONTEXT, **change))  # pyright: ignore[reportArgumentType]


@pytest.mark.long
def test_dropout_leaves_the_outputs_alone_and_bounds_hold() -> None:
    """With no step taken the network says nothing, whatever is dropped."""
    physics = replace(PHYSICS, bounds={"v": Bounds(max=0.1)})
    context = replace(CONTEXT, physics=physics)
    config = physics_net.Config(lag=False, network="gru", hidden=4, equations=0)
    losses: dict[float, list[float]] = {}
    for dropout in (0.0, 0.5):
        seen = losses.setdefault(dropout, [])
        logged = replace(context, log=lambda step, loss, seen=seen: seen.append(loss))
        method = Adam(steps=1, learning_rate=1e-9, batch=16, dropout=dropout)
        model = fitted(config, method, logged)
    assert losses[0.5] == pytest.approx(losses[0.0], rel=1e-6)
    u = np.ones((1, HORIZON, 1))
    simulated = model.simulate(np.zeros((1, 0, 1)), np.zeros((1, 1, 2)), u)
    assert simulated[0, :, 0].max() == pytest.approx(0.1, rel=1e-5)


def test_a_network_needs_a_network_method() -> None:
    with pytest.raises(UserError, match="Adam"):
        fitted(physics_net.Config(network="gru"))
