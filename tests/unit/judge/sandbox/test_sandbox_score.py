"""Scores asked for during a fit: what the worker sends, what it gets, and what ends it."""

import os
import threading
import time

import numpy as np
import pytest

from asia.errors import CandidateError, Reason, SandboxError
from asia.judge.sandbox.availability import probe
from asia.judge.sandbox.types import Isolation, ScoreRefusedError


@pytest.fixture
def level() -> Isolation:
    """The strongest one: none of this depends on the layers."""
    return probe().level


ASKING = """
import threading
import numpy as np

CALLS = []

class Gain:
    def __init__(self, gain):
        self.gain = gain

    def simulate(self, past_u, past_y, u):
        CALLS.append(1)
        return np.repeat(self.gain * u, 2, axis=2) + 100.0 * len(CALLS)

def fit(trajectories, context):
    ask = context.validation_score
    BODY
    return Gain(1.0)
"""


def asking(body: str) -> str:
    return ASKING.replace("BODY", body.replace("\n", "\n    "))


class Answers:
    """Plays the part that scores: keeps the models and gives numbers."""

    def __init__(self, most: int = 1000) -> None:
        self.models: list[bytes] = []
        self.most = most

    def __call__(self, model: bytes, deadline: float) -> float:
        assert deadline > time.monotonic()
        if len(self.models) == self.most:
            raise ScoreRefusedError("no more than that")
        self.models.append(model)
        return 0.1 * len(self.models)


def test_models_go_out_as_bytes_and_one_number_comes_back(worker, case):
    answers = Answers()
    body = "for k in range(3):\n    context.log(k, ask(Gain(float(k))))"
    with worker() as one:
        reply = one.fit(asking(body), case.trajectories, case.context, answers)
        final = one.dump()
    np.testing.assert_allclose(reply[0], [[0, 0.1], [1, 0.2], [2, 0.1 * 3]])
    assert len(answers.models) == 3
    assert answers.models[1] == final


def test_without_a_scorer_there_is_nothing_to_ask(worker, case):
    with worker() as one:
        reply = one.fit(asking("print(ask)"), case.trajectories, case.context)
    assert reply[1] == "None\n"


def test_models_load_one_after_another_and_the_source_runs_once(worker, case):
    answers = Answers()
    source = asking("for k in range(3):\n    ask(Gain(float(k)))")
    with worker() as one, worker() as other:
        one.fit(source, case.trajectories, case.context, answers)
        for k, model in enumerate(answers.models):
            other.load(source, model, case.context)
            y = other.simulate_known(case.past_u, case.past_y, case.u)
            np.testing.assert_array_equal(y, k * case.u.repeat(2, axis=2) + 100.0 * (k + 1))
        with pytest.raises(SandboxError, match="one source"):
            other.load(source + "\n", answers.models[0], case.context)


def test_a_worker_that_was_fitted_takes_no_model(worker, case):
    with worker() as one:
        one.fit(asking("pass"), case.trajectories, case.context)
        with pytest.raises(SandboxError, match="fresh one"):
            one.load(asking("pass"), one.dump(), case.context)


def test_a_refusal_is_a_runtime_error_that_can_be_caught(worker, case):
    body = "while True:\n    try:\n        ask(Gain(1.0))\n    except RuntimeError as e:\n"
    body += "        print(e)\n        break"
    with worker() as one:
        reply = one.fit(asking(body), case.trajectories, case.context, Answers(most=2))
        assert one.simulate(case.past_u, case.past_y, case.u).shape == (3, 40, 2)
    assert reply[1] == "no more than that\n"


def test_an_uncaught_refusal_fails_the_fit_with_its_message(worker, case):
    source = asking("while True:\n    ask(Gain(1.0))")
    with worker() as one, pytest.raises(CandidateError) as caught:
        one.fit(source, case.trajectories, case.context, Answers(most=2))
    assert caught.value.reason is Reason.CRASH
    assert "RuntimeError: no more than that" in caught.value.detail


@pytest.mark.parametrize(
    ("body", "reason", "words"),
    [
        ("ask(3.0)", Reason.CONTRACT, "validation_score was given float"),
        ("ask(type('Odd', (), {'simulate': len, 'x': (i for i in [])})())", Reason.CRASH, "pickle"),
        ("Gain.__reduce__ = lambda s: (bytes, (bytes(3_000_000),))\nask(Gain(1.0))",
         Reason.MODEL_SIZE, "1 MB"),
    ],
)  # fmt: skip
def test_an_output_that_cannot_be_scored_fails_the_candidate(worker, case, body, reason, words):
    answers = Answers()
    with worker(model_mb=1) as one, pytest.raises(CandidateError) as caught:
        one.fit(asking(body), case.trajectories, case.context, answers)
    assert caught.value.reason is reason
    assert words in caught.value.detail
    assert answers.models == []


