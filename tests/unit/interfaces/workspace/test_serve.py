import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from asia.agents import Agent
from asia.errors import UserError
from asia.interfaces.workspace.process import (
    IdleError,
    Queue,
    SearchRequest,
    prepare_request,
    serve,
    start_search,
)
from asia.interfaces.workspace.server import RunDesk, wait
from asia.ledger.run import open_run
from asia.ledger.view import SearchView
from asia.search.run import Prepared

from .desks import Place, candidate, end_searches, order, ordered, searches


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Place]:
    made = ordered(tmp_path)
    yield made
    end_searches(made.directory)


@pytest.mark.slow
def test_a_search_of_its_own_runs_to_the_end_of_its_budget(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(place.problem.parent)
    order(Path("toy"), 3).save(place.directory)
    desk = RunDesk(Path("runs") / place.directory.name, start_search)
    first = desk.submit(candidate(2))
    assert first.state == "queued"
    assert desk.progress().state == "running"
    assert len(searches(place.directory)) == 1
    start_search(place.directory)
    assert len(searches(place.directory)) == 1
    second = desk.submit(candidate(3, parent=1))
    assert wait(desk, second.ticket, 60.0, lambda submission: None).experiment == 3
    assert desk.submission(first.ticket).experiment == 2
    while desk.progress().state == "running":
        time.sleep(0.05)
    assert desk.progress().state == "finished"
    assert Queue(place.directory).tickets() == []


def test_a_search_that_fails_at_once_says_why(place: Place) -> None:
    log = place.directory / "control" / "search.log"
    log.write_text("asia: an old complaint\n")
    (place.problem / "problem.toml").write_text("nonsense = 1\n")
    desk = RunDesk(place.directory, start_search)
    with pytest.raises(UserError, match=r"the search did not start: problem\.toml: ") as caught:
        desk.submit(candidate(2))
    assert "old complaint" not in str(caught.value)
    assert searches(place.directory) == []


@pytest.mark.slow
def test_a_killed_search_is_taken_up_again_where_it_was(place: Place) -> None:
    desk = RunDesk(place.directory, start_search)
    submission = desk.submit(candidate(2))
    wait(desk, submission.ticket, 0.0, lambda submission: None)
    for pid in searches(place.directory):
        os.kill(pid, 9)
    while desk.progress().state == "running":
        time.sleep(0.02)
    assert desk.progress().state == "interrupted"
    assert desk.submission(submission.ticket).state in ("queued", "running")
    desk.wake()
    assert wait(desk, submission.ticket, 60.0, lambda submission: None).state == "done"
    assert [r.experiment for r in desk.results()] == [1, 2]


def test_nobody_there_ends_it_and_leaves_the_run_as_it_is(tmp_path: Path) -> None:
    place = ordered(tmp_path)
    serve(place.directory, idle_seconds=0.0)
    # A worker that is just being started holds the lock until it has become its own program.
    while (run := open_run(place.directory)).state == "running":
        time.sleep(0.02)
    assert run.state == "interrupted"
    assert run.view.stopped is None
    assert len(run.view.finished) == 1


Fake = Callable[[Prepared, Agent], None]


def fake_search(monkeypatch: pytest.MonkeyPatch, *sittings: Fake) -> list[Prepared]:
    """`serve` calls these in turn for the search; what each was to run."""
    left = list(sittings)
    seen: list[Prepared] = []

    def search(
        prepared: Prepared, agent: Agent, on_event: object, on_start: object
    ) -> SearchView | None:
        seen.append(prepared)
        left.pop(0)(prepared, agent)

    monkeypatch.setattr("asia.interfaces.workspace.process.search", search)
    return seen


def test_what_comes_after_the_last_look_is_still_judged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = ordered(tmp_path)
    queue = Queue(place.directory)

    def idle(prepared: Prepared, agent: Agent) -> None:
        queue.put(candidate(2))
        raise IdleError

    def judged(prepared: Prepared, agent: Agent) -> None:
        queue.remove(queue.tickets()[0])

    seen = fake_search(monkeypatch, idle, judged)
    serve(place.directory)
    assert len(seen) == 2


def test_a_larger_order_reaches_a_search_that_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = ordered(tmp_path)

    def waits(prepared: Prepared, agent: Agent) -> None:
        order(place.problem, 9).save(place.directory)
        agent.propose(None)  # pyright: ignore[reportArgumentType]

    seen = fake_search(monkeypatch, waits, lambda prepared, agent: None)
    serve(place.directory)
    assert [p.problem.budget.experiments for p in seen] == [4, 9]


def test_the_same_order_again_does_not_disturb_a_search_that_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = ordered(tmp_path)

    def waits(prepared: Prepared, agent: Agent) -> None:
        place.append(prepared.started)
        SearchRequest.load(place.directory).save(place.directory)
        agent.propose(None)  # pyright: ignore[reportArgumentType]

    seen = fake_search(monkeypatch, waits)
    serve(place.directory, idle_seconds=0.0)
    assert len(seen) == 1


def test_a_larger_order_reaches_a_search_that_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = ordered(tmp_path)

    def ends(prepared: Prepared, agent: Agent) -> None:
        order(place.problem, 9).save(place.directory)

    seen = fake_search(monkeypatch, ends, lambda prepared, agent: None)
    serve(place.directory)
    assert [p.problem.budget.experiments for p in seen] == [4, 9]


@pytest.mark.long
def test_an_order_for_a_run_that_exists(tmp_path: Path) -> None:
    place = ordered(tmp_path, experiments=1)
    serve(place.directory)
    assert open_run(place.directory).state == "finished"
    runs = place.directory.parent

    order(place.problem, 2).save(place.directory)
    place.desk.submit(candidate(2))
    serve(place.directory)
    view = open_run(place.directory).view
    assert (view.budget, len(view.finished)) == (2, 2)

    order(place.problem, 7).save(place.directory)
    serve(place.directory, idle_seconds=0.0)
    assert open_run(place.directory).view.budget == 7
    kept = prepare_request(order(place.problem, None), runs, None)
    assert kept.problem.budget.experiments == 7
    with pytest.raises(UserError, match="has 7 experiments, and a budget can only grow"):
        prepare_request(order(place.problem, 3), runs, None)
    with pytest.raises(UserError, match="has seed 0, not 1: choose another --name"):
        prepare_request(order(place.problem, 7, seed=1), runs, place.directory.name)


def test_an_order_that_is_not_there_or_damaged(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="accepts no submissions: it was not started by"):
        SearchRequest.load(tmp_path)
    (tmp_path / "control").mkdir()
    (tmp_path / "control" / "order.json").write_text("[]")
    with pytest.raises(UserError, match=r"order.json is damaged"):
        SearchRequest.load(tmp_path)
