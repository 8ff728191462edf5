"""Searches on records that no model can come from end with the cause."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asia.agents.expert.agent import ExpertAgent
from asia.analysis.verdict import Usability, usability
from asia.candidate import Context
from asia.data import Signal
from asia.errors import UserError
from asia.export.linear import linearize
from asia.judge.evaluation.evaluator import EvaluationData, Evaluator, EvaluatorOptions
from asia.judge.evaluation.references import LINEAR
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import LocalExecutor
from asia.ledger.run import open_run
from asia.models import linear
from asia.problem.feedback import Loop
from asia.problem.folds import make_folds
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from asia.search.final import unheeded_feedback
from asia.search.run import level_here, prepare, search, search_context
from tests.unit.models.linear.test_closed_loop import record as in_loop
from tests.unit.search.toy import Scripted, write_problem

SAMPLES = 1000


def levels(rng: np.random.Generator, length: int) -> np.ndarray:
    return np.repeat(rng.standard_normal(SAMPLES // length), length)


def input_without_effect(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    y = np.zeros(SAMPLES)
    for k in range(1, SAMPLES):
        y[k] = 0.98 * y[k - 1] + 0.1 * rng.standard_normal()
    return levels(rng, 10), y


def unstable_plant(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A pendulum that a controller balances about a reference that is not recorded."""
    reference, x = np.sign(levels(rng, 25)), np.zeros(2)
    u, y = np.zeros(SAMPLES), np.zeros(SAMPLES)
    for k in range(SAMPLES):
        y[k] = x[0] + 0.02 * rng.standard_normal()
        u[k] = -(6.0 * (x[0] - 0.5 * reference[k]) + 2.5 * x[1])
        x = x + 0.1 * np.array([x[1], 3.0 * x[0] + u[k]])
    return u, y


