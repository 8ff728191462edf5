"""`early_stopping = "validation"`: scores on the held-out part, and who gets to see what."""

import pickle
from dataclasses import replace
from itertools import groupby
from typing import Any

import numpy as np
import pytest

from asia.candidate import VALIDATION_SCORES, Context
from asia.data import Signal, Trajectory
from asia.errors import Reason
from asia.judge.evaluation import workers as workers_module
from asia.judge.evaluation.evaluator import Evaluation, EvaluationData, Evaluator, RefitModel
from asia.judge.evaluation.validation_score import rounded_score
from asia.judge.executors import LocalExecutor
from asia.judge.sandbox.availability import probe
from asia.judge.sandbox.types import Isolation
from asia.judge.sandbox.worker.process import Channel
from asia.judge.scoring.outcome import Failure, Score
from asia.problem import Budget
from asia.problem.folds import make_folds
from asia.problem.protocol import EarlyStopping, ProtocolRule

DESCENT = """
import numpy as np


class Model:
    def __init__(self, weights):
        self.weights = weights

    def simulate(self, past_u, past_y, u):
        y = np.concatenate([past_y, np.zeros((*u.shape[:2], 1))], axis=1)
        n = past_y.shape[1]
        for k in range(n, y.shape[1]):
            lags = np.concatenate([y[:, k - 2 : k, 0], u[:, k - n]], axis=1)
            y[:, k, 0] = lags @ self.weights
        return y[:, n:]


def fit(trajectories, context):
    y = np.concatenate([t.y[:, 0] for t in trajectories])
    u = np.concatenate([t.u[:, 0] for t in trajectories])
    lags = np.stack([y[:-2], y[1:-1], u[2:]], axis=1)
    weights = np.zeros(3)
    best, kept = np.inf, weights
    for step in range(STEPS):
        weights = weights + RATE * lags.T @ (y[2:] - lags @ weights) / len(lags)
        if context.validation_score is not None and step % 5 == 0:
            value = context.validation_score(Model(weights))
            context.log(step, value)
            if value < best:
                best, kept = value, weights
    if context.validation_score is None:
        context.log(-1, 0.0)
        kept = weights
    return Model(kept)
"""


def descent(steps: int = 60, rate: float = 0.05) -> str:
    return DESCENT.replace("STEPS", str(steps)).replace("RATE", str(rate))


def asking(body: str, simulate: str = "return u") -> str:
    return (
        "import os\nimport time\n\nimport numpy as np\n\n\nclass Model:\n"
        f"    def simulate(self, past_u, past_y, u):\n        {simulate}\n\n\n"
        f"def fit(trajectories, context):\n    {body}\n    return Model()\n"
    )


def records() -> tuple[Trajectory, ...]:
    rng = np.random.default_rng(3)
    made: list[Trajectory] = []
    for name in ("one", "two"):
        u, y = rng.normal(size=120), np.zeros(120)
        for k in range(2, 120):
            y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + 0.4 * u[k]
        made.append(Trajectory(u, y + 0.05 * rng.normal(size=120), 1.0, name))
    return tuple(made)


def evaluator(
    early_stopping: EarlyStopping = "validation",
    isolation: Isolation = Isolation.PROCESS,
    horizon: int | None = None,
    fit_seconds: float = 30.0,
) -> Evaluator:
    rule = ProtocolRule(past_inputs=3, past_outputs=3, early_stopping=early_stopping)
    if horizon is not None:
        rule = replace(rule, kind="windows", horizon=horizon)
    context = Context((Signal("u"),), (Signal("y"),), 1.0, 3, 3, horizon)
    data = EvaluationData(make_folds(records(), rule), records(), context, rule)
    budget = Budget(fit_seconds=fit_seconds)
    return Evaluator(data, workers_module.WorkerRunner(isolation, budget, LocalExecutor()))


def value(evaluation: Evaluation) -> float:
    assert not isinstance(evaluation.outcome, Failure), evaluation.outcome
    return evaluation.outcome.value


