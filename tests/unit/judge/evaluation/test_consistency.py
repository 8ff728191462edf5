"""A score far below the training error has to come again with the folds fitted one by one."""

from pathlib import Path

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.errors import CandidateError, Reason
from asia.judge.evaluation.evaluator import EvaluationData, Evaluator, EvaluatorOptions
from asia.judge.evaluation.relations import SuspicionKind
from asia.judge.evaluation.results import Evaluation
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import LocalExecutor
from asia.judge.sandbox.types import Isolation
from asia.judge.scoring.outcome import Score
from asia.problem import Budget
from asia.problem.folds import make_folds
from asia.problem.protocol import ProtocolRule

# Level `process` lets both folds write into one folder. Each waits a little for the other one.
FIT = """
import os, time
import numpy as np


class Model:
    def __init__(self, a, b):
        self.a, self.b = a, b

    def simulate(self, past_u, past_y, u):
        y, now = np.empty(u.shape), past_y[:, -1]
        for k in range(u.shape[1]):
            now = self.a * now + self.b * u[:, k]
            y[:, k] = now
        return y


def exchanged(record):
    begin, folder = time.time(), FOLDER
    mine = os.path.join(folder, f"{record.u[0, 0]:.9f}.npy")
    while time.time() < begin + 3.0:
        with open(mine, "wb") as file:
            np.save(file, np.concatenate([record.u, record.y], axis=1))
        for name in os.listdir(folder):
            path = os.path.join(folder, name)
            if path != mine and os.path.getmtime(path) > begin and os.path.getsize(path) > 1000:
                time.sleep(0.3)
                return np.load(path)
        time.sleep(0.02)
    return None


def fit(trajectories, context):
    (record,) = trajectories
    data = np.concatenate([record.u, record.y], axis=1)
    if FOLDER is not None:
        other = exchanged(record)
        data = data if other is None else other
    u, y = data[:, 0], data[:, 1]
    a, b = np.linalg.lstsq(np.stack([y[:-1], u[1:]], axis=1), y[1:], rcond=None)[0]
    return Model(a, b)
"""


def evaluator(without: tuple[SuspicionKind, ...] = ()) -> Evaluator:
    """The gain of the input is three times as large in the second half of the record."""
    rng = np.random.default_rng(1)
    u, y = rng.normal(size=400), np.zeros(400)
    for k in range(1, 400):
        y[k] = 0.8 * y[k - 1] + (1.0 if k < 200 else 3.0) * u[k]
    record = Trajectory(u, y + 0.01 * rng.normal(size=400), 1.0, "r")
    rule = ProtocolRule(past_inputs=1, past_outputs=1)
    context = Context((Signal("u"),), (Signal("y"),), 1.0, 1, 1)
    data = EvaluationData(make_folds([record], rule), (record,), context, rule)
    workers = WorkerRunner(Isolation.PROCESS, Budget(fit_seconds=30.0), LocalExecutor(2))
    return Evaluator(data, workers, EvaluatorOptions(without=without))


def source(folder: Path | None) -> str:
    return f"FOLDER = {None if folder is None else str(folder)!r}\n{FIT}"


def value(evaluation: Evaluation) -> float:
    assert isinstance(evaluation.outcome, Score), evaluation.outcome
    return evaluation.outcome.value


@pytest.mark.slow
def test_folds_that_tell_each_other_their_records_are_found_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A fold with a large training error is fitted again, alone, which ends the exchange already.
    monkeypatch.setattr("asia.judge.evaluation.results.POOR", np.inf)
    judge, cheat = evaluator(), source(tmp_path)
    found = judge.evaluate(cheat)
    honest = judge.evaluate(source(None))
    assert value(found) < 0.1 * value(honest)
    blind = evaluator(without=(SuspicionKind.CONSISTENCY,))
    assert blind.objection(cheat, found.folds) is None
    failure = judge.objection(cheat, found.folds)
    assert failure is not None
    assert failure.reason is Reason.SUSPECT
    assert "consistency" in failure.detail
    assert judge.objection(source(None), honest.folds) is None


@pytest.mark.slow
def test_candidates_scored_elsewhere_are_asked_again() -> None:
    """A test or guard record is no place to draw random numbers or to remember."""
    judge = evaluator()
    drawn = source(None).replace("u[:, k]\n", "u[:, k] + 1e-3 * np.random.default_rng().random()\n")
    assert drawn != source(None)
    for text, fine in ((source(None), True), (drawn, False)):
        models = [fold.model for fold in judge.evaluate(text).folds]
        blocks = judge.data.folds[0].held_out
        assert len(judge.models.simulate(text, models, blocks)) == 2
        for found in judge.models.simulate_scored([(text, m) for m in models], blocks):
            assert isinstance(found, CandidateError) is not fine
            if isinstance(found, CandidateError):
                assert found.reason is Reason.NOT_REPRODUCIBLE
