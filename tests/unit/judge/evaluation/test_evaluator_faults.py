"""Workers that are ended from outside, that hang in C, or that the kernel does not let die."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.errors import Reason, UserError
from asia.judge.evaluation import workers as workers_module
from asia.judge.evaluation.evaluator import EvaluationData, Evaluator
from asia.judge.executors import LocalExecutor
from asia.judge.sandbox.availability import open_worker, probe, why_not
from asia.judge.sandbox.types import Isolation, Limits
from asia.judge.sandbox.worker import process
from asia.judge.sandbox.worker.worker import Worker
from asia.judge.scoring.outcome import Failure, Score
from asia.problem import Budget
from asia.problem.folds import make_folds
from asia.problem.protocol import ProtocolRule

STRONGEST = probe().level
ENDS = sorted({Isolation.PROCESS, STRONGEST})
LEVELS = sorted({*ENDS, Isolation.LANDLOCK} if why_not(Isolation.LANDLOCK) is None else ENDS)
MEAN = """
import ctypes
import time

import numpy as np


class Model:
    def __init__(self, mean):
        self.mean = mean

    def simulate(self, past_u, past_y, u):
        return np.broadcast_to(self.mean, (*u.shape[:2], 1)).copy()


def fit(trajectories, context):
    ctypes.CDLL(None).prctl(15, b"NAME", 0, 0, 0)
    time.sleep(0.7)
    return Model(np.mean([t.y.mean() for t in trajectories]))
"""
# PyDLL keeps the interpreter's lock: no handler of a signal and no other thread runs any more.
STUCK = "import ctypes\n\n\ndef fit(t, c):\n    ctypes.PyDLL(None).pause()\n"


def evaluator(level: Isolation, fit_seconds: float = 30.0) -> Evaluator:
    rng = np.random.default_rng(0)
    records = (Trajectory(rng.normal(size=(60, 1)), rng.normal(size=(60, 1)), 0.1),)
    rule = ProtocolRule(past_inputs=2, past_outputs=2)
    context = Context((Signal("u"),), (Signal("y"),), 0.1, 2, 2)
    budget = Budget(fit_seconds=fit_seconds)
    data = EvaluationData(make_folds(records, rule), records, context, rule)
    return Evaluator(data, workers_module.WorkerRunner(level, budget, LocalExecutor()))


def named(name: str) -> list[int]:
    """Processes of this name."""
    found: list[int] = []
    for path in Path("/proc").glob("[0-9]*/comm"):
        try:
            if path.read_text().strip() == name:
                found.append(int(path.parent.name))
        except OSError:
            continue
    return found


@contextmanager
def killing(name: str, times: int) -> Iterator[list[int]]:
    """SIGKILL to the first so many processes of a name, as the kernel does when memory runs out."""
    killed: list[int] = []
    over = threading.Event()

    def kill() -> None:
        while len(killed) < times and not over.is_set():
            for pid in [p for p in named(name) if p not in killed][: times - len(killed)]:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                killed.append(pid)
            time.sleep(0.02)

    thread = threading.Thread(target=kill)
    thread.start()
    try:
        yield killed
    finally:
        over.set()
        thread.join()


@pytest.mark.parametrize("level", LEVELS)
def test_a_worker_ended_from_outside_is_tried_once_more(level: Isolation) -> None:
    name = f"victim{os.getpid()}"
    judge = evaluator(level)
    source = MEAN.replace("NAME", name)
    undisturbed = judge.evaluate(source)
    assert isinstance(undisturbed.outcome, Score)
    with killing(name, 1) as killed:
        assert judge.evaluate(source).outcome == undisturbed.outcome
    assert len(killed) == 1


@pytest.mark.parametrize("level", ENDS)
def test_a_worker_that_is_ended_again_is_a_failure_and_the_evaluator_goes_on(
    level: Isolation,
) -> None:
    name = f"victim{os.getpid()}"
    judge = evaluator(level)
    source = MEAN.replace("NAME", name)
    with killing(name, 100) as killed:
        outcome = judge.evaluate(source).outcome
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.MEMORY
    assert "another process ended the worker by signal 9, twice" in outcome.detail
    assert len(killed) <= 2 * len(judge.data.folds)
    assert isinstance(judge.evaluate(source).outcome, Score)


@pytest.mark.parametrize("level", LEVELS)
def test_a_worker_stuck_in_c_is_ended_at_its_deadline(level: Isolation) -> None:
    judge = evaluator(level, fit_seconds=1.0)
    outcome = judge.evaluate(STUCK).outcome
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.FIT_TIMEOUT
    assert judge.workers.left_behind == []


def test_a_process_that_does_not_die_is_left_behind_and_no_more_than_a_few(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A kill without effect stands for a process that waits in the kernel."""
    if STRONGEST is Isolation.PROCESS:
        pytest.skip("at level process another process ends the worker")
    workers: list[Worker] = []

    def immortal(level: Isolation, limits: Limits) -> Worker:
        worker = open_worker(level, limits)
        worker._process = replace(worker._process, kill=lambda: None, force=lambda: None)
        workers.append(worker)
        return worker

    monkeypatch.setattr(workers_module, "open_worker", immortal)
    monkeypatch.setattr(process, "_PATIENCE_SECONDS", (0.05, 0.05))
    judge = evaluator(STRONGEST, fit_seconds=1.0)
    try:
        outcome = judge.evaluate(STUCK).outcome
        assert isinstance(outcome, Failure)
        assert outcome.reason is Reason.FIT_TIMEOUT
        first = list(judge.workers.left_behind)
        assert sorted(first) == sorted(w._process.process.pid for w in workers)
        assert len(first) == 2
        judge.evaluate(STUCK)
        with pytest.raises(UserError, match=f"{first[0]}.* cannot be ended: restart the machine"):
            judge.evaluate(STUCK)
    finally:
        for worker in workers:
            worker._process.process.kill()
            worker._process.process.wait()


@pytest.mark.parametrize("level", LEVELS)
def test_a_code_that_looks_like_a_kill_buys_no_second_fit(
    level: Isolation, monkeypatch: pytest.MonkeyPatch
) -> None:
    judge = evaluator(level)
    opened: list[Worker] = []

    def counted(level: Isolation, limits: Limits) -> Worker:
        opened.append(open_worker(level, limits))
        return opened[-1]

    monkeypatch.setattr(workers_module, "open_worker", counted)
    outcome = judge.evaluate("import os\n\n\ndef fit(t, c):\n    os._exit(137)\n").outcome
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.EXITED
    assert len(opened) == len(judge.data.folds)
