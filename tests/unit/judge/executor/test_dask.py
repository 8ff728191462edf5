"""Folds on a Dask cluster on this machine."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from asia.agents import Agent, AgentView, Proposal
from asia.errors import SandboxError, UserError
from asia.judge.evaluation.machines import survey_machines
from asia.judge.executors import make_executor
from asia.judge.executors.dask import DaskExecutor
from asia.ledger.events import Event, Landed, Proposed
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.ledger.view import SearchView
from asia.problem.load import load_problem
from asia.search.run import prepare, search
from asia.testing import check_executor
from tests.unit.judge.executor.cluster import Cluster, two_workers
from tests.unit.search.toy import arx, write_problem

SLOW = arx(2).replace(
    "    n = 2\n    rows", "    import time\n    time.sleep({seconds})\n    n = 2\n    rows"
)


@dataclass(frozen=True)
class Ahead:
    """Proposes sources in order, whatever runs."""

    sources: tuple[str, ...]
    name: str = "scripted"
    proposes_ahead: bool = True

    def propose(self, view: AgentView) -> Proposal | None:
        index = len(view.proposed) - 1
        if index >= len(self.sources):
            return None
        return Proposal(self.sources[index], "scripted", f"number {index}", "made up", "made up")


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    pytest.importorskip("distributed")
    with two_workers(tmp_path) as made:
        yield made


def go(
    root: Path,
    executor: DaskExecutor | None,
    parallel: int,
    agent: Agent,
    on_event: Callable[[Event, SearchView], None] = lambda event, view: None,
) -> SearchView:
    if not (root / "toy").is_dir():
        write_problem(root / "toy", experiments=6)
    problem = load_problem(root / "toy")
    problem = replace(problem, budget=replace(problem.budget, fit_seconds=150.0))
    runs = root / ("here" if executor is None else "there")
    ready = prepare(problem, "scripted", seed=0, runs=runs, parallel=parallel)
    return search(ready, agent, on_event, lambda view: None, executor)


def test_missing_parts_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="expected dask://HOST:PORT"):
        make_executor("dask")
    monkeypatch.setattr("asia.judge.executors.dask.is_installed", lambda name: False)
    with pytest.raises(UserError, match=r"pip install '\.\[dask\]'"):
        make_executor("dask://localhost:1")


def test_a_scheduler_that_is_not_there_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(UserError, match=r"none.json: there is no such file"):
        DaskExecutor(str(tmp_path / "none.json"))
    monkeypatch.setattr("asia.judge.executors.dask._CONNECT_SECONDS", 1)
    with pytest.raises(UserError, match=r"no scheduler answers at tcp://127\.0\.0\.1:9"):
        make_executor("dask://127.0.0.1:9")


def joined(request: bytes, data: bytes, unwanted: Callable[[], bool]) -> bytes:
    return request + data


@pytest.fixture
def threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A cluster in this process, whose losses are noticed soon."""
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr("asia.judge.executors.dask._CONNECT_SECONDS", 1)
    monkeypatch.setattr("asia.judge.executors.dask._NO_WORKERS_SECONDS", 1.0)
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0",
        protocol="tcp", host="127.0.0.1",
    ) as made:  # fmt: skip
        yield made


