"""Workers that a worker machine starts ahead."""

import time

import pytest

from asia.judge.evaluation import remote
from asia.judge.evaluation.remote import StandbyPool
from asia.judge.sandbox.types import Isolation, Limits
from asia.judge.sandbox.worker.worker import Worker

LIMITS = Limits(20.0, 20.0, 4096)
NOTHING: frozenset[str] = frozenset()


def begun(pool: StandbyPool) -> list[Worker]:
    """Those that wait now."""
    return [one.worker.result() for ready in pool._kept.values() for one in ready._waiting]


def test_the_next_fold_gets_the_one_that_waits() -> None:
    pool = StandbyPool()
    with pool.worker(Isolation.PROCESS, LIMITS, NOTHING):
        (waiting,) = begun(pool)
    with pool.worker(Isolation.PROCESS, LIMITS, NOTHING) as second:
        assert second is waiting
    pool._end_unused()


def test_those_of_a_search_that_sends_nothing_are_ended_but_none_that_is_used() -> None:
    pool = StandbyPool(seconds=0.05)
    with pool.worker(Isolation.PROCESS, LIMITS, NOTHING):
        (waiting,) = begun(pool)
        pool._end_unused()
        assert waiting._process.running()
    end = time.monotonic() + 20.0
    while waiting._process.running() or pool._kept:
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_search_with_other_limits_gets_its_own() -> None:
    pool = StandbyPool()
    other = Limits(10.0, 10.0, 2048)
    with pool.worker(Isolation.PROCESS, LIMITS, NOTHING):
        pass
    (waiting,) = begun(pool)
    with pool.worker(Isolation.PROCESS, other, NOTHING) as worker:
        assert worker is not waiting
    assert len(pool._kept) == 2
    pool._end_unused()
    assert not pool._kept


@pytest.mark.parametrize("alone", [False, True])
def test_none_waits_where_no_two_may_run_at_once(
    alone: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[StandbyPool] = []

    def standby_pool() -> StandbyPool:
        made.append(StandbyPool())
        return made[-1]

    monkeypatch.setattr(remote, "standby_pool", standby_pool)
    work = type("Work", (), {"isolation": Isolation.PROCESS, "limits": LIMITS, "alone": alone})
    with remote._open(work(), NOTHING):  # type: ignore[arg-type]
        pass
    assert len(made) == (0 if alone else 1)
    for pool in made:
        pool._end_unused()
    monkeypatch.undo()
    assert remote.standby_pool() is remote.standby_pool()
