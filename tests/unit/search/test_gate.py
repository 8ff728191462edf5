"""The gate: a gain that records which nobody could read do not confirm is neither kept nor best."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asia.analysis.verdict import alarms, unguarded, usability
from asia.errors import UserError
from asia.judge.sandbox.types import Isolation
from asia.ledger.run import open_run, scored_experiment
from asia.ledger.verification import verify
from asia.ledger.view import Experiment, SearchView
from asia.problem.load import load_problem
from asia.search.extension import leading_experiments
from asia.search.replay import replay_run
from asia.search.run import guard_share, prepare, search
from asia.search.unsealing import unseal

from .toy import Scripted, arx, write_problem

# An honest model of the first order, and the error of its free simulation stored for each sample;
# the first input counts the samples.
COPY = """

STORED = {stored}


class Copy(Model):
    def simulate(self, past_u, past_y, u):
        y = super().simulate(past_u, past_y, u)
        start = int(round(past_u[0, -1, 0])) + 1
        part = {share} * np.array(STORED)[start : start + u.shape[1]]
        y[0, : len(part), 0] += part
        return y


def fit(trajectories, context):
    return Copy(train(trajectories, context).weights)
"""


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


def letters(values: list[float]) -> str:
    """One letter for each value, in steps of 0.05."""
    levels = np.round(np.clip(np.array(values) / 0.05 + 12.5, 0, 25)).astype(int)
    return "".join(chr(97 + level) for level in levels.tolist())


def copy(stored: str, share: float = 1.0) -> str:
    text = COPY.replace("{stored}", stored).replace("{share}", str(share))
    return arx(1).replace("def fit(", "def train(") + text


def in_an_order(values: list[float]) -> str:
    """The record in the order of one-letter strings."""
    table = ", ".join(repr(letter) for letter in letters(values))
    return copy(f"[(ord(one) - 97 - 12.5) * 0.05 for one in [{table}]]")


# Level `process` lets both folds write into one folder. Each waits a little for the other one,
# and answers with its record.
WHISPER = """
import os, time

FOLDER = {folder}


def exchanged(record):
    begin = time.time()
    mine = os.path.join(FOLDER, f"{record.u[0, 0]:.9f}.npy")
    while time.time() < begin + 5.0:
        with open(mine, "wb") as file:
            np.save(file, np.concatenate([record.u, record.y], axis=1))
        for name in os.listdir(FOLDER):
            path = os.path.join(FOLDER, name)
            if path != mine and os.path.getmtime(path) > begin and os.path.getsize(path) > 1000:
                time.sleep(0.3)
                return np.load(path)
        time.sleep(0.02)
    return None


def fit(trajectories, context):
    other = exchanged(trajectories[0])
    if other is None:
        return train(trajectories, context)
    from types import SimpleNamespace

    class Record(SimpleNamespace):
        def __len__(self):
            return len(self.u)

    return train([Record(u=other[:, :1], y=other[:, 1:])], context)
"""


def write_changing(directory: Path) -> Path:
    """The toy problem with a gain that is three times as large in the second half."""
    problem = write_problem(directory, experiments=2, test=False)
    rng = np.random.default_rng(1)
    u, y = rng.normal(size=240), np.zeros(240)
    for k in range(1, 240):
        y[k] = 0.8 * y[k - 1] + (1.0 if k < 120 else 3.0) * u[k]
    table = np.stack([u, y + 0.01 * rng.normal(size=240)], axis=1)
    np.savetxt(problem / "train.csv", table, delimiter=",", header="u,y", comments="")
    return problem


# A network of one layer with random features, fitted by least squares without a ridge.
NETWORK = """
import numpy as np


class Model:
    def __init__(self, features, scale, weights):
        self.features, self.scale, self.weights = features, scale, weights

    def rows(self, x):
        return np.hstack([np.tanh(x @ self.features), x, np.ones((len(x), 1))])

    def simulate(self, past_u, past_y, u):
        y = [past_y[:, -2], past_y[:, -1]]
        x = np.concatenate([past_u, u], axis=1)
        for k in range(past_u.shape[1], x.shape[1]):
            row = np.hstack([y[-1], y[-2], x[:, k], x[:, k - 1], x[:, k - 2]]) / self.scale
            y.append(np.clip(self.rows(row) @ self.weights, -20.0, 20.0))
        return np.stack(y[2:], axis=1)


def fit(trajectories, context):
    (t,) = trajectories
    x = np.hstack([t.y[1:-1], t.y[:-2], t.u[2:], t.u[1:-1], t.u[:-2]])
    features = np.random.default_rng({seed}).normal(size=(5, 20))
    model = Model(features, x.std(axis=0), None)
    model.weights = np.linalg.lstsq(model.rows(x / model.scale), t.y[2:], rcond=None)[0]
    return model
