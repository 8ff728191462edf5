"""Learned terms at places in the equations: a puck on a table, pushed by two forces, with a
resistance that the equations do not have."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.errors import UserError
from asia.models import physics_net
from asia.models._equations.measured import MeasuredCell, measured_sizes
from asia.models._least_squares import LevenbergMarquardt
from asia.models._networks import compiled
from asia.models._networks.structure import rollout
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import flat_past
from asia.models.methods import Adam
from asia.problem import Correction, ParameterRange, Physics, Prior

HORIZON, TS, PUSH = 20, 0.05, 3.0
TURN = {
    "v": "w", "w": "-v", "right": "up", "up": "-right", "a": "b", "b": "-a",
}  # fmt: skip
PHYSICS = Physics(
    states=("p", "q", "v", "w"),
    dynamics={"p": "v", "q": "w", "v": "push*right + a", "w": "push*up + b"},
    parameters={"push": ParameterRange(0.3, 10.0)},
    corrections={"a": Correction(1.0), "b": Correction(1.0)},
)
CONTEXT = Context(
    inputs=(Signal("right"), Signal("up")),
    outputs=tuple(Signal(name) for name in "pqvw"),
    sampling_time=TS,
    n_past_u=0,
    n_past_y=1,
    horizon=HORIZON,
    metric="mae",
    physics=PHYSICS,
    symmetry={"quarter turn": TURN},
    seed=1,
)
LM = LevenbergMarquardt(iterations=8)
GRU = physics_net.Config(lag=False, gain=False, network="gru", hidden=6, equations=4, symmetry=True)
PLAIN = physics_net.Config(lag=False, gain=False)
ADAM = Adam(steps=60, learning_rate=2e-2, batch=32, loss="mae")
LONG = replace(ADAM, steps=1000)


def record(seed: int, up: float = 1.0) -> Trajectory:
    """`up`: size of that force."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal((80, 2)), 5, axis=0) * [1.0, up]
    x, rows = np.zeros(4), []
    for force in u:
        for _ in range(10):
            rate = PUSH * force - 1.5 * x[2:] * np.hypot(*x[2:])
            x = x + TS / 10 * np.concatenate([x[2:], rate])
        rows.append(x)
    return Trajectory(u, np.array(rows), TS, f"r{seed}")


def fitted(
    config: physics_net.Config, method: Any, context: Context = CONTEXT, **system: Any
) -> physics_net.PhysicsNet:
    records = [record(1, **system), record(2, **system)]
    return physics_net.train(physics_net.build(config, context), records, context, method)


def requests(test: Trajectory) -> tuple[Array, Array, Array]:
    starts = range(1, len(test) - HORIZON, HORIZON)
    past_y = np.stack([test.y[k - 1 : k] for k in starts])
    u = np.stack([test.u[k : k + HORIZON] for k in starts])
    return past_y, u, np.stack([test.y[k : k + HORIZON] for k in starts])


def simulated(model: physics_net.PhysicsNet, past_y: Array, u: Array) -> Array:
    return model.simulate(np.zeros((len(u), 0, 2)), past_y, u)


def error(model: physics_net.PhysicsNet, test: Trajectory) -> float:
    past_y, u, y = requests(test)
    return float((np.abs(simulated(model, past_y, u) - y) / test.y.std(axis=0)).mean())


@pytest.mark.long
def test_a_turned_experiment_has_the_turned_simulation() -> None:
    symmetric = fitted(GRU, ADAM, up=0.3)
    past_y, u, _ = requests(record(9))
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]])  # of (right, up); the velocities, positions turn too
    both = np.kron(np.eye(2), turn)
    turned = simulated(symmetric, past_y @ both.T, u @ turn.T)
    assert turned == pytest.approx(simulated(symmetric, past_y, u) @ both.T, abs=2e-4)


@pytest.mark.long
def test_what_was_learned_to_the_right_holds_upwards() -> None:
    """Trained on pushes to the right, with small ones upwards."""
    test, symmetric = record(9), fitted(GRU, LONG, up=0.3)
    plain = fitted(replace(GRU, symmetry=False), LONG, up=0.3)
    assert error(symmetric, test) < 0.7 * error(plain, test)


