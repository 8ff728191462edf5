"""Difference equations and state-space models whose coefficients follow a scheduling signal."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asia.agents.library.registry import family
from asia.agents.library.space import draw
from asia.candidate import Context, simulate_steps
from asia.data.trajectory import Signal, Trajectory
from asia.errors import UserError
from asia.models import arx, neural_ss
from asia.models._state_space.structure import _monomials
from asia.models.methods import LeastSquares, LevenbergMarquardt
from asia.problem.load import load_problem
from asia.problem.lock import lock_text
from asia.problem.seal import seal
from asia.search.agent_views import problem_facts

CONTEXT = Context((Signal("u"), Signal("p", role="scheduling")), (Signal("y"),), 1.0, 5, 5)


def record(seed: int, samples: int = 400, noise: float = 0.01) -> Trajectory:
    """y[k] = (0.7 + 0.25 p) y[k-1] + (1 - 0.5 p) u[k-1] - 0.2 p, and noise on the output."""
    random = np.random.default_rng(seed)
    u = np.repeat(random.normal(size=samples // 4), 4)
    p = np.interp(np.arange(samples), np.arange(0, samples + 25, 25),
                  random.uniform(-1, 1, samples // 25 + 1))  # fmt: skip
    y = np.zeros(samples)
    for k in range(1, samples):
        pole, gain = 0.7 + 0.25 * p[k], 1 - 0.5 * p[k]
        y[k] = pole * y[k - 1] + gain * u[k - 1] - 0.2 * p[k]
    y += noise * random.normal(size=samples)
    return Trajectory(np.column_stack([u, p]), y[:, None], 1.0)


def error(config: arx.Config, method: LeastSquares | LevenbergMarquardt) -> float:
    model = arx.train(arx.build(config, CONTEXT), [record(1)], CONTEXT, method)
    test = record(2)
    case = test.u[None, :5], test.y[None, :5], test.u[None, 5:]
    y = model.simulate(*case)
    assert np.allclose(simulate_steps(model, *case), y, atol=1e-9)
    return float(np.std(y[0] - test.y[5:]) / np.std(test.y))


def test_coefficients_follow_the_scheduling_signal() -> None:
    method = LevenbergMarquardt(iterations=15)
    fixed = error(arx.Config(na=1, nb=2), method)
    affine = error(arx.Config(na=1, nb=2, scheduling=1), method)
    assert affine < 0.02
    assert affine < 0.1 * fixed
    # Least squares alone finds the coefficients too.
    assert error(arx.Config(1, 2, structure="arx", scheduling=1), LeastSquares(1e-9)) < 0.02


def test_lags_are_chosen_with_the_coefficients() -> None:
    config = arx.Config(scheduling=1, max_order=3, delay=None)
    assert error(config, LevenbergMarquardt(iterations=15)) < 0.02


@pytest.mark.slow
def test_matrices_follow_the_scheduling_signal() -> None:
    """For a constant scheduling signal the model is linear: outputs are superposed."""
    config = neural_ss.Config(order=2, basis="scheduling", degree=2, past_fit=True)
    method = LevenbergMarquardt(iterations=30)
    # The scheduling signal acts on the next sample, the input on the one after that.
    train, test = (replace(r, u=np.roll(r.u, -1, axis=0)) for r in (record(1), record(2)))
    model = neural_ss.train(neural_ss.build(config, CONTEXT), [train], CONTEXT, method)
    case = test.u[None, :5], test.y[None, :5], test.u[None, 5:]
    y = model.simulate(*case)
    assert np.allclose(simulate_steps(model, *case), y, atol=1e-9)
    assert float(np.std(y[0] - test.y[5:]) / np.std(test.y)) < 0.02
    still = np.column_stack([np.zeros(60), np.full(60, 0.4)])
    move = np.column_stack([np.sin(np.arange(60)), np.zeros(60)])
    both = np.stack([still, still + move, still + 0.5 * move])
    past = np.repeat(case[0], 3, 0), np.repeat(case[1], 3, 0)
    none, whole, half = model.simulate(*past, both)
    assert np.abs(whole - none).max() > 0.5
    assert np.allclose(half - none, 0.5 * (whole - none), atol=1e-9)


def test_the_monomials_of_a_scheduling_signal_have_one_other_signal() -> None:
    known = _monomials(3, 3, (2,))
    assert known[0].tolist() == [[0, 2], [1, 2], [2, 2]]
    assert known[1].tolist() == [[0, 2, 2], [1, 2, 2], [2, 2, 2]]


def test_matrices_need_a_scheduling_signal_and_the_whole_state() -> None:
    plain = replace(CONTEXT, inputs=(Signal("u"), Signal("p")))
    model = neural_ss.build(neural_ss.Config(basis="scheduling"), plain)
    with pytest.raises(UserError, match="without an input of role scheduling"):
        neural_ss.train(model, [record(1)], plain, LevenbergMarquardt())
    with pytest.raises(UserError, match="nonlinearity state on all states"):
        neural_ss.Config(basis="scheduling", channels=1)


def test_a_scheduling_signal_is_read_from_the_problem_file(tmp_path: Path) -> None:
    one = record(1)
    np.savetxt(tmp_path / "one.csv", np.column_stack([np.arange(400), one.u, one.y]),
               delimiter=",", header="time,u,p,y", comments="")  # fmt: skip
    text = """
sampling_time = 1.0
inputs = ["u", { name = "p", role = "scheduling" }]
outputs = ["y"]
data = { train = ["one.csv"] }
"""
    (tmp_path / "problem.toml").write_text(text)
    problem = load_problem(tmp_path)
    assert [s.role for s in problem.inputs] == [None, "scheduling"]
    assert 'role = "scheduling"' in lock_text(problem, seal(problem))
    row, facts = family("arx"), problem_facts(problem)
    assert row is not None
    assert row.trial(facts).get("scheduling") == 1
    plain = replace(facts, inputs=(Signal("u"), Signal("p")))
    assert row.trial(plain).get("scheduling") is None
    assert row.aptness(facts) > row.aptness(plain)
    row = family("neural_ss")
    assert row is not None
    assert row.trial(facts).get("basis") == "scheduling"
    assert row.trial(plain).get("basis") is None
    rng = np.random.default_rng(0)
    for _ in range(40):
        drawn = dict(draw(rng, row.trial(facts), row.space(facts)).config)
        neural_ss.Config(**drawn)  # pyright: ignore[reportArgumentType]
    (tmp_path / "problem.toml").write_text(
        text.replace('["y"]', '[{ name = "y", role = "scheduling" }]')
    )
    with pytest.raises(UserError, match="a role belongs to an input"):
        load_problem(tmp_path)
