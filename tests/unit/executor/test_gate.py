"""Who goes first where jobs wait for a worker."""

import threading
from functools import partial

import pytest

from asia.executor import Gate, LocalExecutor, Turn, TurnedJob


def waiting(gate: Gate, count: int) -> None:
    """Until so many wait."""
    with gate._changed:
        assert gate._changed.wait_for(lambda: len(gate._waiting) == count, 20.0)


def come(gate: Gate, turn: Turn, name: str, order: list[str]) -> threading.Thread:
    before = len(gate._waiting)

    def enter() -> None:
        with gate.entered(turn):
            order.append(name)

    thread = threading.Thread(target=enter)
    thread.start()
    while len(gate._waiting) == before:
        threading.Event().wait(0.001)
    return thread


def test_the_earliest_turn_goes_first_then_who_came_first() -> None:
    gate, order = Gate(lambda: 1), list[str]()
    with gate.entered(Turn()):
        threads = [
            come(gate, turn, name, order)
            for turn, name in ((Turn(5), "a"), (Turn(2), "b"), (Turn(2), "c"), (Turn(9), "d"))
        ]
        assert order == []
    for thread in threads:
        thread.join()
    assert order == ["b", "c", "a", "d"]


def test_a_turn_may_change_while_a_job_waits() -> None:
    gate, order, late = Gate(lambda: 1), list[str](), Turn(100)
    with gate.entered(Turn()):
        threads = [come(gate, late, "late", order), come(gate, Turn(3), "other", order)]
        late.number = 0
    for thread in threads:
        thread.join()
    assert order == ["late", "other"]


def test_one_that_is_interrupted_while_it_waits_holds_nobody_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gate, order = Gate(lambda: 1), list[str]()

    def interrupted(seconds: float) -> bool:
        raise KeyboardInterrupt

    with gate.entered(Turn()):
        with monkeypatch.context() as patch:
            patch.setattr(gate._changed, "wait", interrupted)
            with pytest.raises(KeyboardInterrupt), gate.entered(Turn()):
                pass
        thread = come(gate, Turn(7), "other", order)
    thread.join()
    assert order == ["other"]


def test_room_that_appears_lets_more_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("asia.executor._gate._LOOK_SECONDS", 0.01)
    room, order = [1], list[str]()
    gate = Gate(lambda: room[0])
    with gate.entered(Turn()):
        thread = come(gate, Turn(), "second", order)
        room[0] = 2
        thread.join()
    assert order == ["second"]


def test_the_local_executor_keeps_turns_over_all_who_give_it_jobs() -> None:
    executor, order, begun = LocalExecutor(1), list[str](), threading.Event()
    go_on = threading.Event()

    def first() -> None:
        begun.set()
        go_on.wait(20.0)

    threads = [threading.Thread(target=partial(executor.run, [first]))]
    threads[0].start()
    assert begun.wait(20.0)
    for turn, name in ((3, "third"), (2, "second"), (1, "first")):
        jobs = [TurnedJob(Turn(turn), partial(order.append, name))]
        threads.append(threading.Thread(target=partial(executor.run, jobs)))
        threads[-1].start()
    waiting(executor._gate, 3)
    go_on.set()
    for thread in threads:
        thread.join()
    assert order == ["first", "second", "third"]
