"""Difference equations whose coefficients follow a scheduling signal."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asia.agents.library.registry import family
from asia.candidate import Context, simulate_steps
from asia.data.trajectory import Signal, Trajectory
from asia.errors import UserError
from asia.models import arx
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
    config = arx.Config(scheduling=1, max_order=3, delay=None, max_delay=2)
    assert error(config, LevenbergMarquardt(iterations=15)) < 0.02


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
    (tmp_path / "problem.toml").write_text(
        text.replace('["y"]', '[{ name = "y", role = "scheduling" }]')
    )
    with pytest.raises(UserError, match="a role belongs to an input"):
        load_problem(tmp_path)
