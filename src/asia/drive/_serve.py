"""Search that empties a queue: the baseline first, then the submissions, until the budget is spent
or no submission has come for a while.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from asia.agents import SubmittedAgent
from asia.drive._detached import SearchRequest, attending
from asia.drive._queue import Queue
from asia.ledger import Event, Proposed, SearchView, open_run
from asia.problem.load import Problem, load_problem
from asia.sandbox import Isolation
from asia.search._run import Prepared, check_same_search, prepare, search, with_early_stopping

IDLE_SECONDS = 1800.0

# The submitting user decides when to stop. The value is in the lock file, so it never changes.
_PATIENCE = 1_000_000


class IdleError(Exception):
    """End of the process after a time without submissions; the run can be resumed."""


class NewRequestError(Exception):
    """More was requested while the search waited."""


def requested_problem(request: SearchRequest) -> Problem:
    """The problem with what was requested in place of its own."""
    problem = load_problem(request.problem)
    budget = problem.budget
    budget = replace(
        budget,
        experiments=request.experiments or budget.experiments,
        hours=request.hours if request.hours is not None else budget.hours,
        retests=request.retests if request.retests is not None else budget.retests,
        patience=_PATIENCE,
    )
    problem = replace(problem, budget=budget)
    if request.early_stopping is not None:
        problem = with_early_stopping(problem, request.early_stopping)
    return problem


def prepare_request(request: SearchRequest, runs: Path, name: str | None) -> Prepared:
    """Prepare a search that empties a queue, see `prepare`. If the request leaves the number of
    experiments open, a run keeps a larger number than its problem has.

    Raises:
        UserError: as `prepare`; also if the run is another search or has a larger budget than
            requested.
    """
    level = Isolation(request.isolation) if request.isolation else None

    def prepared(problem: Problem) -> Prepared:
        return prepare(
            problem, request.agent, seed=request.seed, runs=runs, name=name, isolation=level,
            isolation_strict=request.isolation_strict, agent_settings=request.settings,
        )  # fmt: skip

    problem = requested_problem(request)
    ready = prepared(problem)
    if not ready.resumes:
        return ready
    view = open_run(ready.directory).view
    if request.experiments is None and view.budget > problem.budget.experiments:
        budget = replace(problem.budget, experiments=view.budget)
        ready = prepared(replace(problem, budget=budget))
    check_same_search(view, ready.started)
    return ready


def serve(directory: Path, idle_seconds: float = IDLE_SECONDS) -> None:
    """Run to the end of the budget, or leave the run interrupted after `idle_seconds` without a
    submission."""
    directory = directory.resolve()
    with attending(directory):
        _serve(directory, idle_seconds)


def _serve(directory: Path, idle_seconds: float) -> None:
    queue = Queue(directory)
    while True:
        request = SearchRequest.load(directory)
        prepared = prepare_request(request, directory.parent, directory.name)
        patience = _patience(directory, request, idle_seconds)
        agent = SubmittedAgent(prepared.started.agent, queue.take, patience)
        try:
            search(
                prepared,
                agent,
                on_event=lambda event, view: clearing(queue, event),
                on_start=lambda view: clear_known(queue, view),
            )
        except IdleError:
            # Submitted after the last poll, while this search was still visible.
            if not queue.tickets():
                return
        except NewRequestError:
            pass
        else:
            if SearchRequest.load(directory) == request:
                return


def _patience(
    directory: Path, request: SearchRequest, idle_seconds: float
) -> Callable[[float], None]:
    """Return the function that is called while the queue is empty."""

    def waiting(seconds: float) -> None:
        now = SearchRequest.load(directory)
        # The same request given again asks for nothing more.
        if replace(now, records=request.records) != request:
            raise NewRequestError
        if seconds > idle_seconds:
            raise IdleError

    return waiting


def clearing(queue: Queue, event: Event) -> None:
    """Take out what the ledger has."""
    if isinstance(event, Proposed) and event.ticket:
        queue.remove(event.ticket)


def clear_known(queue: Queue, view: SearchView) -> None:
    """Put in order what a search left that was cut off: what the ledger has is taken out, what it
    had taken and not recorded waits again."""
    for experiment in view.experiments:
        if experiment.proposed.ticket:
            queue.remove(experiment.proposed.ticket)
    queue.give_back()