"""


def write_short(directory: Path) -> Path:
    """A Hammerstein system with noise, 200 samples."""
    problem = write_problem(directory, experiments=2, test=False)
    rng = np.random.default_rng(0)
    u, x = rng.normal(size=250), np.zeros(250)
    for k in range(1, 250):
        x[k] = 0.8 * x[k - 1] + 0.5 * np.tanh(1.5 * u[k - 1])
    table = np.stack([u, x + 0.15 * rng.normal(size=250)], axis=1)[50:]
    np.savetxt(problem / "train.csv", table, delimiter=",", header="u,y", comments="")
    return problem


def whisper(folder: Path) -> str:
    text = WHISPER.replace("{folder}", repr(str(folder)))
    return arx(1).replace("def fit(", "def train(") + text


def go(problem: Path, runs: Path, *sources: str, isolation: Isolation | None = None) -> SearchView:
    agent = Scripted(sources)
    loaded = load_problem(problem)
    loaded = replace(loaded, budget=replace(loaded.budget, experiments=len(sources) + 1))
    ready = prepare(loaded, agent.name, seed=0, runs=runs, isolation=isolation)
    return search(ready, agent, lambda event, view: None, lambda view: None)


def statuses(view: SearchView) -> list[str]:
    return [e.result.status for e in view.finished if e.result]


def value(e: Experiment) -> float:
    assert e.score is not None
    return e.score.value


def test_a_copied_record_is_unconfirmed_and_an_honest_model_is_kept(tmp_path: Path):
    problem = write_counted(tmp_path / "toy", guard=True)
    view = go(problem, tmp_path / "runs", in_an_order(errors(problem)), arx(2))
    first, whole, honest = view.finished
    assert statuses(view) == ["keep", "unconfirmed", "keep"]
    assert value(whole) < value(first)
    assert view.bests == (first, honest)
    assert view.guard_bits == 2
    run = open_run(tmp_path / "runs" / "toy-scripted-s0")
    assert {e.number for e in leading_experiments(view, 5, 1e9)} == {first.number, honest.number}
    with pytest.raises(UserError, match="unconfirmed"):
        scored_experiment(run, whole.number)
    assert view.refitted is not None
    assert view.refitted.experiment == honest.number
    members = view.refitted.stack.members if view.refitted.stack else ()
    assert {m.experiment for m in members} <= {first.number, honest.number}
    assert not alarms(view)
    verify(run.directory)


@pytest.mark.slow
def test_without_the_gate_the_same_copy_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("asia.search.run.can_read_records", lambda names: False)
    problem = write_counted(tmp_path / "toy", guard=True)
    view = go(problem, tmp_path / "runs", in_an_order(errors(problem)))
    assert statuses(view) == ["keep", "keep"]
    # The last look at the guard records says so.
    (words,) = alarms(view)
    assert "V is no measure of this model" in words


@pytest.mark.slow
def test_folds_that_whisper_are_unconfirmed(tmp_path: Path):
    # Without guard records the fits one by one are enough.
    problem = write_changing(tmp_path / "toy")
    (folder := tmp_path / "shared").mkdir()
    view = go(problem, tmp_path / "runs", whisper(folder), isolation=Isolation.PROCESS)
    first, told = view.finished
    assert told.failure is None, told.failure
    assert value(told) < 0.6 * value(first)
    assert statuses(view) == ["keep", "unconfirmed"]
    assert told.result is not None
    assert told.result.confirmation is not None
    assert told.result.confirmation.sequential == pytest.approx(0.0, abs=0.01)


@pytest.mark.slow
def test_an_honest_network_that_overfits_is_unconfirmed(tmp_path: Path):
    problem = load_problem(write_short(tmp_path / "toy"), guard_share("scripted", None))
    sources = tuple(NETWORK.replace("{seed}", str(seed)) for seed in (0, 6, 7))
    problem = replace(problem, budget=replace(problem.budget, experiments=4))
    ready = prepare(problem, "scripted", seed=0, runs=tmp_path / "runs")
    view = search(ready, Scripted(sources), lambda event, view: None, lambda view: None)
    assert statuses(view) == ["keep", "keep", "unconfirmed", "unconfirmed"]
    assert view.best == view.finished[1]
    assert value(view.finished[2]) < 0.8 * value(view.finished[1])


@pytest.mark.slow
def test_a_first_best_that_fails_on_the_guard_records_stands_in_no_way(tmp_path: Path):
    # Harmless inside the range of the training records; the guard goes three times as far.
    problem = write_problem(tmp_path / "toy", experiments=2, test=False)
    rng = np.random.default_rng(3)
    for name, size in (("train", 1.0), ("unseen", 3.0)):
        u, y = size * rng.normal(size=240), np.zeros(240)
        for k in range(2, 240):
            y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + 0.4 * u[k] + 0.2 * u[k - 1]
        table = np.stack([u, y + 0.01 * rng.normal(size=240)], axis=1)
        np.savetxt(problem / f"{name}.csv", table, delimiter=",", header="u,y", comments="")
    text = (problem / "problem.toml").read_text()
    guarded = text.replace("[data]\n", '[data]\nguard = ["unseen.csv"]\n')
    (problem / "problem.toml").write_text(guarded)
    step = "np.concatenate(lags, axis=1) @ self.weights"
    grown = f"{step} + 2e-3 * np.sinh(np.abs(y[:, k-1])) * np.sign(y[:, k-1])"
    (problem / "baseline.py").write_text(arx(1).replace(step, grown))
    alone = go(problem, tmp_path / "alone")
    assert any("fails on the guard records" in words for words in alarms(alone))
    view = go(problem, tmp_path / "runs", arx(2))
    assert statuses(view) == ["keep", "keep"]
    assert view.guard_bits == 1
    assert not alarms(view)
    assert replay_run(tmp_path / "runs" / "toy-scripted-s0", lambda item: None).agrees


@pytest.mark.slow
def test_without_guard_records_a_result_is_doubtful_at_most(tmp_path: Path):
    problem = write_counted(tmp_path / "toy", guard=False)
    view = go(problem, tmp_path / "runs", arx(2))
    assert view.started.gate
    assert statuses(view) == ["keep", "keep"]
    judged = usability(view)
    assert judged is not None
    assert judged.kind != "usable"
    assert unguarded(view) in judged.reasons
    with pytest.raises(UserError, match="has no test data"):
        unseal(tmp_path / "runs" / "toy-scripted-s0", process_consent=True)


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
