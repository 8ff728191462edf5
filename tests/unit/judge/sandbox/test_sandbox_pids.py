"""A worker has a limit on its threads and processes, whatever holds it on this machine."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from asia.errors import CandidateError, Reason
from asia.judge.sandbox import level as level_module
from asia.judge.sandbox.availability import open_worker, pids_mechanism, survey
from asia.judge.sandbox.layers import pids
from asia.judge.sandbox.layers.pids import PidsCgroup, PidsMechanism, cgroup_works, most_pids
from asia.judge.sandbox.types import Isolation, Layer, Limits
from asia.judge.sandbox.worker.process import ResourceWatch

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="threads are counted on Linux")
LIMITS = Limits(60.0, 60.0, 4096)
# Starts so many threads and stops at the first refusal.
THREADS = """
import threading, time


class Model:
    def simulate(self, past_u, past_y, u):
        return u[..., :1] * 0.0


def fit(trajectories, context):
    threading.stack_size(65536)
    for _ in range(COUNT):
        threading.Thread(target=time.sleep, args=(SECONDS,), daemon=True).start()
    time.sleep(SECONDS)
    return Model()
"""
FORKS = """
import os, time


def fit(trajectories, context):
    for _ in range(COUNT):
        if os.fork() == 0:
            time.sleep(SECONDS)
            os._exit(0)
    time.sleep(SECONDS)
"""


def with_count(source: str, count: int, seconds: float = 2.0) -> str:
    return source.replace("COUNT", str(count)).replace("SECONDS", str(seconds))


@pytest.fixture
def watched(monkeypatch):
    """No cgroup here."""
    monkeypatch.setattr(level_module, "cgroup_works", lambda: False)


@pytest.fixture
def few(monkeypatch):
    """A limit that tests can exceed at little cost."""
    monkeypatch.setattr("asia.judge.sandbox.worker.worker.most_pids", lambda: 20)
    monkeypatch.setattr("asia.judge.sandbox.levels.namespace.most_pids", lambda: 20)


def refusal(level: Isolation, case, source: str) -> CandidateError:
    with open_worker(level, LIMITS) as worker, pytest.raises(CandidateError) as caught:
        worker.fit(source, case.trajectories, case.context)
    return caught.value


@pytest.mark.usefixtures("few")
def test_a_worker_with_too_many_threads_ends_with_a_sentence(level, case):
    error = refusal(level, case, with_count(THREADS, 60))
    if pids_mechanism(level) is PidsMechanism.RLIMIT:
        assert error.reason is Reason.CRASH
        assert "can't start new thread" in error.detail
    else:
        assert error.reason is Reason.THREADS
        assert error.detail == "at most 20 threads and processes"


@pytest.mark.usefixtures("few", "watched")
def test_the_watcher_ends_it_too(level, case):
    if pids_mechanism(level) is PidsMechanism.RLIMIT:
        pytest.skip("a limit of the kernel holds here")
    assert refusal(level, case, with_count(THREADS, 60)).reason is Reason.THREADS


def test_the_watcher_looks_until_it_is_closed():
    ended = []
    ResourceWatch(lambda: 2, 1, lambda: ended.append("closed"), 9.0).close()
    watch = ResourceWatch(lambda: 2, 1, lambda: ended.append("open"), 0.01)
    for _ in range(1000):
        if watch.exceeded and ended:
            break
        time.sleep(0.001)
    assert ended == ["open"]


@pytest.mark.usefixtures("few", "watched")
def test_processes_count_where_they_can_be_started(case):
    error = refusal(Isolation.PROCESS, case, with_count(FORKS, 40))
    assert error.reason is Reason.THREADS


def test_the_limit_leaves_room_for_honest_threads(level, case):
    with open_worker(level, LIMITS) as worker:
        worker.fit(with_count(THREADS, 200, 0.2), case.trajectories, case.context)


@pytest.mark.usefixtures("few")
def test_without_the_layer_nothing_is_counted(case):
    with open_worker(Isolation.PROCESS, LIMITS, without=[Layer.PIDS]) as worker:
        worker.fit(with_count(THREADS, 60, 0.2), case.trajectories, case.context)


@pytest.mark.skipif(not cgroup_works(), reason="no cgroup can be made here")
def test_a_cgroup_refuses_and_is_removed():
    group = PidsCgroup(3)
    place = group._place
    code = "import sys, _thread, time\ninput()\n"
    code += "for _ in range(9): _thread.start_new_thread(time.sleep, (5,))"
    command = [sys.executable, "-I", "-S", "-c", code]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        group.add(process.pid)
        assert not group.exceeded
        assert "can't start new thread" in process.communicate("\n")[1]
    assert group.exceeded
    group.close()
    assert not place.exists()


@pytest.mark.skipif(not cgroup_works(), reason="no cgroup can be made here")
def test_cgroups_of_searches_that_were_killed_are_removed():
    above = pids._writable_cgroup()
    assert above is not None
    old, own = above / "asia-999999999-0", above / f"asia-{os.getpid()}-old"
    old.mkdir()
    own.mkdir()
    try:
        pids._remove_old(above)
        assert not old.exists()
        assert own.exists()
    finally:
        own.rmdir()


DELEGATED = {
    "0::/user.slice/app.scope": ("b'1'", True),
    "0::/": ("", True),
    "0::/system.slice/other.scope": ("", False),
}


@pytest.mark.parametrize("line", DELEGATED)
def test_only_a_cgroup_of_version_2_that_was_delegated_is_divided(line, tmp_path, monkeypatch):
    """Played on a folder: a machine has one version of the controller."""
    marked, expected = DELEGATED[line]
    place = tmp_path
    (place / "cgroup.controllers").write_text("cpu memory pids\n")
    (place / "cgroup.subtree_control").write_text("")
    if marked:
        monkeypatch.setattr(os, "getxattr", lambda path, name: b"1")
    assert pids._is_delegated(place, line.removeprefix("0::")) is expected
    assert (place / "cgroup.subtree_control").read_text() == ("+pids" if expected else "")


def test_the_doctor_says_what_holds_the_limit():
    for state in survey():
        assert not state.works or state.pids is pids_mechanism(state.level)
    assert most_pids() >= 256
    assert not Path("/proc/self/task").exists() or pids.count_tasks([os.getpid()]) >= 1
