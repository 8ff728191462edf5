"""Workers that wait behind their walls before there is a candidate for them."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from asia.errors import CandidateError, Reason, SandboxError
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import LocalExecutor
from asia.judge.sandbox import standby as ready_module
from asia.judge.sandbox.availability import open_worker
from asia.judge.sandbox.standby import StandbyWorkers
from asia.judge.sandbox.types import Isolation, Limits
from asia.judge.sandbox.worker.worker import Worker
from asia.problem.budget import Budget

from .conftest import Case, one_level

LIMITS = Limits(60.0, 30.0, 4096)
NOTHING: frozenset[str] = frozenset()
SIGNALS = frozenset({"scipy.signal"})
FFT = frozenset({"scipy.fft"})
GAIN = """
import sys
import numpy as np

class Gain:
    def simulate(self, past_u, past_y, u):
        return np.repeat(u, 2, axis=2)

def fit(trajectories, context):
    print(*sys.modules)
    return Gain()
"""
TRIES = """
import os, socket
def attempt(name, call):
    try:
        call()
        print(name, "worked")
    except OSError as error:
        print(name, "failed")
attempt("read", lambda: os.listdir("/root"))
attempt("write", lambda: open("/tmp/x", "w"))
attempt("socket", socket.socket)
attempt("fork", os.fork)
attempt("parent", lambda: os.kill(os.getppid() or 1, 0))
"""
KILLED = """
import sys, time
from asia.judge.sandbox.types import Isolation, Limits
from asia.judge.sandbox.standby import StandbyWorkers
ahead = StandbyWorkers(Isolation(sys.argv[1]), Limits(60.0, 30.0, 4096), 2)
ahead.take(frozenset({"scipy.fft"}))
worker = ahead.take(frozenset({"scipy.fft"}))
while any(not one.worker.done() for one in ahead._waiting):
    time.sleep(0.01)
print(*(one.worker.result()._process.find() for one in ahead._waiting), flush=True)
time.sleep(600)
"""


@pytest.fixture(autouse=True)
def cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ready_module.os, "cpu_count", lambda: 2)


def test_no_more_wait_than_there_are_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    for cores, most in ((1, 1), (3, 3), (64, 4), (None, 1)):
        monkeypatch.setattr(ready_module.os, "cpu_count", lambda cores=cores: cores)
        with StandbyWorkers(Isolation.PROCESS, LIMITS, 20) as ready:
            assert ready._most == most


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[Worker]:
    """All workers that were started ahead."""
    found: list[Worker] = []
    open_worker = ready_module.open_worker

    def noted(level: Isolation, limits: Limits, *, libraries: frozenset[str]) -> Worker:
        worker = open_worker(level, limits, libraries=libraries)
        found.append(worker)
        return worker

    monkeypatch.setattr(ready_module, "open_worker", noted)
    return found


@pytest.fixture
def ahead(level: Isolation, opened: list[Worker]) -> Iterator[StandbyWorkers]:
    with StandbyWorkers(level, LIMITS, 2) as found:
        yield found
    assert not any(one._process.running() for one in opened)


def fitted(worker: Worker, case: Case, source: str = GAIN) -> list[str]:
    return worker.fit(source, case.trajectories, case.context)[1].split()


@one_level
@pytest.mark.slow
def test_none_waits_at_first_and_each_is_used_once(
    ahead: StandbyWorkers, opened: list[Worker], case: Case
) -> None:
    assert ahead.take(FFT) is None
    taken = [ahead.take(FFT) for _ in range(4)]
    assert all(taken)
    assert len({id(one) for one in taken}) == 4
    pids = {one._process.find() for one in taken if one is not None}
    assert len(pids) == 4
    for one in taken:
        assert one is not None
        with one:
            assert "scipy.fft" in fitted(one, case)
            with pytest.raises(SandboxError, match="one fit"):
                one.fit(GAIN, case.trajectories, case.context)
    assert len(opened) == 6


@one_level
@pytest.mark.slow
def test_a_worker_has_never_loaded_more_than_its_candidate_does(
    ahead: StandbyWorkers, case: Case
) -> None:
    assert ahead.take(FFT) is None
    assert ahead.take(SIGNALS) is None
    assert ahead.take(NOTHING) is None  # a bare candidate gets none of those that wait
    one = ahead.take(FFT | SIGNALS)
    assert one is not None
    with one:
        modules = fitted(one, case)
    assert "jax" not in modules


@one_level
@pytest.mark.slow
def test_few_wait(ahead: StandbyWorkers, opened: list[Worker]) -> None:
    for libraries in (NOTHING, FFT, SIGNALS, FFT | SIGNALS, NOTHING, FFT):
        one = ahead.take(libraries)
        if one is not None:
            one.close()
        assert len(ahead._waiting) <= 4
    end = time.monotonic() + 60.0
    while sum(one._process.running() for one in opened) > 4 or len(opened) < 8:
        assert time.monotonic() < end
        time.sleep(0.05)


def test_standby_workers_have_all_sandbox_layers(
    ahead: StandbyWorkers, level: Isolation, case: Case
) -> None:
    if level is Isolation.PROCESS:
        pytest.skip("this level has no such walls")
    ahead.take(FFT)
    one = ahead.take(FFT)
    assert one is not None
    with one:
        said = one.fit(TRIES + GAIN, case.trajectories, case.context)[1]
    assert "worked" not in said
    assert said.count("failed") == 5


@one_level
def test_one_that_dies_while_it_waits_is_not_used(
    ahead: StandbyWorkers, opened: list[Worker]
) -> None:
    ahead.take(FFT)
    assert ahead._starter.submit(bool).result() is False  # all before it have been started
    for one in opened:
        one.abort()
        one._process.process.wait()
    assert ahead.take(FFT) is None


@one_level
def test_libraries_that_do_not_fit_into_memory_are_not_tried_again(
    level: Isolation, opened: list[Worker]
) -> None:
    with StandbyWorkers(level, Limits(60.0, 30.0, 400), 2) as ahead:
        needs = frozenset({"no_such_library"})
        assert [ahead.take(needs) for _ in range(4)] == [None] * 4
        started = len(opened)
        assert ahead.take(needs) is None
        assert len(opened) == started


def test_an_external_end_is_distinguished_from_an_own_one(
    ahead: StandbyWorkers, level: Isolation, case: Case
) -> None:
    ahead.take(FFT)
    one = ahead.take(FFT)
    assert one is not None
    with one, pytest.raises(CandidateError) as caught:
        one.fit("import os\nos._exit(3)", case.trajectories, case.context)
    assert caught.value.reason is Reason.EXITED
    assert "exit code 3" in caught.value.detail


def test_a_killed_search_leaves_none(level: Isolation) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", KILLED, level.value], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        pids = [int(word) for word in process.stdout.readline().split()]
        assert len(pids) == 2
        process.send_signal(signal.SIGKILL)
        process.wait()
        end = time.monotonic() + 30.0
        while any(_alive(pid) for pid in pids):
            assert time.monotonic() < end, "a worker outlives its search"
            time.sleep(0.05)


def _alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()[0]
    except OSError:
        return False
    return state not in (b"Z", b"X") and os.path.exists(f"/proc/{pid}")


LIBRARY = """
from asia.models import linear, neural_ss
from asia.models.methods import LevenbergMarquardt

