"""Records that are not sampled regularly: kept, and integrated from sample to sample."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asia.agents.library.registry import families
from asia.candidate import simulate_steps
from asia.errors import UserError
from asia.judge.evaluation.fold_fits import search_context
from asia.models import greybox, linear
from asia.models.methods import LevenbergMarquardt
from asia.problem.check import check_problem
from asia.problem.load import load_lock, load_problem
from asia.problem.lock import lock_text
from asia.problem.problem import Problem
from asia.problem.seal import seal
from asia.search.agent_views import problem_facts

RATE, GAIN = 0.3, 1.5
PROBLEM = """
sampling_time = 1.0
inputs = [{ name = "u" }, { name = "step", unit = "s", role = "time_step" }]
outputs = ["x"]
data = { train = ["one.csv", "two.csv"] }
[physics]
states = ["x"]
dynamics = { x = "gain*u - rate*x" }
parameters = { rate = { min = 0.01, max = 10.0 }, gain = { min = 0.01, max = 10.0 } }
"""


def write(folder: Path) -> Path:
    """Exact samples of a lag at random times, with noise."""
    random = np.random.default_rng(5)
    for name in ("one", "two"):
        steps = np.exp(random.normal(0.0, 0.8, 200)).clip(0.05, 6.0)
        time = np.concatenate([[0.0], np.cumsum(steps)[:-1]]).round(6)
        u, x = np.repeat(random.normal(size=50), 4), np.zeros(200)
        for k, step in enumerate(np.diff(time)):
            kept = np.exp(-RATE * step)
            x[k + 1] = kept * x[k] + (1 - kept) * GAIN / RATE * u[k]
        table = np.column_stack([time, u, x + 0.02 * random.normal(size=200)])
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header="time,u,x", comments="")
    (folder / "problem.toml").write_text(PROBLEM)
    return folder


def fitted(problem: Problem, **settings: Any) -> greybox.GreyBox:
    context = search_context(problem, 1)
    model = greybox.build(greybox.Config(**settings), context)
    return greybox.train(model, problem.train, context, LevenbergMarquardt(20, starts=2))


def test_samples_stay_as_they_were_taken(tmp_path: Path) -> None:
    problem = load_problem(write(tmp_path))
    time, u, x = np.loadtxt(tmp_path / "one.csv", delimiter=",", skiprows=1).T
    record = problem.train[0]
    assert np.array_equal(record.u[:, 0], u)
    assert np.array_equal(record.y[:, 0], x)
    assert np.allclose(record.u[:-1, 1], np.diff(time), atol=1e-9)
    assert not problem.warnings
    lock = tmp_path / "problem.lock.toml"
    lock.write_text(lock_text(problem, seal(problem)))
    assert np.array_equal(load_lock(lock).train[1].u, problem.train[1].u)


@pytest.mark.slow
def test_equations_are_integrated_to_each_sample(tmp_path: Path) -> None:
    problem = load_problem(write(tmp_path))
    model = fitted(problem)
    estimates = model.estimates(problem.train, search_context(problem, 1)).parameters
    for one, truth in zip(estimates, (RATE, GAIN), strict=True):
        assert one.low < truth < one.high
        assert one.high - one.low < 0.05 * truth
    # Taken as samples of one second the same records give another rate.
    regular = PROBLEM.replace(', { name = "step", unit = "s", role = "time_step" }', "")
    (tmp_path / "problem.toml").write_text(regular.replace("data = {", 'data = { time = "none",'))
    far = abs(fitted(load_problem(tmp_path)).parameters()["rate"] / RATE - 1)
    assert far > 4 * abs(model.parameters()["rate"] / RATE - 1)


def test_steps_have_their_own_length(tmp_path: Path) -> None:
    problem = load_problem(write(tmp_path))
    model, record = fitted(problem), problem.train[1]
    case = record.u[None, :10], record.y[None, :10], record.u[None, 10:60]
    y = model.simulate(*case)
    assert np.allclose(simulate_steps(model, *case), y, atol=1e-9)
    assert np.std(y[0] - record.y[10:60]) < 0.03


def test_what_counts_in_samples_is_refused(tmp_path: Path) -> None:
    problem = load_problem(write(tmp_path))
    context = search_context(problem, 1)
    with pytest.raises(UserError, match=r"not sampled regularly.*greybox, hybrid or simulator"):
        linear.train(
            linear.build(linear.Config(), context), problem.train, context, LevenbergMarquardt()
        )
    with pytest.raises(UserError, match="input_delay and discover need one sampling time"):
        fitted(problem, input_delay=3.0)
    assert [row.name for row in families(problem_facts(problem))] == ["greybox", "hybrid"]
    assert problem.baseline is not None
    assert "greybox.train" in problem.baseline


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("[physics]", "[extra]", "unknown key 'extra'"),
        ('{ name = "u" }', '{ name = "u", role = "time_step" }', "a role belongs to an input"),
        ('outputs = ["x"]', 'outputs = ["x"]\nloop = { reference = "u2" }', r"\[loop\] needs one"),
        ('outputs = ["x"]', 'outputs = ["x"]\npreprocess = { decimate = 2 }', r"\[preprocess\]"),
        ('"u" }', '"u", intersample = "band_limited" }', "band_limited.* needs one sampling time"),
        ('["x"]', '[{ name = "x", intersample = "first" }]', "intersample belongs to an input"),
        ("data = {", 'data = { time = "none", ', "irregular sampling needs a column"),
        (
            'role = "time_step"',
            'role = "clock"',
            "expected 'disturbance', 'scheduling' or 'time_step'",
        ),
    ],
)
def test_a_problem_that_needs_one_sampling_time_is_refused(
    tmp_path: Path, before: str, after: str, message: str
) -> None:
    path = write(tmp_path) / "problem.toml"
    path.write_text(PROBLEM.replace(before, after, 1))
    with pytest.raises(UserError, match=message):
        load_problem(tmp_path)


def test_without_equations_the_records_must_be_resampled(tmp_path: Path) -> None:
    (write(tmp_path) / "problem.toml").write_text(PROBLEM.partition("[physics]")[0])
    with pytest.raises(UserError, match="leave this input out to have the records resampled"):
        load_problem(tmp_path)


def test_the_check_says_what_it_leaves_out(tmp_path: Path) -> None:
    problem = load_problem(write(tmp_path))
    report = check_problem(problem, seal(problem))
    first, *rest = report.lines()
    assert "sampled irregularly, every 0.0" in first
    assert "are left out" in first
    assert not any("Nyquist" in line or line.startswith("delay") for line in rest)
    seconds = np.loadtxt(tmp_path / "one.csv", delimiter=",", skiprows=1)[-1, 0]
    (line,) = [line for line in rest if line.startswith("record one")]
    assert float(line.split()[-2]) == pytest.approx(seconds, rel=0.02)
