"""Time records and frequency responses together: the sampled response, the fit, the problem."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lsim

from asia.agents.llm.prompt import briefing
from asia.candidate import Context
from asia.data.frequency import ComplexArray, FrequencyRecord
from asia.data.intake.frequency import read_frequency_response, write_response
from asia.data.trajectory import Array, Signal, Trajectory
from asia.errors import UserError
from asia.judge.evaluation.fold_fits import search_context
from asia.lowering.linear import LinearModel
from asia.models import linear
from asia.models.frequency_response import (
    FrequencyFit,
    delayed_response,
    response_slopes,
    sampled_response,
)
from asia.problem.load import load_lock, load_problem
from asia.problem.lock import lock_text
from asia.problem.problem import training_text
from asia.problem.seal import seal
from asia.search.agent_views import problem_facts

STEP, FINE = 0.05, 10
ZERO = np.zeros(1)


def modes(*each: tuple[float, float, float]) -> LinearModel:
    """A sum of modes (frequency in Hz, damping, gain) in continuous time."""
    n = 2 * len(each)
    a, b, c = np.zeros((n, n)), np.zeros((n, 1)), np.zeros((1, n))
    for k, (f, damping, gain) in enumerate(each):
        w, i = 2 * np.pi * f, 2 * k
        a[i : i + 2, i : i + 2] = [[0.0, w], [-w, -2 * damping * w]]
        b[i + 1, 0], c[0, i] = w * gain, 1.0
    return LinearModel(a, b, c, np.zeros((1, 1)), 0.0, ZERO, ZERO)


PLANT = modes((1.0, 0.05, 1.0), (6.0, 0.02, 0.5))


def simulated(model: LinearModel, u: Array, late: int) -> Array:
    """Outputs for inputs held over a sample, which arrive `late` tenths of a sample later."""
    held = np.concatenate([np.zeros(late), np.repeat(u, FINE)])[: len(u) * FINE]
    system, t = (model.a, model.b, model.c, model.d), STEP / FINE * np.arange(len(held))
    return lsim(system, held, t, interp=False)[1][::FINE]


def record(
    f: Array, response: ComplexArray, variance: Array | None = None, step: float = 0.0
) -> FrequencyRecord:
    signals = (Signal("force"),), (Signal("tip"),)
    return FrequencyRecord("measured", f, response, variance, step, *signals)


def fit_of(known: FrequencyRecord, model: LinearModel, delay: float) -> FrequencyFit:
    return FrequencyFit(known, model, delay, (delay, delay), (), 0.0, 0.0, ())


@pytest.mark.parametrize("late", [0, 7, 20, 23])
def test_the_sampled_response_is_that_of_held_inputs(late: int) -> None:
    f, delay = np.linspace(0.0, 10.0, 41), late * STEP / FINE
    pulse = np.zeros(1600)
    pulse[0] = 1.0
    answer = simulated(PLANT, pulse, late)
    true = np.exp(-2j * np.pi * np.outer(f, np.arange(1600)) * STEP) @ answer
    measured = record(f, delayed_response(PLANT, delay, f))
    found = sampled_response(fit_of(measured, PLANT, delay), STEP)
    assert found.sampling_time == STEP
    assert np.abs(found.response[:, 0, 0] - true).max() < 1e-8 * np.abs(true).max()
    assert sampled_response(fit_of(found, PLANT, delay), STEP) is found


def test_the_derivatives_of_a_response_agree_with_differences() -> None:
    rng = np.random.default_rng(0)
    shapes = (3, 3), (3, 2), (2, 3), (2, 2)
    parts = [rng.normal(size=shape) for shape in shapes]
    p = np.exp(1j * np.linspace(0.1, 3.0, 7))

    def response(theta: Array) -> ComplexArray:
        cut = np.split(theta, np.cumsum([part.size for part in parts])[:-1])
        a, b, c, d = (v.reshape(s) for v, s in zip(cut, shapes, strict=True))
        return c @ np.linalg.solve(p[:, None, None] * np.eye(3) - a, b + 0j) + d

    theta, step = np.concatenate([part.ravel() for part in parts]), 1e-6
    moves = step * np.eye(len(theta))
    apart = [(response(theta + m) - response(theta - m)) / (2 * step) for m in moves]
    found = response_slopes(*parts[:3], p)
    assert np.abs(found - np.stack(apart, axis=-1)).max() < 1e-6 * np.abs(found).max()


def observed(seed: int) -> tuple[Trajectory, FrequencyRecord]:
    """A short and noisy record, whose slow input hardly excites the second mode, and a response
    that begins above the first one."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=20), 15)
    y = simulated(PLANT, u, 0)
    y += 0.2 * y.std() * rng.normal(size=len(y))
    f = np.geomspace(2.5, 10.0, 60)
    g = PLANT.response(f)
    deviation = 0.02 * np.abs(g) + 0.002
    g = g + deviation * (rng.normal(size=g.shape) + 1j * rng.normal(size=g.shape)) / np.sqrt(2.0)
    return Trajectory(u[:, None], y[:, None], STEP, "one"), record(f, g, deviation**2)


