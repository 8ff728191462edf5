"""A fold as a message: what travels, what comes back, what is refused."""

import socket
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asia.errors import Reason, SandboxError, UserError
from asia.judge.evaluation import remote
from asia.judge.evaluation.evaluator import EvaluationData, Evaluator
from asia.judge.evaluation.fold_fits import derive_seed, fold_data, search_context
from asia.judge.evaluation.machines import check_installation, installation, survey_machines
from asia.judge.evaluation.remote import (
    FoldWork,
    answer,
    decode_answer,
    decode_data,
    encode_data,
    encode_work,
)
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import LocalExecutor
from asia.judge.sandbox.types import Isolation, Limits, WorkerKilledError
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.problem.folds import make_folds
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from asia.search.replay import replay_run
from asia.search.run import prepare, search
from tests.unit.search.toy import CRASH, Scripted, arx, write_problem

Answer = Callable[[bytes, bytes, Callable[[], bool]], bytes]
LIMITS = Limits(20.0, 20.0, 4096)


class Loopback(LocalExecutor):
    """Carries messages to this machine."""

    def __init__(self, change: Callable[[bytes], bytes] = lambda reply: reply) -> None:
        super().__init__(2)
        self.requests: list[bytes] = []
        self.sent: list[bytes] = []
        self.forgotten: set[bytes] = set()
        self._change = change

    def carry(self, answer: Answer, request: bytes, digest: str, data: bytes) -> bytes:
        self.requests.append(request)
        self.sent.append(data)
        return self._change(answer(request, data, lambda: request in self.forgotten))

    def ask_each(
        self, describe: Callable[[bytes], bytes], request: bytes
    ) -> dict[str, tuple[bytes, float, float]]:
        asked = time.time()
        return {"here": (describe(request), 0.001, asked)}

    def forget(self, request: bytes) -> None:
        self.forgotten.add(request)

    def cancel(self) -> None: ...


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    return load_problem(write_problem(tmp_path_factory.mktemp("work") / "toy"))


def evaluator(problem: Problem, executor: LocalExecutor) -> Evaluator:
    context = search_context(problem, derive_seed(0, "search"))
    folds = make_folds(problem.train, problem.protocol)
    data = EvaluationData(folds, problem.train, context, problem.protocol)
    return Evaluator(data, WorkerRunner(Isolation.PROCESS, problem.budget, executor))


@pytest.mark.slow
def test_a_remote_answer_is_the_same(problem: Problem) -> None:
    there = Loopback()
    here, far = (evaluator(problem, e).evaluate(arx(2)) for e in (LocalExecutor(2), there))
    assert here.outcome == far.outcome
    assert len(there.requests) == len(far.folds) == 2
    for one, other in zip(here.folds, far.folds, strict=True):
        assert other.machine == socket.gethostname()
        assert other.isolation == "process"
        assert one.machine == one.isolation == ""
        assert (one.model, one.y_hat, one.curve) == (other.model, other.y_hat, other.curve)


def test_held_out_outputs_do_not_travel(problem: Problem) -> None:
    there = Loopback()
    evaluator(problem, there).evaluate(arx(1))
    folds = make_folds(problem.train, problem.protocol)
    for fold in folds:
        raw = encode_data(fold_data(fold, problem.protocol))[1]
        assert raw in there.sent
        for block in fold.held_out:
            pairs = [block.y[k : k + 2].tobytes() for k in range(len(block.y) - 1)]
            assert not any(pair in sent for pair in pairs for sent in (raw, *there.requests))
    fold = folds[0]
    blank = fold_data(fold, problem.protocol).held_out
    assert all(np.isnan(block.y).all() for block in blank)


def test_a_candidates_failure_comes_back_with_its_words(problem: Problem) -> None:
    found = evaluator(problem, Loopback()).evaluate(CRASH).outcome
    assert found == evaluator(problem, LocalExecutor(2)).evaluate(CRASH).outcome
    assert getattr(found, "reason", None) is Reason.CRASH


