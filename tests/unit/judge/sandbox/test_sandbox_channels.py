"""Counters of the kernel that one worker moves and another reads."""

import os
import shutil
from collections.abc import Collection
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from asia.errors import CandidateError
from asia.judge.sandbox import level as level_module
from asia.judge.sandbox.availability import open_worker, why_not
from asia.judge.sandbox.layers import lockdown
from asia.judge.sandbox.levels import namespace
from asia.judge.sandbox.types import Isolation, Layer, Limits
from asia.judge.sandbox.worker.worker import Worker

NAMESPACE, LANDLOCK = Isolation.NAMESPACE, Isolation.LANDLOCK
SKIPPED = {
    level: pytest.mark.skipif(reason is not None, reason=str(reason))
    for level in (NAMESPACE, LANDLOCK)
    for reason in [why_not(level)]
}
WALLED = [pytest.param(level, marks=mark) for level, mark in SKIPPED.items()]
LIMITS = Limits(60.0, 60.0, 4096)
TAKEN = 40 * 1024
# The next number of a counter, and `many` of them taken. Each core takes them in lots of 1024.
FRAME = """
import ctypes, mmap, os, threading
libc = ctypes.CDLL(None, use_errno=True)
threading.stack_size(65536)

class Model:
    def simulate(self, past_u, past_y, u):
        return u[:, :, :1] * 0 + [[lot(), 0.0]]

def fit(trajectories, context):
    lot() if context.seed == 0 else take(context.seed)
    return Model()

def lot():
    lots = set()
    while len(lots) < os.cpu_count() + 2:
        lots.add(number() // 1024)
    return 1024 * max(lots)

def take(many):
    for _ in range(many):
        number()
"""
MAPPINGS = """
def number():
    shared = [mmap.mmap(-1, 4096, mmap.MAP_SHARED) for _ in range(256)]
    rows = [line.split() for line in open("/proc/self/maps")]
    return max(int(row[4]) for row in rows if row[1][3] == "s" and row[-1] == "(deleted)")

def take(many):
    for _ in range(many):
        mmap.mmap(-1, 4096, mmap.MAP_SHARED).close()
"""
MEMFD = """
def number():
    fd = os.memfd_create("a")
    found = os.fstat(fd).st_ino
    os.close(fd)
    return found
"""
PIPE = """
def number():
    fds = os.pipe()
    found = os.fstat(fds[0]).st_ino
    for fd in fds:
        os.close(fd)
    return found
"""
ENTRIES = """
NAMES = "stat statm maps comm status cgroup io ns fd wchan cpuset limits root cwd exe auxv".split()

def number():
    os.stat("/proc/self/task")
    found = []
    def look():
        for name in NAMES:
            place = f"/proc/self/task/{threading.get_native_id()}/{name}"
            found.append(os.stat(place, follow_symlinks=False).st_ino)
    one = threading.Thread(target=look)
    one.start()
    one.join()
    return max(found)

def take(many):
    for _ in range(many // len(NAMES)):
        number()
"""
THREADS = """
def number():
    one = threading.Thread(target=int)
    one.start()
    one.join()
    return one.native_id

lot = number
"""
OPEN = (Layer.LANDLOCK, Layer.SECCOMP)


def jump(case, level: Isolation, counter: str, without: Collection[Layer] = (), many=TAKEN) -> int:
    """How far the counter moves for a worker while another takes `many` numbers."""
    source = FRAME + counter
    with (
        open_worker(level, LIMITS, without=without) as reader,
        open_worker(level, LIMITS, without=without) as writer,
    ):
        reader.fit(source, case.trajectories, replace(case.context, seed=0))
        before = _read(reader, case)
        writer.fit(source, case.trajectories, replace(case.context, seed=many))
        return _read(reader, case) - before


def _read(worker: Worker, case) -> int:
    return int(worker.simulate(case.past_u[:1], case.past_y[:1], case.u[:1, :1])[0, 0, 0])


@pytest.mark.parametrize("level", WALLED)
@pytest.mark.parametrize("counter", [MAPPINGS, MEMFD, PIPE], ids=["mappings", "memfd", "pipes"])
def test_inode_numbers_of_nameless_objects_cannot_be_had(case, level, counter):
    with pytest.raises(CandidateError, match=r"PermissionError|FileNotFoundError"):
        jump(case, level, counter)


@pytest.mark.parametrize(
    ("level", "counter"),
    [
        *(pytest.param(LANDLOCK, c, marks=SKIPPED[LANDLOCK]) for c in (MAPPINGS, MEMFD, PIPE)),
        *(pytest.param(NAMESPACE, c, marks=SKIPPED[NAMESPACE]) for c in (MEMFD, PIPE)),
    ],
)
def test_without_the_layers_one_worker_reads_what_another_takes(case, level, counter):
    assert jump(case, level, counter, OPEN) >= TAKEN - 8 * 1024


