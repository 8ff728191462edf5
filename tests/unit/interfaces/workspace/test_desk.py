import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from asia._text import one_line
from asia.agents import Proposal
from asia.errors import Reason, UserError
from asia.interfaces.workspace.process import (
    Queue,
    SearchRequest,
    clear_known,
    prepare_request,
    serve,
)
from asia.interfaces.workspace.server import Best, RunDesk, Submission, wait
from asia.judge.scoring.outcome import Failure
from asia.ledger.events import Evaluated, Proposed, Stopped, Unsealing
from asia.ledger.run import Run, open_run
from asia.search.agent_views import digest
from tests.unit.search.toy import CRASH, arx

from .desks import Place, candidate, order, ordered


@pytest.fixture(scope="module")
def served_once(tmp_path_factory: pytest.TempPathFactory) -> tuple[Place, str]:
    """Baseline and one submission judged, the search gone for want of more; and its ticket."""
    place = ordered(tmp_path_factory.mktemp("served"))
    serve(place.directory, idle_seconds=0.0)
    ticket = place.desk.submit(candidate(2)).ticket
    serve(place.directory, idle_seconds=0.0)
    return place, ticket


@pytest.fixture
def served(served_once: tuple[Place, str], tmp_path: Path) -> tuple[Place, str]:
    place, ticket = served_once
    directory = tmp_path / "runs" / place.directory.name
    shutil.copytree(place.directory, directory)
    return replace(place, directory=directory), ticket


@pytest.fixture
def place(served: tuple[Place, str]) -> Place:
    return served[0]


def test_a_submission_is_judged_and_found_by_its_ticket(served: tuple[Place, str]) -> None:
    place, ticket = served
    assert place.desk.submission(ticket) == Submission(ticket, "done", experiment=2)
    baseline, result = place.desk.results()
    assert (baseline.title, baseline.status) == ("baseline", "keep")
    assert result.status == "keep"
    assert result.V is not None
    assert result.V < 0.05
    assert len(result.folds) == 2
    assert place.desk.source(2) == arx(2)
    progress = place.desk.progress()
    assert progress.best == Best(2, result.V)
    assert (progress.state, progress.remaining) == ("interrupted", 2)


def test_a_submission_waits_for_a_search_that_is_not_there(place: Place) -> None:
    first, second = place.desk.submit(candidate(3)), place.desk.submit(candidate(4))
    assert (first.state, first.ahead) == ("queued", 0)
    assert place.desk.submission(second.ticket) == Submission(second.ticket, "queued", 1)
    looks: list[Submission] = []
    assert wait(place.desk, first.ticket, 0.0, looks.append) == looks[0] == first


def test_static_errors_cost_no_experiment(place: Place) -> None:
    for source, words in (
        ("def fit(:", "line 1"),
        ("x = 1\n", "defines no top-level function fit"),
        ("def fit(t, c): return '\ud800'\n", "not valid Unicode"),
    ):
        with pytest.raises(UserError, match=words) as caught:
            place.desk.submit(Proposal(source, "", "", "it helps", ""))
        assert "cost no experiment" in str(caught.value)
    assert Queue(place.directory).tickets() == []


def test_a_submission_needs_a_hypothesis(place: Place) -> None:
    with pytest.raises(UserError, match="needs a hypothesis"):
        place.desk.submit(candidate(3, hypothesis=" \n"))


def test_words_are_bounded_and_stay_on_their_line(place: Place) -> None:
    submission = place.desk.submit(candidate(3, hypothesis="a\x1b[31m\nb " + 3000 * "c"))
    waiting = Queue(place.directory).get(submission.ticket)
    assert waiting is not None
    assert len(waiting.hypothesis) == 2000
    assert waiting.hypothesis.startswith("a\N{REPLACEMENT CHARACTER}[31m b ccc")
    assert len(waiting.title) == 80
    assert one_line("x" * 500).endswith("…")


def test_the_family_is_that_of_the_imports_where_none_is_named(place: Place) -> None:
    own = candidate(3)
    fitted = f"from asia.models.greybox import Physics\nfrom asia.models import arx\n{own.source}"
    for proposal, family in (
        (replace(own, source=fitted, family=""), "greybox, arx"),
        (replace(own, source=f"{fitted}# named\nx = 1\n", family="reactor"), "reactor"),
    ):
        waiting = Queue(place.directory).get(place.desk.submit(proposal).ticket)
        assert waiting is not None
        assert waiting.family == family


def test_the_same_source_is_one_submission(served: tuple[Place, str]) -> None:
    place, ticket = served
    assert place.desk.submit(replace(candidate(2), source=arx(2) + "# a comment\n")) == Submission(
        ticket, "done", experiment=2, repeated=True
    )
    first = place.desk.submit(candidate(3))
    again = place.desk.submit(candidate(3, hypothesis="another"))
    assert again == replace(first, repeated=True)
    assert Queue(place.directory).tickets() == [first.ticket]


def test_what_nobody_handed_in_can_be_asked_for_too(place: Place) -> None:
    submission = place.desk.submit(candidate(1))
    assert submission == Submission("experiment-1", "done", experiment=1, repeated=True)
    assert place.desk.submission(submission.ticket) == replace(submission, repeated=False)


def test_a_result_that_hung_on_the_machine_can_be_asked_for_again(place: Place) -> None:
    source = arx(3)
    place.append(
        Proposed(3, None, "explore", "custom", "slow", "h", "e", "0" * 64, digest(source), "t"),
        Evaluated(3, "timeout", Failure(Reason.FIT_TIMEOUT), None, 1.0, deadline=True),
    )
    assert place.desk.submit(candidate(3)).state == "queued"