@pytest.mark.parametrize(
    "spoil", [lambda r: r[:-8], lambda r: b"", lambda r: r.replace(b'"train"', b'"trein"')]
)
def test_an_invalid_answer_is_no_result(problem: Problem, spoil: Callable[[bytes], bytes]) -> None:
    with pytest.raises(SandboxError, match="what is no answer"):
        evaluator(problem, Loopback(spoil)).evaluate(arx(1))


def work(problem: Problem, **changes: object) -> tuple[bytes, bytes]:
    rule = problem.protocol
    digest, raw = encode_data(fold_data(make_folds(problem.train, rule)[0], rule))
    made = FoldWork("", digest, arx(1), search_context(problem, 1), LIMITS, Isolation.PROCESS, ())
    return encode_work(replace(made, **changes), installation()), raw  # type: ignore[arg-type]


def refusal(problem: Problem, request: bytes, raw: bytes) -> Exception:
    data = fold_data(make_folds(problem.train, problem.protocol)[0], problem.protocol)
    with pytest.raises((UserError, SandboxError)) as raised:
        decode_answer(answer(request, raw), data, [])
    return raised.value


def test_different_machines_are_refused_with_the_differences(problem: Problem) -> None:
    there = {**installation(), "numpy": "1.0"}
    with pytest.raises(UserError, match=r"numpy \S+ there, 1.0 here.*same versions on all"):
        check_installation(there, "far")
    request, raw = work(problem)
    other = request.replace(b'"python": "', b'"python": "9', 1)
    length = int.from_bytes(other[:8], "little") + 1
    found = refusal(problem, length.to_bytes(8, "little") + other[8:], raw)
    assert isinstance(found, UserError)
    assert "is not like this one: python" in str(found)


def test_a_machine_that_isolates_less_is_refused(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = refusal(problem, *work(problem, layers=("rlimits", "landlock")))
    assert isinstance(found, UserError)
    assert "it lacks landlock" in str(found)
    monkeypatch.setattr(remote, "why_not", lambda level: "no such thing")
    remote._check_isolation.cache_clear()
    assert "no such thing. Run asia doctor" in str(refusal(problem, *work(problem)))


def test_other_data_than_were_sent_are_refused(problem: Problem) -> None:
    request, raw = work(problem)
    assert "other bytes" in str(refusal(problem, request, raw + b"x"))
    with pytest.raises(SandboxError, match="other bytes"):
        decode_data(raw, "0" * 64)


def test_a_worker_that_was_killed_is_tried_again(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit, calls = remote.fit_fold, [0]

    def fails_once(*given: object) -> object:
        calls[0] += 1
        if calls[0] == 1:
            raise WorkerKilledError("another process ended the worker by signal 9")
        return fit(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(remote, "fit_fold", fails_once)
    found = evaluator(problem, Loopback()).evaluate(arx(1))
    assert len(found.folds) == 2
    assert calls[0] == 3


def test_a_machine_describes_itself() -> None:
    (state,) = survey_machines(Loopback())
    assert state.machine == socket.gethostname()
    assert state.isolation
    assert state.unlike == ""
    assert abs(state.clock) < 5.0


def test_validation_early_stopping_stays_here(problem: Problem) -> None:
    rule = replace(problem.protocol, early_stopping="validation")
    with pytest.raises(UserError, match="use --executor local"):
        evaluator(replace(problem, protocol=rule), Loopback())


@pytest.mark.long
def test_a_search_names_machine_and_level_of_each_fold(problem: Problem, tmp_path: Path) -> None:
    short = replace(problem, budget=replace(problem.budget, experiments=2))
    ready = prepare(short, "scripted", seed=0, runs=tmp_path)
    search(ready, Scripted((arx(2),)), lambda event, view: None, lambda view: None, Loopback())
    result = open_run(ready.directory).view.experiment(2).result
    assert result is not None
    assert {fold.machine for fold in result.folds} == {socket.gethostname()}
    assert {fold.isolation for fold in result.folds} == {result.isolation}
    verify(ready.directory)
    assert replay_run(ready.directory, lambda item: None).agrees
