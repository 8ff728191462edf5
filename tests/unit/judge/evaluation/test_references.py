"""Trivial references on windows."""

from __future__ import annotations

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.judge.evaluation.evaluator import EvaluationData, Evaluator
from asia.judge.evaluation.references import (
    LINEAR,
    best_linear,
    constant_velocity,
    find_rates,
    score_references,
)
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import LocalExecutor
from asia.judge.sandbox.types import Isolation
from asia.judge.scoring.outcome import Score
from asia.problem import Budget
from asia.problem.folds import make_folds
from asia.problem.protocol import FoldRule, Group, ProtocolRule
from asia.recipe import read_recipe

HOLD = """
import numpy as np

class Hold:
    def simulate(self, past_u, past_y, u):
        assert u.shape[0] in (1, 8) and u.shape[1] <= 10
        return np.repeat(past_y[:, -1:], u.shape[1], axis=1)

def fit(trajectories, context):
    assert context.horizon == 10
    return Hold()
"""


def carts() -> list[Trajectory]:
    """Position, velocity and a third output; the velocity is slow against a window."""
    records: list[Trajectory] = []
    for k in range(4):
        t = 0.1 * np.arange(41)
        phase = t / 5 + k
        v = np.cos(phase)
        y = np.stack([5 * np.sin(phase), v, np.sin(37 * t + k)], axis=1)
        records.append(Trajectory(np.sin(t)[:, None], y, 0.1, f"cart{k}"))
    return records


def evaluator(rule: ProtocolRule, records: list[Trajectory]) -> Evaluator:
    context = Context(
        inputs=(Signal("u"),),
        outputs=(Signal("p"), Signal("v"), Signal("w")),
        sampling_time=0.1,
        n_past_u=rule.past_inputs,
        n_past_y=rule.past_outputs,
        horizon=rule.horizon,
        metric=rule.metric,
    )
    budget, level = Budget(fit_seconds=60.0), Isolation.PROCESS
    data = EvaluationData(make_folds(records, rule), tuple(records), context, rule)
    return Evaluator(data, WorkerRunner(level, budget, LocalExecutor()))


def windows(past: int) -> ProtocolRule:
    groups = (Group("a", ("cart0", "cart1")), Group("b", ("cart2", "cart3")))
    folds = FoldRule("leave_one_group_out", 2, groups)
    return ProtocolRule("windows", folds, 0, past, "mae", "inner", 10)


def references(rule: ProtocolRule) -> dict[str, float]:
    found = score_references(evaluator(rule, carts()), rule.metric, None, {"linear model"})
    return {r.name: r.outcome.value for r in found if isinstance(r.outcome, Score)}


def test_a_rate_is_found_among_the_outputs_and_used() -> None:
    fold = make_folds(carts(), windows(1))[0]
    assert find_rates(fold, 10) == (1, None, None)
    block = fold.held_out[0]
    y_hat = constant_velocity(block, (1, None, None), 0.1)
    position, velocity, third = block.past_y[-1]
    assert y_hat[:, 0] == pytest.approx(position + 0.1 * velocity * np.arange(1, 11))
    assert np.array_equal(y_hat[:, 1:], np.tile([velocity, third], (10, 1)))
    found = references(windows(1))
    assert list(found) == ["training mean", "last output held", "constant velocity"]
    assert found["constant velocity"] < found["last output held"]


def test_two_past_outputs_tell_a_velocity() -> None:
    block = make_folds(carts(), windows(3))[0].held_out[0]
    past = block.past_y
    y_hat = constant_velocity(block, (None, None, None), 0.1)
    assert y_hat[0] == pytest.approx(past[-1] + (past[2] - past[0]) / 2)
    assert y_hat[9] == pytest.approx(past[-1] + 10 * (past[2] - past[0]) / 2)


