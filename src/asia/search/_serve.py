"""The search that empties a queue: baseline first, then what is handed in, until the budget is
spent or nobody has handed anything in for a while."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from asia.agents import Proposal, SubmittedAgent
from asia.ledger import Event, Proposed, SearchView
from asia.problem.load import Problem, load_problem
from asia.sandbox import Isolation
from asia.search._desk import Order
from asia.search._queue import Queue
from asia.search._search import Prepared, prepare, search, with_early_stopping

IDLE_SECONDS = 1800.0


class IdleError(Exception):
    """Nothing was handed in for so long that the process ends; the run can be taken up again."""


def order_problem(order: Order) -> Problem:
    """The problem with what was ordered in place of its own."""
    problem = load_problem(order.problem)
    budget = problem.budget
    budget = replace(
        budget,
        experiments=order.experiments or budget.experiments,
        hours=order.hours if order.hours is not None else budget.hours,
        # Whoever hands in decides when enough is enough.
        patience=max(budget.patience, order.experiments or budget.experiments),
    )
    problem = replace(problem, budget=budget)
    if order.early_stopping is not None:
        problem = with_early_stopping(problem, order.early_stopping)
    return problem


def prepare_order(order: Order, runs: Path, name: str | None) -> Prepared:
    """As `prepare`, for a search that empties a queue."""
    level = Isolation(order.isolation) if order.isolation else None
    return prepare(
        order_problem(order), order.agent, seed=order.seed, runs=runs, name=name, isolation=level
    )


def serve(directory: Path, idle_seconds: float = IDLE_SECONDS) -> None:
    """Run to the end of the budget, or leave the run interrupted after `idle_seconds` without a
    submission."""
    directory = directory.resolve()
    prepared = prepare_order(Order.load(directory), directory.parent, directory.name)

    def waiting(seconds: float) -> None:
        if seconds > idle_seconds:
            raise IdleError

    queue = Queue(directory)
    agent = SubmittedAgent(prepared.started.agent, lambda: taking(queue), waiting)
    try:
        search(
            prepared,
            agent,
            on_event=lambda event, view: clearing(queue, event),
            on_start=lambda view: clear_known(queue, view),
        )
    except IdleError:
        return


def taking(queue: Queue) -> Proposal | None:
    """The oldest submission, with its ticket; it stays until the ledger has it."""
    for ticket in queue.tickets():
        proposal = queue.get(ticket)
        if proposal is not None:
            return replace(proposal, ticket=ticket)
    return None


def clearing(queue: Queue, event: Event) -> None:
    """Take out what the ledger has."""
    if isinstance(event, Proposed) and event.ticket:
        queue.remove(event.ticket)


def clear_known(queue: Queue, view: SearchView) -> None:
    """Take out what the ledger had when the search was cut off between writing the one and
    removing the other."""
    for experiment in view.experiments:
        if experiment.proposed.ticket:
            queue.remove(experiment.proposed.ticket)
