"""Models that answer guard or test records are asked again."""

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.errors import CandidateError, Reason
from asia.judge.evaluation.evaluator import EvaluationData, Evaluator
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import LocalExecutor
from asia.judge.sandbox.types import Isolation
from asia.problem import Budget
from asia.problem.folds import make_folds
from asia.problem.protocol import ProtocolRule

FIT = """
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


def fit(trajectories, context):
    (record,) = trajectories
    u, y = record.u[:, 0], record.y[:, 0]
    a, b = np.linalg.lstsq(np.stack([y[:-1], u[1:]], axis=1), y[1:], rcond=None)[0]
    return Model(a, b)
"""


@pytest.mark.slow
def test_candidates_scored_elsewhere_are_asked_again() -> None:
    """A test or guard record is no place to draw random numbers or to remember."""
    rng = np.random.default_rng(1)
    u, y = rng.normal(size=400), np.zeros(400)
    for k in range(1, 400):
        y[k] = 0.8 * y[k - 1] + u[k]
    record = Trajectory(u, y + 0.01 * rng.normal(size=400), 1.0, "r")
    rule = ProtocolRule(past_inputs=1, past_outputs=1)
    context = Context((Signal("u"),), (Signal("y"),), 1.0, 1, 1)
    data = EvaluationData(make_folds([record], rule), (record,), context, rule)
    workers = WorkerRunner(Isolation.PROCESS, Budget(fit_seconds=30.0), LocalExecutor(2))
    judge = Evaluator(data, workers)
    drawn = FIT.replace("u[:, k]\n", "u[:, k] + 1e-3 * np.random.default_rng().random()\n")
    assert drawn != FIT
    for text, fine in ((FIT, True), (drawn, False)):
        scored = judge.evaluate(text)
        models = [scored.artifacts.get(fold.model) for fold in scored.folds]
        blocks = judge.data.folds[0].held_out
        assert len(judge.models.simulate(text, models, blocks)) == 2
        for found in judge.models.simulate_scored([(text, m) for m in models], blocks):
            assert isinstance(found, CandidateError) is not fine
            if isinstance(found, CandidateError):
                assert found.reason is Reason.NOT_REPRODUCIBLE
