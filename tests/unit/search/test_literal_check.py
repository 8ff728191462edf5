"""Data in the source of a new best: paid for by its gain, or asked about and refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asia.errors import Reason
from asia.ledger.run import open_run
from asia.ledger.verdict import alarms
from asia.ledger.verification import verify
from asia.ledger.view import SearchView
from asia.problem.load import load_problem
from asia.search.replay import replay_run
from asia.search.run import prepare, search

from .toy import Scripted, arx, write_problem

# An honest model of the first order, and the error of its free simulation stored for each sample;
# the first input counts the samples.
COPY = """

STORED = {stored}


class Copy(Model):
    def simulate(self, past_u, past_y, u):
        y = super().simulate(past_u, past_y, u)
        start = int(round(past_u[0, -1, 0])) + 1
        part = np.array(STORED)[start : start + u.shape[1]]
        y[0, : len(part), 0] += part
        return y


def fit(trajectories, context):
    return Copy(train(trajectories, context).weights)
"""
WEIGHTS = (0.8, 0.0, 0.4, 0.0, 0.3)


def write_counted(directory: Path, *, guard: bool) -> Path:
    """The toy problem with a count of the samples among its inputs."""
    problem = write_problem(directory, experiments=4, test=False)
    table = np.loadtxt(problem / "train.csv", delimiter=",", skiprows=1)
    rng = np.random.default_rng(9)
    u = rng.normal(size=len(table))
    y = np.zeros(len(u))
    for k in range(2, len(u)):
        y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + 0.4 * u[k] + 0.2 * u[k - 1]
    unseen = np.stack([u, y + 0.01 * rng.normal(size=len(u))], axis=1)
    for name, values in (("train", table), ("unseen", unseen)):
        counted = np.column_stack([np.arange(len(values)), values])
        path = problem / f"{name}.csv"
        np.savetxt(path, counted, delimiter=",", header="n,u,y", comments="")
    text = (problem / "problem.toml").read_text().replace('["u"]', '["n", "u"]')
    if guard:
        text = text.replace("[data]\n", '[data]\nguard = ["unseen.csv"]\n')
    (problem / "problem.toml").write_text(text)
    return problem


def errors(problem: Path) -> list[float]:
    """Error of the first-order model on the training record."""
    record = load_problem(problem).train[0]
    u, y = record.u, record.y[:, 0]
    rows = np.column_stack([y[:-1], u[1:], u[:-1]])
    weights = np.linalg.lstsq(rows, y[1:], rcond=None)[0]
    free = y.copy()
    for k in range(1, len(y)):
        free[k] = np.concatenate([free[k - 1 : k], u[k], u[k - 1]]) @ weights
    return (y - free).tolist()


def copy(stored: str) -> str:
    return arx(1).replace("def fit(", "def train(") + COPY.replace("{stored}", stored)


def letters(values: list[float]) -> str:
    levels = np.round(np.clip(np.array(values) / 0.05 + 12.5, 0, 25)).astype(int)
    text = "".join(chr(97 + level) for level in levels.tolist())
    return f"[(ord(one) - 97 - 12.5) * 0.05 for one in {text!r}]"


def go(problem: Path, runs: Path, *sources: str) -> SearchView:
    agent = Scripted(sources)
    loaded = load_problem(problem)
    loaded = replace(loaded, budget=replace(loaded.budget, experiments=len(sources) + 1))
    ready = prepare(loaded, agent.name, seed=0, runs=runs)
    return search(ready, agent, lambda event, view: None, lambda view: None)


@pytest.mark.slow
@pytest.mark.parametrize("guard", [True, pytest.param(False, marks=pytest.mark.long)])
def test_a_record_in_letters_is_suspect_and_an_honest_model_is_kept(tmp_path: Path, guard: bool):
    problem = write_counted(tmp_path / "toy", guard=guard)
    view = go(problem, tmp_path / "runs", copy(letters(errors(problem))), arx(2))
    copied, honest = view.finished[1:]
    assert copied.failure is not None
    assert copied.failure.reason is Reason.LITERALS
    assert "bits of data more than #01" in copied.failure.detail
    assert copied.result is not None
    check = copied.result.literals
    assert check is not None
    assert check.bits > 800.0
    assert check.gain < 10.0 * check.bits
    assert (check.guard is not None) == guard
    assert honest.kept
    assert honest.result is not None
    assert honest.result.literals is not None
    assert honest.result.literals.affordable
    directory = tmp_path / "runs" / "toy-scripted-s0"
    verify(directory)
    assert replay_run(directory, lambda item: None).agrees


@pytest.mark.slow
def test_small_edits_add_up(tmp_path: Path):
    problem = write_counted(tmp_path / "toy", guard=True)
    values = errors(problem)
    worst = np.argsort(-np.abs(values))
    sources: list[str] = []
    for count in (8, 16, 32, 64):
        kept = dict.fromkeys(worst[:count].tolist())
        table = {k: round(values[k], 1) for k in kept}
        sources.append(copy(f"[{table}.get(k, 0.0) for k in range({len(values)})]"))
    view = go(problem, tmp_path / "runs", *sources)
    reasons = [e.failure.reason if e.failure else None for e in view.finished[1:]]
    assert reasons[-1] is Reason.LITERALS
    first, best = view.finished[0].score, view.best
    assert first is not None
    assert best is not None
    assert best.score is not None
    assert best.score.value > 0.5 * first.value


@pytest.mark.slow
def test_v_below_the_simulated_truth_is_an_alarm(tmp_path: Path):
    problem = load_problem("two_tanks_sim")
    problem = replace(problem, budget=replace(problem.budget, experiments=1, retests=0))
    truth = tuple(2.0 * y for y in problem.truth or ())
    ready = prepare(replace(problem, truth=truth), "scripted", seed=0, runs=tmp_path)
    view = search(ready, Scripted(()), lambda event, view: None, lambda view: None)
    (words,) = alarms(open_run(ready.directory).view)
    assert "below that of the simulated truth" in words
    assert view.best is not None