def fit(trajectories, context):
    model = neural_ss.build(neural_ss.Config(order=1, hidden=2), context)
    return neural_ss.train(model, trajectories, context, LevenbergMarquardt(2))
"""
JAX = frozenset({"jax"})


def library_fit(worker: Worker, case: Case) -> tuple[bytes, bytes]:
    worker.fit(LIBRARY, case.trajectories, case.context)
    return worker.dump(), worker.simulate(case.past_u, case.past_y, case.u).tobytes()


@one_level
@pytest.mark.slow
def test_a_worker_that_ran_the_library_alone_serves_only_the_library(
    ahead: StandbyWorkers, case: Case
) -> None:
    ahead.take(JAX)
    first = ahead.take(JAX)
    assert first is not None
    before = library_fit(first, case)
    assert first.renew()
    assert ahead.give_back(first, JAX)
    other = ahead.take(JAX)
    assert other is not None
    assert other is not first
    with other:
        assert "neural_ss" not in " ".join(fitted(other, case))
    again = ahead.take(JAX, library_only=True)
    assert again is first
    with again:
        assert again.spent == {}
        assert again.printed == ""
        with pytest.raises(SandboxError, match="no model"):
            again.simulate(case.past_u, case.past_y, case.u)
        assert library_fit(again, case) == before
        assert again.peak_memory_mb is None or again.peak_memory_mb > again._peak_before
        assert again.renew()
        assert ahead.give_back(again, JAX)
        again.abort()
        again._process.process.wait()
        assert ahead.take(JAX, library_only=True) is None


@one_level
@pytest.mark.slow
def test_a_worker_near_its_memory_limit_or_ended_is_not_used_again(
    level: Isolation, case: Case
) -> None:
    for memory_mb, ended in ((2048, False), (4096, True)):
        with open_worker(level, Limits(60.0, 30.0, memory_mb), libraries=JAX) as worker:
            library_fit(worker, case)
            if ended:
                worker.close()
            assert not worker.renew()


@one_level
def test_fits_in_turn_get_no_worker_that_started_beside_another_fit(level: Isolation) -> None:
    runner = WorkerRunner(level, Budget(fit_seconds=60.0, memory_mb=4096), LocalExecutor(1))
    source = "def fit(trajectories, context):\n    raise ValueError\n"
    with runner.ready_workers():
        with runner.open_for(source, fitting=True):
            pass
        assert runner._ready is not None
        waiting = list(runner._ready._waiting)
        assert waiting
        with (
            runner.fresh_workers(),
            runner.open_for(source, fitting=True) as one,
            runner.open_for(source, fitting=True) as other,
        ):
            assert len({id(w) for w in (one, other, *(o.worker.result() for o in waiting))}) == (
                2 + len(waiting)
            )
            assert runner._ready._waiting == waiting
        with runner.open_for(source, fitting=True) as taken:
            assert taken in [o.worker.result() for o in waiting]