def failure(evaluation: Evaluation) -> Failure:
    assert isinstance(evaluation.outcome, Failure)
    return evaluation.outcome


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> dict[Channel, list[tuple[str, Any, bytes]]]:
    """Every request to every worker: name, arguments, bytes."""
    requests: dict[Channel, list[tuple[str, Any, bytes]]] = {}
    send = Channel.send

    def spy(self: Channel, request: tuple[bytes, str, Any], deadline: float) -> None:
        body = pickle.dumps(request, protocol=5)
        _, name, arguments = pickle.loads(body)
        requests.setdefault(self, []).append((name, arguments, body))
        send(self, request, deadline)

    monkeypatch.setattr(Channel, "send", spy)
    return requests


@pytest.mark.slow
@pytest.mark.parametrize(("isolation", "horizon"), [(Isolation.PROCESS, None), (probe().level, 20)])
def test_the_best_reported_score_is_the_score_of_the_fold(
    isolation: Isolation, horizon: int | None
) -> None:
    found = evaluator(isolation=isolation, horizon=horizon).evaluate(descent())
    assert isinstance(found.outcome, Score)
    for fold, score in zip(found.folds, found.outcome.folds, strict=True):
        (curve,) = found.artifacts.get_arrays(fold.curve, [(12, 2)])
        assert fold.validation_scores == 12
        assert curve[:, 1].min() == rounded_score(score.value)
    assert found.validation_scores == 24


@pytest.mark.long
def test_stopping_by_it_saves_a_fit_that_goes_astray() -> None:
    sound = descent(61, rate=1.0)
    astray = sound.replace(
        "        if", "        weights = weights * 0.95 ** (step > 40)\n        if", 1
    )
    told = evaluator().evaluate(astray)
    blind = evaluator("inner").evaluate(astray)
    assert value(evaluator().evaluate(sound)) <= value(told) < 0.8 * value(blind)
    assert blind.validation_scores == 0
    assert [f.validation_scores for f in blind.folds] == [0, 0]
    (curve,) = blind.artifacts.get_arrays(blind.folds[0].curve, [(1, 2)])
    assert curve.tolist() == [[-1.0, 0.0]]


def test_the_worker_that_trains_gets_a_number_and_no_case(
    sent: dict[Channel, list[tuple[str, Any, bytes]]],
) -> None:
    judge = evaluator()
    judge.evaluate(descent())
    fits = [r for r in sent.values() if r[0][0] == "fit"]
    loads = [r for r in sent.values() if r[0][0] == "load"]
    oracles = [r for r in loads if sum(name == "load" for name, _, _ in r) > 1]
    # The second record is simulated in a worker of its own.
    assert len(fits) == len(oracles) == len(loads) - 2 == 2
    for requests in fits:
        names = [name for name, _, _ in requests]
        assert names[:15] == ["fit", *["score"] * 12, "parameters", "dump"]
        fold = next(f for f in judge.data.folds if f.train[0].y.tobytes() in requests[0][2])
        for name, arguments, body in requests[:13]:
            if name == "score":
                (number,) = arguments
                assert type(number) is float
            assert not any(
                part.tobytes() in body
                for block in fold.held_out
                for part in (block.y[:4], block.y[-4:], block.u[:4], block.u[-4:])
            )
    targets = [b.y[-8:].tobytes() for f in judge.data.folds for b in f.held_out]
    for requests in oracles:
        names = [name for name, _, _ in requests]
        # Prefixes of one case of each record; the last asks for times and brings none of them.
        kinds = [name for name, _ in groupby(names)]
        assert kinds == [*["load", "has_steps", "simulate"] * 12, "compiled"]
        assert not any(y in body for _, _, body in requests for y in targets)


def test_one_worker_serves_all_scores_of_a_fit_and_none_is_opened_unasked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    opened: list[Isolation] = []
    real = workers_module.open_worker

    def counting(level: Isolation, limits: Any) -> Any:
        opened.append(level)
        return real(level, limits)

    monkeypatch.setattr(workers_module, "open_worker", counting)
    evaluator().evaluate(descent())
    # For each fold: one to fit, one to score, and one for the second record.
    assert len(opened) == 6
    opened.clear()
    evaluator().evaluate(asking("pass"))
    assert len(opened) == 4


