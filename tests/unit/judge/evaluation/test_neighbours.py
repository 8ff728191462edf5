"""The neighbour-window cheat: a window's past is its neighbour's answer, so that a curve through
all pasts, without any dynamics, beats published models. In time order it must gain nothing."""

from collections.abc import Sequence

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.data.segment import Segment
from asia.errors import Reason
from asia.judge.evaluation.evaluator import Evaluation, EvaluationData, Evaluator, EvaluatorOptions
from asia.judge.evaluation.relations import SuspicionKind
from asia.judge.evaluation.requests import sessions, side_by_side
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import LocalExecutor
from asia.judge.sandbox.types import Isolation
from asia.judge.sandbox.worker.worker import Worker
from asia.judge.scoring.outcome import Failure, score_fold
from asia.problem import Budget
from asia.problem.folds import make_folds
from asia.problem.protocol import ProtocolRule

HORIZON = 20

# What it has seen of a record it keeps; a window is told from the past inputs, which run on.
CURVE = """
import numpy as np

SEEN = []


def hermite(a, b, k, span):
    t = (k - a[0]) / span
    h = (1 + 2 * t) * (1 - t) ** 2, t * (1 - t) ** 2, t**2 * (3 - 2 * t), t**2 * (t - 1)
    return h[0] * a[1] + span * h[1] * a[2] + h[2] * b[1] + span * h[3] * b[2]


class Model:
    def simulate(self, past_u, past_y, u):
        batch, horizon = u.shape[:2]
        known = [(y[-1], y[-1] - y[-2], past) for y, past in zip(past_y, past_u)]
        SEEN.extend(known if REMEMBER else [])
        pool = [*known, *SEEN]
        y = np.repeat(past_y[:, -1:], horizon, axis=1)
        for i in range(batch):
            for state, slope, past in pool:
                if np.array_equal(past, u[i, -len(past):]):
                    a, b = (-1, known[i][0], known[i][1]), (horizon - 1, state, slope)
                    y[i] = [hermite(a, b, k, horizon) for k in range(horizon)]
        return y


def fit(trajectories, context):
    return Model()
"""
HOLD = """
import numpy as np


class Model:
    def simulate(self, past_u, past_y, u):
        return np.repeat(past_y[:, -1:], u.shape[1], axis=1)


def fit(trajectories, context):
    return Model()
"""

LINEAR = """
from asia.models import linear
from asia.models.methods import LevenbergMarquardt


def fit(trajectories, context):
    model = linear.build(linear.Config(order=2, delay=0), context)
    return linear.train(model, trajectories, context, LevenbergMarquardt(iterations=5))
"""


def records() -> tuple[Trajectory, ...]:
    """Slow waves, which a curve through a few points catches well."""
    rng = np.random.default_rng(2)
    made: list[Trajectory] = []
    for name in ("a", "b", "c"):
        u = rng.normal(size=243)
        waves = rng.uniform(0.05, 0.12, size=3)[:, None] * np.arange(243)
        y = np.sin(waves + rng.uniform(0, 6, size=(3, 1))).sum(axis=0)
        made.append(Trajectory(u, y, 1.0, name))
    return tuple(made)


def evaluator(without: Sequence[SuspicionKind] = ()) -> Evaluator:
    rule = ProtocolRule(kind="windows", past_inputs=3, past_outputs=3, horizon=HORIZON)
    context = Context((Signal("u"),), (Signal("y"),), 1.0, 3, 3, HORIZON)
    data = EvaluationData(make_folds(records(), rule), records(), context, rule)
    workers = WorkerRunner(Isolation.PROCESS, Budget(fit_seconds=30.0), LocalExecutor())
    return Evaluator(data, workers, EvaluatorOptions(without=without))


def value(evaluation: Evaluation) -> float:
    assert not isinstance(evaluation.outcome, Failure), evaluation.outcome
    return evaluation.outcome.value


def all_at_once(source: str) -> float:
    """V as it would be if the windows of a fold went in one request. Runs nothing but the text
    above."""
    names: dict[str, object] = {}
    exec(source, names)
    scores: list[float] = []
    for fold in evaluator().data.folds:
        model = names["fit"]([], None)  # type: ignore[operator]
        given = ("past_u", "past_y", "u")
        y_hat = model.simulate(*(stacked(fold.held_out, what) for what in given))
        y = [block.y for block in fold.held_out]
        scores.append(score_fold(y, list(y_hat), fold.scale, "rmse").value)
    return float(np.mean(scores))


def stacked(blocks: tuple[Segment, ...], what: str) -> Array:
    return np.stack([getattr(block, what) for block in blocks])


def test_the_cheat_would_pay_if_windows_went_together() -> None:
    source = CURVE.replace("REMEMBER", "False")
    assert all_at_once(source) < 0.5 * all_at_once(HOLD)


@pytest.mark.parametrize("remember", ["True", "False"])
def test_it_gains_nothing_in_time_order(remember: str) -> None:
    judge = evaluator(without=[SuspicionKind.STRANGERS])
    found = judge.evaluate(CURVE.replace("REMEMBER", remember))
    assert value(found) == value(judge.evaluate(HOLD))


def test_windows_of_the_library_go_side_by_side_and_those_of_other_code_one_by_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows: list[int] = []
    simulate = Worker.simulate

    def watched(worker: Worker, past_u: Array, past_y: Array, u: Array, secret: bytes) -> Array:
        rows.append(len(u))
        return simulate(worker, past_u, past_y, u, secret)

    monkeypatch.setattr(Worker, "simulate", watched)
    judge = evaluator()
    together = judge.evaluate(LINEAR)
    sizes = [len(part) for fold in judge.data.folds for part in sessions(fold.held_out)]
    assert sorted(rows) == sorted(sizes)
    assert min(sizes) > 1
    rows.clear()
    alone = judge.evaluate(f"{LINEAR}\nOWN = [*range(3)]\n")
    assert set(rows) == {1}
    assert value(together) == pytest.approx(value(alone), rel=1e-9)
    assert judge.objection(LINEAR, together) is None
    # Whole records are asked as those of other code are.
    assert not side_by_side(LINEAR, ProtocolRule())


@pytest.mark.slow
def test_a_curve_that_remembers_windows_is_refused() -> None:
    """A fresh worker that is asked in another order knows other ones."""
    judge, source = evaluator(), CURVE.replace("REMEMBER", "True")
    scored = evaluator(without=[SuspicionKind.STRANGERS]).evaluate(source)
    failure = judge.objection(source, scored)
    assert failure is not None
    assert failure.reason is Reason.SUSPECT
    assert "strangers" in failure.detail
    assert judge.objection(HOLD, judge.evaluate(HOLD)) is None
