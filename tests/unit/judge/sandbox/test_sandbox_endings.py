"""Ends of a worker: by itself, with any code or signal, or by another process."""

import os
import signal
import threading
import time

import pytest

from asia.errors import CandidateError, Reason
from asia.judge.sandbox.types import Isolation, WorkerKilledError
from asia.judge.sandbox.worker.keeper import descendants
from asia.judge.sandbox.worker.process import WorkerProcess

FAIL = """
import ctypes, os, signal, time

libc = ctypes.CDLL(None, use_errno=True)


class Model:
    def simulate(self, past_u, past_y, u):
        SIMULATE


def fit(trajectories, context):
    FIT
    return Model()
"""
BUSY = b"at work"
KILLED = 128 + signal.SIGKILL
_EXIT, _EXIT_GROUP, _TIMER = (60, 231, 222) if os.uname().machine == "x86_64" else (93, 94, 107)
# An event that sends SIGKILL to the process, when a timer made for it comes to its end.
_BY_TIMER = f"""
    event, timer = (ctypes.c_int * 16)(), ctypes.c_int()
    event[2] = signal.SIGKILL
    made = libc.syscall({_TIMER}, 1, event, ctypes.byref(timer))
    raise SystemExit(f"timer {{made}}")
"""


def source(fit: str = "pass", simulate: str = "pass") -> str:
    return FAIL.replace("FIT", fit.strip()).replace("SIMULATE", simulate)


@pytest.mark.parametrize("code", [KILLED, 255])
def test_a_worker_that_ends_itself_is_exited_whatever_its_code(worker, case, code):
    with worker() as one, pytest.raises(CandidateError) as caught:
        one.fit(source(f"os._exit({code})"), case.trajectories, case.context)
    assert caught.value.reason is Reason.EXITED
    assert "exit code" in caught.value.detail


@pytest.mark.parametrize("number", [_EXIT, _EXIT_GROUP])
def test_nor_does_the_bare_system_call_pass_for_a_kill(worker, case, number):
    end = f"libc.syscall({number}, {KILLED})"
    with worker() as one, pytest.raises(CandidateError) as caught:
        one.fit(source(end), case.trajectories, case.context)
    assert caught.value.reason is Reason.EXITED


def test_an_end_in_simulate_is_exited_too(worker, case):
    with worker() as one:
        one.fit(source(simulate=f"os._exit({KILLED})"), case.trajectories, case.context)
        with pytest.raises(CandidateError) as caught:
            one.simulate(case.past_u, case.past_y, case.u)
    assert caught.value.reason is Reason.EXITED


@pytest.mark.parametrize(
    "end",
    [
        "os.kill(os.getpid(), signal.SIGKILL)",
        "signal.raise_signal(signal.SIGKILL)",
        "signal.pthread_kill(__import__('threading').get_ident(), signal.SIGKILL)",
        _BY_TIMER,
    ],
)
def test_no_candidate_kills_itself_as_somebody_else_would(worker, case, level, end):
    if level is Isolation.PROCESS:
        pytest.skip("no layer of this level stands between a process and its own signals")
    with worker() as one, pytest.raises(CandidateError) as caught:
        one.fit(source(end), case.trajectories, case.context)
    said = (caught.value.reason, caught.value.detail)
    assert said[0] in (Reason.CRASH, Reason.EXITED), said
    assert "not permitted" in said[1] or "timer -1" in said[1], said


def test_a_kill_from_outside_is_not_the_candidates_end(worker, case):
    with worker() as one:
        begun = threading.Timer(0.0, _kill_once_busy, (one._process,))
        begun.start()
        with pytest.raises(WorkerKilledError, match="signal 9"):
            one.fit(
                source(f"libc.prctl(15, {BUSY!r}, 0, 0, 0); time.sleep(60)"),
                case.trajectories,
                case.context,
            )
        begun.join()


def _kill_once_busy(process: WorkerProcess) -> None:
    """SIGKILL to the process of the candidate itself, below its guards."""
    found: list[int] = []
    while not (found and _waits(found[-1])):
        time.sleep(0.01)
        found = [process.process.pid, *descendants(process.process.pid)]
    os.kill(found[-1], signal.SIGKILL)


def _waits(pid: int) -> bool:
    """Return whether it is a worker that has begun to fit, and has given itself its name."""
    with open(f"/proc/{pid}/comm", "rb") as name:
        return name.read().strip() == BUSY


@pytest.mark.parametrize("name", ["SIGKILL", "SIGSEGV", "SIGTERM"])
def test_a_supervisor_ends_like_its_worker(worker, case, level, name):
    if level is not Isolation.PROCESS:
        pytest.skip("a keeper stands above workers of level process alone")
    with worker() as one, pytest.raises((CandidateError, WorkerKilledError)):
        one.fit(source(f"os.kill(os.getpid(), signal.{name})"), case.trajectories, case.context)
    assert one._process.process.returncode == -getattr(signal, name)