COMPILED = """
from dataclasses import dataclass
from functools import partial

import jax
import numpy as np

TRACED = jax.__dict__.setdefault("traced", [])


@dataclass(frozen=True)
class Cell:
    gain: float


@partial(jax.jit, static_argnums=0)
def run(cell, weight, u):
    TRACED.append(u.shape)
    return cell.gain * weight * u


class Model:
    def __init__(self, weight):
        self.cell, self.weight = Cell(2.0), weight

    def simulate(self, past_u, past_y, u):
        y = run(self.cell, self.weight, u)
        assert len(TRACED) == len(set(TRACED)), "compiled again"
        return np.asarray(y)


def fit(trajectories, context):
    for k in range(4):
        context.validation_score(Model(np.float32(k)))
    return Model(np.float32(1.0))
"""


@pytest.mark.long
def test_a_reloaded_model_is_not_compiled_again() -> None:
    found = evaluator().evaluate(COMPILED)
    assert value(found) > 0
    assert found.validation_scores == 8


@pytest.mark.long
def test_calls_are_capped(sent: dict[Channel, list[tuple[str, Any, bytes]]]) -> None:
    found = evaluator(fit_seconds=120.0).evaluate(descent(steps=5 * VALIDATION_SCORES + 1))
    problem = failure(found)
    assert problem.reason is Reason.CRASH
    assert f"validation_score was called {VALIDATION_SCORES} times" in problem.detail
    assert found.validation_scores == 2 * VALIDATION_SCORES
    oracles = [r for r in sent.values() if r[0][0] == "load"]
    assert [sum(name == "load" for name, _, _ in r) for r in oracles] == [VALIDATION_SCORES] * 2


def test_a_model_that_runs_away_scores_infinity_and_the_fit_goes_on() -> None:
    source = asking(
        "scores = [context.validation_score(Model()) for Model.gain in (np.inf, 1e200, 1.0)]\n"
        "    print(scores[:2], scores[2] < 10)",
        "return self.gain * u",
    ).replace("Model()", "made(Model.gain)", 1)
    source += "\n\ndef made(gain):\n    model = Model()\n    model.gain = gain\n    return model\n"
    found = evaluator().evaluate(source.replace("return Model()", "return made(1.0)"))
    assert value(found) > 0
    assert found.output == "[inf, inf] True\n"
    assert found.validation_scores == 6


@pytest.mark.parametrize(
    ("simulate", "reason", "words"),
    [
        ("raise ValueError(str(u))", Reason.CRASH, "in a call of validation_score: ValueError"),
        ("return u[:, 1:]", Reason.WRONG_LENGTH, "in a call of validation_score: got shape"),
        ("os._exit(3)", Reason.EXITED, "in a call of validation_score: "),
    ],
)
def test_a_model_that_fails_while_scored_fails_the_candidate(
    simulate: str, reason: Reason, words: str
) -> None:
    found = evaluator().evaluate(asking("context.validation_score(Model())", simulate))
    problem = failure(found)
    assert problem.reason is reason
    assert problem.detail.startswith(words)
    assert problem.fold == 1
    assert found.validation_scores == 2


@pytest.mark.slow
def test_time_spent_on_scores_counts_as_the_fits() -> None:
    slow = asking("context.validation_score(Model())", "time.sleep(600)")
    assert failure(evaluator(fit_seconds=3.0).evaluate(slow)).reason is Reason.FIT_TIMEOUT


def test_nothing_is_held_out_in_the_refit() -> None:
    only_blind = asking("assert context.validation_score is None")
    assert isinstance(evaluator().refit(only_blind).model, RefitModel)
    assert failure(evaluator().evaluate(only_blind)).reason is Reason.CRASH


def test_a_candidate_receives_four_digits_and_no_huge_score() -> None:
    """Outputs as large as 1e6 would write the measured ones, scaled, into a score's last digits."""
    assert rounded_score(0.123449) == rounded_score(0.123351) == 0.1234
    assert rounded_score(12.3456) == 12.35
    assert rounded_score(123456.789) == rounded_score(float("inf")) == float("inf")