@pytest.mark.long
@pytest.mark.parametrize("known", [True, False])
def test_a_response_adds_what_a_short_record_does_not_show(known: bool) -> None:
    trajectory, measured = observed(1)
    measured = measured if known else replace(measured, variance=None)
    alone = Context((Signal("force"),), (Signal("tip"),), STEP, 8, 8)
    u = np.random.default_rng(9).normal(size=400)
    y, errors = simulated(PLANT, u, 0), list[float]()
    for context in (alone, replace(alone, responses=(measured,))):
        fitted = linear.train(linear.build(linear.Config(), context), [trajectory], context).fitted
        assert isinstance(fitted, linear.FittedLinear)
        past = u[None, :8, None], y[None, :8, None]
        found = fitted.simulate(*past, u[None, 8:, None])[0, :, 0]
        errors.append(float((found - y[8:]).std() / y.std()))
    assert errors[1] < 0.03
    assert errors[1] < 0.5 * errors[0]


def problem_of(folder: Path, more: str = "", train: bool = True) -> Path:
    trajectory, measured = observed(2)
    table = np.column_stack([np.arange(len(trajectory)) * STEP, trajectory.u, trajectory.y])
    np.savetxt(folder / "one.csv", table, delimiter=",", header="time,force,tip", comments="")
    write_response(folder / "tip.npz", measured)
    records = 'train = ["one.csv"], ' if train else ""
    (folder / "problem.toml").write_text(
        f'sampling_time = {STEP}\ninputs = ["force"]\noutputs = ["tip"]\n'
        f'data = {{ {records}frequency = ["tip.npz"] }}\n{more}'
    )
    return folder


def test_the_responses_of_a_problem_reach_fits_locks_and_workspaces(tmp_path: Path) -> None:
    problem = load_problem(problem_of(tmp_path))
    (measured,) = problem.responses
    assert search_context(problem, 0).responses == problem.responses
    assert "# Frequency responses\nfrequency response tip: 60" in briefing(problem_facts(problem))
    (tmp_path / "run").mkdir()
    lock = tmp_path / "run" / "problem.lock.toml"
    lock.write_text(lock_text(problem, seal(problem)))
    assert load_lock(lock).responses[0].digest == measured.digest
    assert 'frequency = ["data/response1.npz"]' in training_text(problem, ["one"])
    changed = replace(measured, response=1.01 * measured.response)
    write_response(tmp_path / "tip.npz", changed)
    with pytest.raises(UserError, match="the frequency responses changed since the run began"):
        load_lock(lock)


@pytest.mark.parametrize(
    ("more", "train", "says"),
    [
        ("", False, r"run asia linear tip.npz, which fits a response alone"),
        ("[preprocess]\ndetrend = true\n", True, r"leave \[preprocess\]"),
        ('[loop]\nreference = "r"\n', True, r"leave \[loop\] out"),
    ],
)
def test_a_response_that_no_search_can_use_is_refused(
    tmp_path: Path, more: str, train: bool, says: str
) -> None:
    folder = problem_of(tmp_path, more, train)
    if "loop" in more:
        table = np.loadtxt(folder / "one.csv", delimiter=",", skiprows=1)
        np.savetxt(folder / "one.csv", table[:, [0, 1, 2, 1]], delimiter=",",
                   header="time,force,tip,r", comments="")  # fmt: skip
    with pytest.raises(UserError, match=says):
        load_problem(folder)


def test_channels_of_a_response_are_matched_by_name(tmp_path: Path) -> None:
    f = np.linspace(0.1, 4.0, 20)
    response = np.arange(1, 5).reshape(1, 2, 2) * np.ones((20, 1, 1)) + 0j
    signals = tuple(map(Signal, "pq")), tuple(map(Signal, "ab"))
    known = FrequencyRecord("both", f, response, np.abs(response), 0.0, *signals)
    write_response(tmp_path / "both.npz", known)
    read = read_frequency_response(tmp_path / "both.npz")
    assert read.digest == known.digest
    found = read.of_channels(tuple(map(Signal, "qp")), tuple(map(Signal, "ba")), 0.2)
    assert found.response[0].real.tolist() == [[4, 3], [2, 1]]
    assert found.variance is not None
    assert found.variance[0].tolist() == [[4, 3], [2, 1]]
    assert found.frequency.max() <= 2.5
    others = tuple(map(Signal, "uv")), tuple(map(Signal, "xy"))
    assert read.of_channels(*others, 0.1).response[0].real.tolist() == [[1, 2], [3, 4]]
    for ends, step, says in (
        ((others[0], tuple(map(Signal, "ac"))), 0.1, "has the outputs a, b, expected a, c"),
        ((others[0], others[1][:1]), 0.1, "has the outputs a, b, expected x"),
        (others, 2.0, "expected at least 8"),
    ):
        with pytest.raises(UserError, match=says):
            read.of_channels(*ends, step)
    with pytest.raises(UserError, match="is sampled every"):
        replace(read, sampling_time=0.1).of_channels(*others, 0.2)