def test_numpy_simulates_what_jax_does() -> None:
    import jax

    config = replace(GRU, delay=True, linear=True, disturbance=True)
    model = physics_net.build(config, CONTEXT)
    records = [record(1)]
    scaling = Scaling.of(records)
    cell = model.network.cell
    assert isinstance(cell, MeasuredCell)
    rng = np.random.default_rng(0)
    params: Any = jax.tree.map(
        lambda v: (v + 0.2 * rng.standard_normal(np.shape(v))).astype(np.float32),
        dict(model.network.params),
    )
    params["fixed"] = measured_sizes(cell, records, scaling, CONTEXT)
    past_y, u, _ = requests(record(9))
    arrays = (
        flat_past(np.zeros((len(u), 0, 2)), scaling.outputs(past_y)).astype(np.float32),
        scaling.inputs(u).astype(np.float32),
    )
    by_jax = compiled.compiled(rollout, cell, params, *arrays)
    assert rollout(cell, params, *arrays) == pytest.approx(np.asarray(by_jax), abs=1e-4)


@pytest.mark.long
def test_the_ridge_holds_linear_terms_in_both_methods() -> None:
    config = replace(PLAIN, linear=True, sparsity=0.0, equations=0)
    method = replace(ADAM, steps=150)
    for held, free in (
        (fitted(replace(config, ridge=r), m) for r in (10.0, 1e-4)) for m in (LM, method)
    ):
        sizes = [np.abs(m.network.params["linear"]).max() for m in (held, free)]
        assert sizes[0] < 0.1 * sizes[1]


def pushed(config: physics_net.Config, **changes: Any) -> Array:
    """Outputs p, q, v, w from rest under a push to the right of 1 m/s^2, with some parameters."""
    model = physics_net.build(config, CONTEXT).network
    scaling = Scaling.of([record(1)])
    assert isinstance(model.cell, MeasuredCell)
    fixed = measured_sizes(model.cell, [record(1)], scaling, CONTEXT)
    gain = float(model.cell.physics.physical(model.params["physical"])[0])
    changed = {k: np.asarray(v, np.float32) for k, v in changes.items()}
    params = {**model.params, **changed, "fixed": fixed}
    u = np.tile([1.0 / gain, 0.0], (1, 10, 1))
    trained = replace(model, params=params, scaling=scaling)
    return trained.simulate(np.zeros((1, 0, 2)), np.zeros((1, 1, 4)), u)[0]


def test_kinematics_read_velocities_ahead_by_the_delay() -> None:
    """The position follows the velocity that will be measured after the delay, here two samples."""
    config, time = replace(PLAIN, delay=True), TS * np.arange(1, 11)
    position = pushed(config, delay=[0.4, 0.0])[:, 0]
    assert position == pytest.approx(0.5 * time**2 + 2 * TS * time, rel=1e-4)


@pytest.mark.slow
def test_parameters_start_where_the_priors_say_and_are_held_there() -> None:
    physics = replace(PHYSICS, priors={"2*push": Prior(1.0, 0.01)})
    context = replace(CONTEXT, physics=physics)
    config = replace(PLAIN, network="mlp", hidden=4, equations=0)

    def push(prior: float, steps: int) -> float:
        method = replace(ADAM, steps=steps, learning_rate=2e-2 if steps > 1 else 1e-9)
        model = fitted(replace(config, prior=prior), method, context)
        cell = model.network.cell
        assert isinstance(cell, MeasuredCell)
        return float(cell.physics.physical(np.asarray(model.network.params["physical"]))[0])

    assert push(0.01, 1) == pytest.approx(0.5, abs=0.02)
    assert push(1.0, 60) < 0.6 < push(0.0, 60)


@pytest.mark.slow
def test_members_are_averaged() -> None:
    config, method = replace(GRU, equations=0), replace(ADAM, steps=3)
    past_y, u, _ = requests(record(9))
    single = [
        simulated(fitted(config, method, replace(CONTEXT, seed=CONTEXT.seed + i)), past_y, u)
        for i in range(2)
    ]
    assert not np.allclose(single[0], single[1])
    both = simulated(fitted(config, replace(method, members=2)), past_y, u)
    assert both == pytest.approx((single[0] + single[1]) / 2, abs=1e-6)
    watched = replace(CONTEXT, validation_score=lambda model: 1.0)
    with pytest.raises(UserError, match="validation scores a fit"):
        fitted(config, replace(method, members=2, stop="validation"), watched)


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (partial(physics_net.Config, symmetry=True), "symmetry"),
    ],
)
def test_options_that_the_problem_has_nothing_for(config: Any, words: str) -> None:
    with pytest.raises(UserError, match=words):
        physics_net.build(config(), CONTEXT)