def test_a_model_that_fails_the_scorer_ends_the_fit(worker, case):
    def score(model: bytes, deadline: float) -> float:
        raise CandidateError(Reason.WRONG_LENGTH, "as the scorer says")

    with worker() as one:
        with pytest.raises(CandidateError, match="as the scorer says") as caught:
            one.fit(asking("ask(Gain(1.0))"), case.trajectories, case.context, score)
        assert caught.value.reason is Reason.WRONG_LENGTH
        with pytest.raises(SandboxError):
            one.dump()


def test_time_spent_on_scores_is_the_fits(worker, case):
    def score(model: bytes, deadline: float) -> float:
        time.sleep(max(deadline - time.monotonic(), 0.0))
        raise CandidateError(Reason.SIMULATE_TIMEOUT)

    with worker(fit_seconds=1.0) as one, pytest.raises(CandidateError) as caught:
        one.fit(asking("ask(Gain(1.0))"), case.trajectories, case.context, score)
    assert caught.value.reason is Reason.FIT_TIMEOUT


def test_answers_by_a_time_are_not_waited_for_longer(worker, case):
    source = asking("pass").replace("CALLS.append(1)", "import time; time.sleep(600)")
    with worker() as one:
        one.fit(source, case.trajectories, case.context)
        model = one.dump()
    with worker() as other:
        other.load(source, model, case.context)
        other.answer_by(time.monotonic() + 0.3)
        with pytest.raises(CandidateError) as caught:
            other.simulate(case.past_u, case.past_y, case.u)
    assert caught.value.reason is Reason.SIMULATE_TIMEOUT


def test_a_simulation_that_is_not_finite_leaves_the_worker_running(worker, case):
    source = asking("pass").replace("+ 100.0 * len(CALLS)", "+ (np.nan if len(CALLS) == 1 else 0)")
    with worker() as one:
        one.fit(source, case.trajectories, case.context)
        with pytest.raises(CandidateError) as caught:
            one.simulate(case.past_u, case.past_y, case.u)
        assert caught.value.reason is Reason.NOT_FINITE
        assert np.isfinite(one.simulate(case.past_u, case.past_y, case.u)).all()


def test_a_score_asked_for_while_simulating_is_refused(worker, case):
    source = asking("Gain.ask = staticmethod(ask)").replace("CALLS.append(1)", "Gain.ask(self)")
    answers = Answers()
    with worker() as one:
        one.fit(source, case.trajectories, case.context, answers)
        with pytest.raises(CandidateError) as caught:
            one.simulate(case.past_u, case.past_y, case.u)
    assert caught.value.reason is Reason.CRASH
    assert caught.value.detail == "RuntimeError"
    assert answers.models == []


def test_scores_may_be_asked_for_in_threads(worker, case):
    body = (
        "found = []\n"
        "run = lambda: found.append(ask(Gain(1.0)))\n"
        "threads = [threading.Thread(target=run) for _ in range(8)]\n"
        "[t.start() for t in threads]\n"
        "[t.join() for t in threads]\n"
        "print(len(set(found)))"
    )
    with worker() as one:
        reply = one.fit(asking(body), case.trajectories, case.context, Answers())
    assert reply[1] == "8\n"


def test_a_scorer_that_breaks_leaves_nothing_behind(worker, case):
    def held() -> tuple[int, str]:
        fds = len(os.listdir("/proc/self/fd"))
        with open(f"/proc/self/task/{threading.get_native_id()}/children") as file:
            return fds, file.read()

    def score(model: bytes, deadline: float) -> float:
        raise KeyboardInterrupt

    before = held()
    with pytest.raises(KeyboardInterrupt), worker() as one:
        one.fit(asking("ask(Gain(1.0))"), case.trajectories, case.context, score)
    assert held() == before


def test_the_loss_comes_while_the_fit_runs_and_changes_nothing(worker, case):
    shown: list[tuple[float, float]] = []
    body = """
import time
for k in range(3):
    context.log(k, 1.0 / (k + 1))
    time.sleep(0.6)
context.log(3, float("nan"))"""
    with worker() as one:
        reply = one.fit(
            asking(body),
            case.trajectories,
            case.context,
            on_loss=lambda step, loss: shown.append((step, loss)),
        )
    assert shown == [(0.0, 1.0), (1.0, 0.5), (2.0, 1.0 / 3.0)]
    np.testing.assert_array_equal(reply[0], [[0, 1], [1, 0.5], [2, 1 / 3], [3, np.nan]])
