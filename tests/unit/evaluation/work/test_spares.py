"""Workers that a worker machine starts ahead."""

import time

import pytest

from asia.evaluation.work import spares as spares_module
from asia.evaluation.work.spares import SpareWorkers
from asia.sandbox import Isolation, Limits, Worker

LIMITS = Limits(20.0, 20.0, 4096)
NOTHING: frozenset[str] = frozenset()


def begun(spares: SpareWorkers) -> list[Worker]:
    """Those that wait now."""
    return [one.worker.result() for ready in spares._kept.values() for one in ready._waiting]


def test_the_next_fold_gets_the_one_that_waits() -> None:
    spares = SpareWorkers()
    with spares.worker(Isolation.PROCESS, LIMITS, NOTHING):
        (waiting,) = begun(spares)
    with spares.worker(Isolation.PROCESS, LIMITS, NOTHING) as second:
        assert second is waiting
    spares._end_unused()


def test_those_of_a_search_that_sends_nothing_are_ended_but_none_that_is_used() -> None:
    spares = SpareWorkers(seconds=0.05)
    with spares.worker(Isolation.PROCESS, LIMITS, NOTHING):
        (waiting,) = begun(spares)
        spares._end_unused()
        assert waiting._process.running()
    end = time.monotonic() + 20.0
    while waiting._process.running() or spares._kept:
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_search_with_other_limits_gets_its_own() -> None:
    spares = SpareWorkers()
    other = Limits(10.0, 10.0, 2048)
    with spares.worker(Isolation.PROCESS, LIMITS, NOTHING):
        pass
    (waiting,) = begun(spares)
    with spares.worker(Isolation.PROCESS, other, NOTHING) as worker:
        assert worker is not waiting
    assert len(spares._kept) == 2
    spares._end_unused()
    assert not spares._kept


@pytest.mark.parametrize("alone", [False, True])
def test_none_waits_where_no_two_may_run_at_once(
    alone: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    from asia.evaluation.work import elsewhere

    made: list[SpareWorkers] = []

    def spare_workers() -> SpareWorkers:
        made.append(SpareWorkers())
        return made[-1]

    monkeypatch.setattr(elsewhere, "spare_workers", spare_workers)
    work = type("Work", (), {"isolation": Isolation.PROCESS, "limits": LIMITS, "alone": alone})
    with elsewhere._open(work(), NOTHING, LIMITS):  # type: ignore[arg-type]
        pass
    assert len(made) == (0 if alone else 1)
    for spares in made:
        spares._end_unused()
    assert spares_module.spare_workers() is spares_module.spare_workers()