@pytest.mark.skipif(why_not(NAMESPACE) is not None, reason="no namespaces")
@pytest.mark.parametrize("counter", [MAPPINGS, ENTRIES], ids=["mappings", "entries of tasks"])
def test_namespaces_alone_hide_the_inode_numbers_of_proc(case, counter):
    with pytest.raises(CandidateError, match="FileNotFoundError"):
        jump(case, NAMESPACE, counter, OPEN)


@pytest.mark.skipif(why_not(LANDLOCK) is not None, reason="no Landlock")
@pytest.mark.parametrize("counter", [ENTRIES, THREADS], ids=["entries of tasks", "threads"])
def test_landlock_leaves_two_counters_that_the_documentation_lists(case, counter):
    """No rule of Landlock hides what `stat` tells, and threads have numbers of the machine."""
    moved = jump(case, LANDLOCK, counter, many=2048)
    most = int(Path("/proc/sys/kernel/pid_max").read_text())  # the numbers begin anew there
    assert moved % most >= 1024


@pytest.mark.skipif(why_not(NAMESPACE) is not None, reason="no namespaces")
def test_numbers_of_threads_are_a_workers_own_in_its_namespace(case):
    assert 0 < jump(case, NAMESPACE, THREADS, many=2048) < 16


@pytest.mark.skipif(why_not(NAMESPACE) is not None, reason="no namespaces")
def test_each_worker_has_fresh_namespaces():
    kinds = ("pid", "ipc", "mnt", "net", "user", "uts", "cgroup")
    with open_worker(NAMESPACE, LIMITS) as first, open_worker(NAMESPACE, LIMITS) as second:
        seen = []
        for worker in (first, second):
            worker.wait()
            (pid,) = worker._process.pids()
            seen.append({os.readlink(f"/proc/{pid}/ns/{kind}") for kind in kinds})
    here = {os.readlink(f"/proc/self/ns/{kind}") for kind in kinds}
    assert len(seen[0] | seen[1] | here) == 3 * len(kinds)


@pytest.mark.parametrize("level", WALLED)
def test_libraries_that_share_memory_get_an_error_and_live(case, level):
    source = (
        "import multiprocessing, mmap, numpy as np\n"
        "def fit(trajectories, context):\n"
        "    for share in (lambda: mmap.mmap(-1, 4096),\n"
        "                  lambda: np.memmap(np.__file__, mode='r'),\n"
        "                  lambda: multiprocessing.Array('d', 3)):\n"
        "        try:\n            share()\n            print('shared')\n"
        "        except OSError as error:\n            print(type(error).__name__)\n"
        "    return Model()\n"
        "class Model:\n"
        "    def simulate(self, past_u, past_y, u):\n        return np.repeat(u, 2, 2)\n"
    )
    with open_worker(level, LIMITS) as worker:
        said = worker.fit(source, case.trajectories, case.context)[1].split()
        assert worker.simulate(case.past_u, case.past_y, case.u).shape == (3, 40, 2)
    assert len(said) == 3
    assert "shared" not in said
    assert said[:2] == ["PermissionError"] * 2


@pytest.mark.skipif(why_not(NAMESPACE) is not None, reason="no namespaces")
def test_namespaces_that_show_processes_do_not_work_and_say_so(monkeypatch):
    whole = partial(namespace.bubblewrap_options, nesting=True)
    monkeypatch.setattr(namespace, "bubblewrap_options", whole)
    assert "/proc shows processes" in (why_not(NAMESPACE) or "")


@pytest.mark.skipif(why_not(LANDLOCK) is not None, reason="no Landlock")
@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("seccomp.py", "_MAP_PRIVATE, 1, 0", "_MAP_PRIVATE, 1, 1", "memory can be shared"),
        ("landlock.py", "in readable", "in [*readable, '/proc']", "other than cpuinfo"),
    ],
)
def test_walls_with_an_open_channel_do_not_work_and_say_so(
    tmp_path, monkeypatch, file, old, new, words
):
    layers = tmp_path / "judge" / "sandbox" / "layers"
    shutil.copytree(Path(lockdown.__file__).parent, layers)
    text = (layers / file).read_text()
    (layers / file).write_text(text.replace(old, new))
    assert text.count(old) == 1
    monkeypatch.setattr(level_module, "package_folder", lambda: tmp_path)
    assert words in (why_not(LANDLOCK) or "")