@pytest.mark.slow
def test_work_waits_for_a_worker_and_a_cluster_without_one_is_said(
    threads: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    executor = DaskExecutor(threads.scheduler_address)
    assert executor.carry(joined, b"a", "digest", b"b") == b"ab"
    threads.scale(0)
    while executor._client.scheduler_info()["workers"]:
        time.sleep(0.05)
    with pytest.raises(UserError, match="has had no workers for 1 s: start some"):
        executor.carry(joined, b"a", "digest", b"b")
    monkeypatch.setattr("asia.judge.executors.dask._NO_WORKERS_SECONDS", 60.0)
    back = threading.Timer(0.5, threads.scale, [1])
    back.start()
    assert executor.carry(joined, b"c", "digest", b"b") == b"cb"
    back.join()
    executor.close()


@pytest.mark.slow
def test_a_scheduler_that_is_gone_is_said(threads: Any) -> None:
    executor = DaskExecutor(threads.scheduler_address)
    assert executor.carry(joined, b"a", "digest", b"b") == b"ab"
    threads.close()
    with pytest.raises(UserError, match=r"the scheduler at tcp://127.* is gone: start it again"):
        executor.carry(joined, b"a", "digest", b"b")
    executor.cancel()
    executor.close()


def until_unwanted(request: bytes, data: bytes, unwanted: Callable[[], bool]) -> bytes:
    end = time.monotonic() + 30.0
    while not unwanted():
        assert time.monotonic() < end
        time.sleep(0.01)
    return b"ended"


def test_a_forgotten_request_ends_alone(threads: Any) -> None:
    executor = DaskExecutor(threads.scheduler_address)
    raised: list[str] = []

    def carried() -> None:
        try:
            executor.carry(until_unwanted, b"long", "digest", b"")
        except SandboxError as error:
            raised.append(str(error))

    waiting = threading.Thread(target=carried)
    waiting.start()
    while not executor._under_way:
        time.sleep(0.01)
    executor.forget(b"long")
    waiting.join()
    assert raised == ["the result of this fit is not wanted any more"]
    # Its thread there is free again, and the same request may come back.
    assert executor.carry(joined, b"long", "other", b"b") == b"longb"
    executor.close()


@pytest.mark.slow
def test_folds_wait_here_until_a_thread_is_free(threads: Any) -> None:
    executor = DaskExecutor(threads.scheduler_address)
    assert executor._room() == 1
    most = 0

    def job(request: bytes) -> None:
        executor.carry(slowly, request, "digest", b"")

    runs = threading.Thread(
        target=executor.run, args=([partial(job, name) for name in (b"a", b"b", b"c")],)
    )
    runs.start()
    while runs.is_alive():
        most = max(most, len(executor._under_way))
        time.sleep(0.01)
    assert most == 1
    executor.close()


def slowly(request: bytes, data: bytes, unwanted: Callable[[], bool]) -> bytes:
    time.sleep(0.5)
    return b""


@pytest.mark.slow
def test_a_cluster_is_an_executor_and_is_surveyed(cluster: Cluster) -> None:
    executor = cluster.connected(2)
    check_executor(lambda: executor)
    states = survey_machines(executor)
    assert len(states) == 2
    for state in states:
        assert state.isolation
        assert state.unlike == ""
        assert 0.0 < state.round_trip < 5.0
        assert abs(state.clock) < 5.0
    executor.close()


@pytest.mark.long
def test_killed_workers_change_nothing(cluster: Cluster) -> None:
    sources = tuple(SLOW.format(seconds=s) for s in (2.0, 1.9, 2.1, 1.8, 2.2))
    here = go(cluster.folder, None, 2, Ahead(sources))
    executor = cluster.connected(2)
    over = threading.Event()
    killed: list[int] = []

    def kill() -> None:
        while not over.wait(4.0) and len(killed) < 3:
            victim = next(p for p in cluster.processes[1:] if p.poll() is None)
            os.killpg(victim.pid, signal.SIGKILL)
            killed.append(victim.pid)
            cluster.add_worker()

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        there = go(cluster.folder, executor, 2, Ahead(sources))
    finally:
        over.set()
        killer.join()
    executor.close()
    assert len(killed) >= 2
    directory = cluster.folder / "there" / "toy-scripted-s0"
    verify(directory)
    for one, other in zip(here.finished, there.finished, strict=True):
        assert one.result is not None
        assert other.result is not None
        assert one.score is not None
        assert one.result.outcome == other.result.outcome
    events = [line.event for line in open_run(directory).lines]
    landed = [e.experiment for e in events if isinstance(e, Landed)]
    assert len(set(landed)) == len(landed)
    assert sum(isinstance(e, Proposed) for e in events) == 6


@pytest.mark.slow
def test_an_interrupted_search_leaves_the_machines(cluster: Cluster) -> None:
    executor = cluster.connected(2)
    begin: list[float] = []

    def stop(event: Event, view: SearchView) -> None:
        if isinstance(event, Proposed) and event.experiment == 3:
            time.sleep(3.0)
            begin.append(time.monotonic())
            raise KeyboardInterrupt

    source = SLOW.format(seconds=110.0)
    with pytest.raises(KeyboardInterrupt):
        go(cluster.folder, executor, 3, Ahead((source, source + "# 2\nX = 1\n")), stop)
    assert time.monotonic() - begin[0] < 44.0
    with pytest.raises(SandboxError, match="interrupted"):
        executor.carry(lambda r, d, u: b"", b"", "", b"")
    executor.close()
    after = cluster.connected(2)
    start = time.monotonic()
    states = survey_machines(after)
    assert len(states) == 2
    went = go(cluster.folder / "again", after, 2, Ahead((arx(2),)))
    assert len(went.finished) == 2
    assert time.monotonic() - start < 99.0, "the workers were still busy"
    after.close()