def test_the_queue_counts_towards_the_budget(place: Place) -> None:
    place.desk.submit(candidate(3))
    place.desk.submit(candidate(4))
    with pytest.raises(UserError, match="was not evaluated: the budget of 4 experiments is spent"):
        place.desk.submit(candidate(5))
    order(place.problem, 5).save(place.directory)
    assert place.desk.submit(candidate(5)).ahead == 2


def test_the_baseline_counts_before_it_is_judged(tmp_path: Path) -> None:
    place = ordered(tmp_path, experiments=1)
    wanted = SearchRequest.load(place.directory)
    place.append(prepare_request(wanted, place.directory.parent, None).started)
    with pytest.raises(UserError, match="budget of 1 experiments is spent"):
        place.desk.submit(candidate(2))


@pytest.mark.slow
def test_the_baseline_costs_nothing_before_it_is_judged(tmp_path: Path) -> None:
    place = ordered(tmp_path)
    prepared = prepare_request(SearchRequest.load(place.directory), place.directory.parent, None)
    (place.directory / "problem.lock.toml").write_text(prepared.lock)
    place.append(prepared.started)
    called: list[Path] = []
    desk = RunDesk(place.directory, called.append)
    submission = desk.submit(candidate(1))
    assert submission == Submission("experiment-1", "queued", repeated=True)
    assert Queue(place.directory).tickets() == []
    assert called
    serve(place.directory, idle_seconds=0.0)
    assert desk.submission(submission.ticket).state == "done"
    assert [r.experiment for r in desk.results()] == [1]


def test_a_parent_must_exist(place: Place) -> None:
    for parent in (0, 3, -1):
        with pytest.raises(UserError, match=f"parent {parent}: expected an experiment"):
            place.desk.submit(candidate(3, parent=parent))
    assert place.desk.submit(candidate(3, parent=2)).state == "queued"


def test_withdrawing(served: tuple[Place, str]) -> None:
    place, done = served
    first, second = place.desk.submit(candidate(3)), place.desk.submit(candidate(4))
    assert place.desk.withdraw(first.ticket).state == "withdrawn"
    assert place.desk.submission(second.ticket).ahead == 0
    Queue(place.directory).take()
    for ticket, words in (
        (first.ticket, "is unknown"),
        (second.ticket, "is about to be evaluated"),
        (done, "is done"),
        ("experiment-1", "is done"),
        ("../order", "is unknown"),
    ):
        with pytest.raises(UserError, match=f"{words}: only a queued one"):
            place.desk.withdraw(ticket)
    assert (place.directory / "control" / "order.json").is_file()


def test_nothing_is_lost_or_counted_twice_when_the_search_dies_between_ledger_and_queue(
    served: tuple[Place, str],
) -> None:
    place, ticket = served
    queue = Queue(place.directory)
    left = queue.folder / f"{ticket}.taken"
    left.write_text('{"source": "", "family": "", "title": "", "hypothesis": "", "expected": ""}')
    assert place.desk.submission(ticket).state == "done"
    place.desk.submit(candidate(3))
    waiting = place.desk.submit(candidate(4))
    assert waiting.state == "queued"
    assert queue.take() is not None
    clear_known(queue, open_run(place.directory).view)
    assert not left.exists()
    assert len(queue.tickets()) == 2
    assert queue.withdraw(queue.tickets()[0])
    assert queue.tickets() == [waiting.ticket]


def test_a_sealed_test_that_was_opened_ends_it(place: Place) -> None:
    place.append(Stopped("budget"), Unsealing(2, "0" * 64, ()))
    with pytest.raises(UserError, match="its search cannot continue"):
        place.desk.submit(candidate(3))


def test_only_a_person_takes_up_what_a_person_stopped(place: Place) -> None:
    waiting = place.desk.submit(candidate(3)).ticket
    place.append(Stopped("user"))
    with pytest.raises(UserError, match="the user stopped this search"):
        place.desk.submit(candidate(4))
    with pytest.raises(UserError, match=f"submission {waiting} is stored and was not judged"):
        place.desk.submit(candidate(3))
    SearchRequest.load(place.directory).save(place.directory)
    assert place.desk.submit(candidate(4)).ahead == 1


def test_the_search_is_called_where_it_is_needed_only(served: tuple[Place, str]) -> None:
    place, _ = served
    calls: list[Path] = []
    desk = RunDesk(place.directory, calls.append)
    desk.wake()
    desk.submit(candidate(2))
    desk.results()
    assert calls == []
    desk.submit(candidate(3))
    desk.wake()
    assert calls == [place.directory.resolve()] * 2


@pytest.mark.slow
def test_a_search_that_never_began_is_started_first(tmp_path: Path) -> None:
    place = ordered(tmp_path)
    with pytest.raises(UserError, match="no ledger"):
        place.desk.submit(candidate(2))
    desk = RunDesk(place.directory, lambda directory: serve(directory, idle_seconds=0.0))
    submission = desk.submit(Proposal(CRASH, "", "", "it fails", "", None))
    assert (submission.state, submission.experiment) == ("done", 2)
    crash = desk.results()[1]
    assert (crash.status, crash.V, crash.reason) == ("crash", None, "crash")
    assert crash.detail == "line 2: ValueError: no such luck"


def test_looking_reads_the_ledger_only_where_it_changed(
    served: tuple[Place, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    place, ticket = served
    reads: list[Path] = []

    def counted(directory: Path) -> Run:
        reads.append(directory)
        return open_run(directory)

    monkeypatch.setattr("asia.interfaces.workspace.server.open_run", counted)
    desk = place.desk
    for _ in range(20):
        assert desk.submission(ticket).state == "done"
        desk.progress()
    assert len(reads) == 1
    place.append(Stopped("user"))
    desk.submission(ticket)
    assert len(reads) == 2
