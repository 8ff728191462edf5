"""Stress simulation: which model is named, and what is said where none stays bounded."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asia.analysis.verdict import usability
from asia.data import Trajectory
from asia.judge.sandbox.types import Isolation
from asia.ledger.events import StressTest, Use
from asia.ledger.run import ModelToUse
from asia.ledger.view import Experiment, SearchView
from asia.problem.load import load_problem
from asia.problem.protocol import ProtocolRule
from asia.search.run import prepare, search
from asia.search.stress import HORIZONS, StressRoom, bounded_model, largest_bend, stress_cases
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.search.toy import Scripted, arx

# A linear system and a term that the records do not show, because their inputs move together.
HIDDEN = """


class Hidden(Model):
    def simulate(self, past_u, past_y, u):
        apart = np.cumsum(np.maximum(np.abs(u[:, :, :1] - u[:, :, 1:]) - 0.5, 0.0), axis=1)
        return super().simulate(past_u, past_y, u) + 1e6 * apart


fit_well = fit


def fit(trajectories, context):
    return Hidden(fit_well(trajectories, context).weights)
"""


WORSE = """


class Worse(Model):
    def simulate(self, past_u, past_y, u):
        return 1.002 * super().simulate(past_u, past_y, u)


fit_well = fit


def fit(trajectories, context):
    return Worse(fit_well(trajectories, context).weights)
"""


def write_twins(directory: Path, *, integrator: bool = False) -> Path:
    """Two inputs that are always equal; or an integrator that one input fills, and that the other
    one drains as a controller asks."""
    rng = np.random.default_rng(0)
    directory.mkdir(parents=True)
    u = np.repeat(rng.normal(size=60), 5)
    other, y, noise = u.copy(), np.zeros(300), 1e-4 if integrator else 0.01
    for k in range(2, 300):
        if integrator:
            other[k] = 2.0 * y[max(k - 4, 0)]
            y[k] = y[k - 1] + 0.1 * (u[k] - other[k])
        else:
            y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + 0.2 * u[k] + 0.2 * other[k]
    table = np.stack([u, other, y + noise * rng.normal(size=300)], axis=1)
    np.savetxt(directory / "train.csv", table, delimiter=",", header="u1,u2,y", comments="")
    (directory / "baseline.py").write_text(arx(1))
    (directory / "problem.toml").write_text(
        'name = "twins"\nsampling_time = 0.5\ninputs = ["u1", "u2"]\noutputs = ["y"]\n'
        '[data]\ntrain = ["train.csv"]\n[protocol]\npast_inputs = 3\npast_outputs = 3\n'
        "[budget]\nexperiments = 3\nfit_seconds = 20\nretests = 0\n"
    )
    return directory


def ended(problem: Path, *sources: str) -> tuple[Path, SearchView]:
    agent = Scripted(sources)
    loaded = load_problem(problem)
    runs = problem.parent / "runs"
    ready = prepare(loaded, agent.name, seed=0, runs=runs, isolation=Isolation.PROCESS)
    return ready.directory, search(ready, agent, lambda event, view: None, lambda view: None)


@given(st.integers(0, 1000), st.integers(1, 3), st.sampled_from([None, 7]))
def test_cases_stay_inside_the_training_ranges(seed: int, inputs: int, horizon: int | None) -> None:
    random = np.random.default_rng(seed)
    records = [
        Trajectory(random.normal(size=(n, inputs)), random.normal(size=(n, 1)), 1.0)
        for n in (30, 41)
    ]
    rule = ProtocolRule(past_inputs=3, past_outputs=2, horizon=horizon)
    cases = stress_cases(records, rule, seed)
    every = np.concatenate([record.u for record in records])
    for case in cases:
        assert len(case.u) == (82 if horizon is None else HORIZONS * horizon)
        assert case.past_u.shape == (3, inputs)
        assert case.past_y.shape == (2, 1)
        assert (case.u >= every.min(axis=0)).all()
        assert (case.u <= every.max(axis=0)).all()


@pytest.mark.long
def test_a_bounded_candidate_is_named_where_the_best_candidate_diverges(tmp_path: Path) -> None:
    _, view = ended(write_twins(tmp_path / "twins"), arx(2) + HIDDEN, arx(2) + WORSE)
    refitted = view.refitted
    assert view.best is not None
    assert view.best.number == 2
    assert refitted is not None
    assert refitted.stack is not None
    assert [(m.experiment, m.weight) for m in refitted.stack.members] == [(3, 1.0)]
    assert refitted.use == "stack"
    assert [test.outcome for test in refitted.stress] == ["diverges", "diverges", "bounded"]
    assert refitted.stress[0].reach is not None
    assert refitted.stress[0].reach > 1e5
    assert "The ensemble of #03" in refitted.reason
    judged = usability(view)
    assert judged is not None
    assert judged.kind != "not usable"


class StackDrifts:
    """Stress simulation in which the stack alone drifts."""

    def test(self, use: Use, best: Experiment, *_: object) -> StressTest:
        outcome = "drifts" if use == "stack" else "bounded"
        return StressTest(use, best.number, 9.0, "y", None, outcome)


@pytest.mark.long
def test_where_the_stack_drifts_the_evidence_chooses_between_the_models_of_the_best_candidate(
    tmp_path: Path,
) -> None:
    _, view = ended(write_twins(tmp_path / "twins"), arx(2), arx(2) + WORSE)
    assert view.best is not None
    assert view.refitted is not None
    assert view.refitted.model is not None
    room, named = cast("StressRoom", StackDrifts()), ModelToUse("stack", "It is the best.")
    for second in ("refit", "ensemble"):
        found = bounded_model(room, view, view.best, view.refitted, named, second, lambda _: True)
        assert found.use == second


@pytest.mark.long
def test_a_search_without_a_bounded_candidate_says_not_usable(tmp_path: Path) -> None:
    directory, view = ended(write_twins(tmp_path / "twins"), arx(2) + HIDDEN)
    assert view.refitted is not None
    assert {test.outcome for test in view.refitted.stress} == {"diverges"}
    shown = command_line("status", "--runs", directory.parent)
    line = next(line for line in shown.out.splitlines() if line.startswith("verdict"))
    assert line.startswith("verdict  not usable: On training inputs in other combinations the")
    assert "times as far from the middle of its training range" in line


def test_the_largest_change_of_speed_hardly_counts_noise() -> None:
    k, rng = np.arange(1000.0), np.random.default_rng(0)
    force = np.where(k < 500, 2e-3, -1e-3)
    y = np.cumsum(np.cumsum(force)) + 0.02 * rng.normal(size=1000)
    assert largest_bend(y) == pytest.approx(2e-3, rel=0.5)
    assert np.abs(np.diff(y, 2)).max() > 0.1


@pytest.mark.long
def test_an_integrator_drifts_and_is_doubtful(tmp_path: Path) -> None:
    _, view = ended(write_twins(tmp_path / "twins", integrator=True), arx(2))
    assert view.refitted is not None
    assert {test.outcome for test in view.refitted.stress} == {"drifts"}
    judged = usability(view)
    assert judged is not None
    assert judged.kind == "doubtful"
    assert "Is the plant an integrator?" in " ".join(judged.reasons)