def integrator(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A cart whose position a controller holds, with noise that the controller feeds back."""
    reference, x = np.sign(levels(rng, 25)), 0.0
    u, y = np.zeros(SAMPLES), np.zeros(SAMPLES)
    for k in range(SAMPLES):
        y[k] = x + 0.02 * rng.standard_normal()
        u[k] = 1.5 * (reference[k] - y[k])
        x += 0.1 * u[k] + 0.003 * rng.standard_normal()
    return u, y


def problem_of(directory: Path, u: np.ndarray, y: np.ndarray) -> Problem:
    problem = write_problem(directory / "case", experiments=1, test=False)
    table = np.stack([u, y], axis=1)
    np.savetxt(problem / "train.csv", table, delimiter=",", header="u,y", comments="")
    (problem / "baseline.py").write_text(LINEAR)
    return load_problem(problem)


def judged(directory: Path, u: np.ndarray, y: np.ndarray) -> Usability:
    problem = problem_of(directory, u, y)
    ready = prepare(problem, ExpertAgent.name, seed=0, runs=directory / "runs")
    found = usability(search(ready, ExpertAgent(), lambda event, view: None, lambda view: None))
    assert found is not None
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("records", "kind", "cause"),
    [
        pytest.param(
            input_without_effect,
            "not usable",
            "no input and no squared input has a significant",
            marks=pytest.mark.long,
        ),
        (unstable_plant, "not usable", "Input u follows earlier outputs, and the plant between"),
        pytest.param(
            integrator,
            "doubtful",
            "Input u follows earlier outputs: in closed loop",
            marks=pytest.mark.long,
        ),
    ],
)
def test_the_verdict_names_the_cause(
    tmp_path: Path, records: object, kind: str, cause: str
) -> None:
    assert callable(records)
    found = judged(tmp_path, *records(np.random.default_rng(6)))
    assert found.kind == kind
    assert any(cause in reason for reason in found.reasons), found.reasons


def test_a_best_candidate_that_ignores_a_declared_loop_is_doubtful(tmp_path: Path) -> None:
    plain = load_problem(write_problem(tmp_path / "case", experiments=1, test=False))
    problem = replace(plain, loop=Loop(reference=(Signal("r"),)))
    found = unheeded_feedback(problem, LINEAR)
    assert found is not None
    assert found.declared
    aware = LINEAR.replace("periodic=True", 'loop="direct"')
    assert aware != LINEAR
    assert unheeded_feedback(problem, aware) is None
    explained = replace(problem, loop=Loop(reference=(Signal("r"),), inputs="explained"))
    assert unheeded_feedback(explained, LINEAR) is None


def loop_problem(directory: Path) -> Path:
    """Records of a plant with a static gain of 1, in a declared loop."""
    record = in_loop(0.8, 0, samples=900)
    assert record.reference is not None
    problem = write_problem(directory / "case", experiments=4, test=False)
    table = np.hstack([record.u, record.y, record.reference])
    np.savetxt(problem / "train.csv", table, delimiter=",", header="u,y,r", comments="")
    (problem / "baseline.py").unlink()
    with (problem / "problem.toml").open("a") as file:
        file.write('\n[loop]\nreference = "r"\n')
    return problem


@pytest.mark.long
def test_a_short_search_with_a_declared_loop_finds_the_gain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("asia.judge.evaluation.references.LINEAR", LINEAR)
    problem = load_problem(loop_problem(tmp_path))
    ready = prepare(problem, ExpertAgent.name, seed=0, runs=tmp_path / "runs")
    view = search(ready, ExpertAgent(), lambda event, view: None, lambda view: None)
    (point,) = linearize(ready.directory).points
    assert point.model.gain[0, 0] == pytest.approx(1.0, rel=0.1)
    context = Context(problem.inputs, problem.outputs, 1.0, 10, 10)
    config = linear.Config(order=None, delay=None)
    biased = linear.train(linear.build(config, context), list(problem.train), context)
    assert biased.parameters()["gain y1/u1"] < 0.8
    assert view.refitted is not None
    assert view.refitted.feedback is None
    found = usability(view)
    assert found is not None
    assert not any("than a linear model" in reason for reason in found.reasons)
    store = open_run(ready.directory).store
    assert all("loop=" in store.text(e.proposed.source) for e in view.experiments)


@pytest.mark.long
def test_the_verdict_on_a_biased_best_candidate_names_an_experiment_without_bias(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("asia.judge.evaluation.references.LINEAR", LINEAR)
    agent = Scripted((LINEAR,))
    problem = load_problem(loop_problem(tmp_path))
    ready = prepare(problem, agent.name, seed=0, runs=tmp_path / "runs")
    view = search(ready, agent, lambda event, view: None, lambda view: None)
    assert view.best is not None
    assert view.best.number == 2  # The biased model has the lower V.
    found = usability(view)
    assert found is not None
    assert found.kind == "doubtful"
    assert any('Compare #01, linear with loop = "direct"' in reason for reason in found.reasons)


@pytest.mark.long
def test_an_honest_linear_model_of_slow_states_is_scored_whatever_cases_are_drawn(
    tmp_path: Path,
) -> None:
    """Its past window hardly shows one of two slow states, so that it continues along a ramp."""
    problem = problem_of(tmp_path, *integrator(np.random.default_rng(6)))
    rule, context = problem.protocol, search_context(problem, 0)
    folds = make_folds(problem.train, rule)
    data = EvaluationData(folds, problem.train, context, rule)
    workers = WorkerRunner(level_here(), problem.budget, LocalExecutor())
    found = Evaluator(data, workers).evaluate(LINEAR)
    for salt in "abc":
        drawn = Evaluator(data, workers, EvaluatorOptions(salt))
        assert drawn.objection(LINEAR, found) is None


def test_an_output_that_never_moves_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="'y' is 3 in every training sample"):
        judged(tmp_path, levels(np.random.default_rng(0), 10), np.full(SAMPLES, 3.0))
