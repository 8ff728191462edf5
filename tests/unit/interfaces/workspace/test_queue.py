import fcntl
import json
from pathlib import Path

import pytest

from asia.agents import Proposal
from asia.errors import UserError
from asia.interfaces.workspace.process import Queue


def proposal(title: str = "first") -> Proposal:
    return Proposal("def fit(): ...\n", "custom", title, "it helps", "a lower V", parent=1)


@pytest.fixture
def queue(tmp_path: Path) -> Queue:
    return Queue(tmp_path / "run")


def test_what_was_handed_in_is_found_by_another_process_in_its_order(queue: Queue) -> None:
    tickets = [queue.put(proposal(title)) for title in ("first", "second", "third")]
    again = Queue(queue.directory)
    assert again.tickets() == tickets
    found = again.get(tickets[1])
    assert found is not None
    assert (found.title, found.parent, found.ticket) == ("second", 1, tickets[1])


def test_a_clock_that_is_set_back_changes_no_order(
    queue: Queue, monkeypatch: pytest.MonkeyPatch
) -> None:
    times = iter((5_000, 4_000, 5_000, 3_000))
    monkeypatch.setattr("asia.interfaces.workspace.process.time.time_ns", lambda: next(times))
    tickets = [queue.put(proposal(title)) for title in ("one", "two", "three", "four")]
    assert queue.tickets() == tickets
    taken = queue.take()
    assert taken is not None
    assert taken.title == "one"


def test_an_empty_queue_has_nothing(queue: Queue) -> None:
    assert queue.tickets() == []
    assert queue.take() is None
    assert not queue.withdraw("01795244637784566847-3c38a250")


def test_what_was_taken_can_no_longer_be_withdrawn_and_stays_until_it_is_removed(
    queue: Queue,
) -> None:
    first, second = queue.put(proposal("first")), queue.put(proposal("second"))
    taken = queue.take()
    assert taken is not None
    assert taken.ticket == first
    assert not queue.withdraw(first)
    assert queue.tickets() == [first, second]
    assert queue.get(first) == taken
    assert queue.remove(first)
    assert not queue.remove(first)
    assert queue.withdraw(second)
    assert queue.tickets() == []


def test_what_a_dead_search_had_taken_is_taken_again(queue: Queue) -> None:
    first, second = queue.put(proposal("first")), queue.put(proposal("second"))
    assert queue.take() is not None
    queue.give_back()
    assert queue.tickets() == [first, second]
    again = queue.take()
    assert again is not None
    assert again.ticket == first


@pytest.mark.parametrize("ticket", ["../order", "", "x", "../../ledger", "a\0b", "*"])
def test_a_ticket_from_outside_names_no_other_file(queue: Queue, ticket: str) -> None:
    queue.put(proposal())
    order = queue.directory / "control" / "order.json"
    order.write_text(json.dumps({"source": "secret"}))
    assert queue.get(ticket) is None
    assert not queue.withdraw(ticket)
    assert not queue.remove(ticket)
    assert order.is_file()


def test_other_files_are_no_submissions(queue: Queue) -> None:
    ticket = queue.put(proposal())
    for name in ("notes.json", ".hidden.json", "readme.txt", f".{ticket}.json.1.new"):
        (queue.folder / name).write_text("x")
    assert queue.tickets() == [ticket]


def test_a_damaged_file_is_named(queue: Queue) -> None:
    ticket = queue.put(proposal())
    (queue.folder / f"{ticket}.json").write_text('{"source": ')
    with pytest.raises(UserError, match=f"{ticket}.json is not a submission: remove"):
        queue.get(ticket)


def test_one_hands_in_at_a_time(queue: Queue) -> None:
    def lock_it() -> None:
        with (queue.folder / ".lock").open("rb") as other:
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)

    with queue.alone(), pytest.raises(BlockingIOError):
        lock_it()
    lock_it()