def test_no_velocity_where_nothing_tells_one() -> None:
    alone = [Trajectory(t.u, t.y[:, 2:], 0.1, t.name) for t in carts()]
    found = evaluator(windows(1), alone)
    names = [r.name for r in score_references(found, "mae", None, {"linear model"})]
    assert names == ["training mean", "last output held"]
    long = ProtocolRule(past_inputs=2, past_outputs=2)
    assert list(references(long)) == ["training mean", "last output held"]


def test_a_candidate_is_judged_on_windows() -> None:
    """The held-out windows come one by one, those it was trained on all at once."""
    found = evaluator(windows(1), carts())
    evaluation = found.evaluate(HOLD)
    assert isinstance(evaluation.outcome, Score)
    assert evaluation.outcome.value == pytest.approx(references(windows(1))["last output held"])
    for record, fold in zip(evaluation.folds, found.data.folds, strict=True):
        assert fold.shapes == [(10, 3)] * 8
        assert len(evaluation.artifacts.get_arrays(record.y_hat, fold.shapes)) == 8
    assert found.objection(HOLD, evaluation) is None


@pytest.mark.long
@pytest.mark.usefixtures("real_linear_reference")
def test_the_linear_reference_names_settings_that_are_better_than_the_baseline() -> None:
    # Two modes, and a second half that is slow and so noisy that it hides one mode.
    rng = np.random.default_rng(4)
    u = rng.normal(size=240)
    u[120:] = np.repeat(rng.normal(size=12), 10)
    one, two = np.zeros(240), np.zeros(240)
    for k in range(2, 240):
        one[k] = 1.8 * one[k - 1] - 0.9 * one[k - 2] + 0.1 * u[k - 1]
        two[k] = 0.2 * two[k - 1] - 0.8 * two[k - 2] + 0.3 * u[k - 1]
    y = (one + two)[:, None]
    noise = rng.normal(size=y.shape)
    noise[:120] *= 0.02
    noise[120:] *= 0.6
    y += y.std() * noise
    records = [Trajectory(u[:, None], y, 1.0, "r")]
    rule = ProtocolRule(past_inputs=5, past_outputs=5)
    context = Context((Signal("u"),), (Signal("y"),), 1.0, 5, 5)
    data = EvaluationData(make_folds(records, rule), tuple(records), context, rule)
    runner = WorkerRunner(Isolation.PROCESS, Budget(fit_seconds=60.0), LocalExecutor())
    judge = Evaluator(data, runner)
    own = judge.evaluate(LINEAR)
    assert isinstance(own.outcome, Score)
    orders = {round(dict(one.parameters)["order [states]"]) for one in own.folds}
    assert orders == {2, 4}
    found = best_linear(judge)
    assert isinstance(found.outcome, Score)
    settings = read_recipe(found.source)
    assert settings is not None
    assert settings.config != (read_recipe(LINEAR) or settings).config
    assert found.outcome.value < own.outcome.value


@pytest.mark.long
@pytest.mark.usefixtures("real_linear_reference")
def test_the_linear_reference_is_a_prediction_error_model_where_the_noise_is_slow() -> None:
    rng = np.random.default_rng(2)
    u, drift = rng.normal(size=(300, 1)), np.cumsum(rng.normal(size=300))
    y = np.zeros((300, 1))
    for k in range(1, 300):
        y[k] = 0.8 * y[k - 1] + 0.2 * u[k - 1]
    y[:, 0] += 0.03 * drift
    records = [Trajectory(u, y, 1.0, "r")]
    rule = ProtocolRule(past_inputs=5, past_outputs=5, folds=FoldRule(count=3))
    context = Context((Signal("u"),), (Signal("y"),), 1.0, 5, 5)
    data = EvaluationData(make_folds(records, rule), tuple(records), context, rule)
    runner = WorkerRunner(Isolation.PROCESS, Budget(fit_seconds=60.0), LocalExecutor())
    judge = Evaluator(data, runner)
    own, found = judge.evaluate(LINEAR), best_linear(judge)
    assert isinstance(own.outcome, Score)
    assert isinstance(found.outcome, Score)
    assert found.outcome.value < 0.9 * own.outcome.value
