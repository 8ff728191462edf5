"""Where candidates are handed in and results fetched, by whoever is not the search itself.

A desk reads the ledger and writes to the queue of a run directory; the search that empties it is a
process of its own, started when it is not there. Whoever asks may die at any time.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, Protocol

from asia.agents import Proposal
from asia.candidate import check_source
from asia.errors import CandidateError, UserError
from asia.ledger import Experiment, Run, SearchView, open_run
from asia.search._agent_view import digest
from asia.search._queue import TEXT, TITLE, Queue

State = Literal["queued", "running", "done", "unknown"]

DETAIL = 300
_POLL = 0.1
_START_SECONDS = 60.0


@dataclass(frozen=True)
class Job:
    """Where a submission stands: `ahead` others before it in the queue; `experiment` once it is
    one."""

    ticket: str
    state: State
    ahead: int = 0
    experiment: int | None = None


@dataclass(frozen=True)
class Result:
    """An experiment in few words, safe to show to anyone: no output of the candidate but one
    bounded line of its own error."""

    experiment: int
    status: str
    value: float | None
    folds: tuple[float, ...]
    reason: str | None
    advice: str | None
    detail: str | None
    title: str
    parent: int | None
    seconds: float
    duplicate_of: int | None


@dataclass(frozen=True)
class Standing:
    """Where the search stands."""

    run: str
    problem: str
    state: str
    experiments: int
    budget: int
    v_name: str
    best: int | None
    best_value: float | None
    rungs: dict[str, float | None]
    notes: tuple[str, ...]

    @property
    def remaining(self) -> int:
        """Experiments left."""
        return max(0, self.budget - self.experiments)


class Desk(Protocol):
    """What a driver from outside may do. Every method raises UserError with what to do next."""

    def submit(self, proposal: Proposal) -> Job:
        """Hand in a candidate; its static errors are told at once and cost no experiment."""
        ...

    def job(self, ticket: str) -> Job:
        """Where a submission stands."""
        ...

    def withdraw(self, ticket: str) -> Job:
        """Take a submission back that is still queued."""
        ...

    def results(self) -> tuple[Result, ...]:
        """All finished experiments."""
        ...

    def source(self, experiment: int) -> str:
        """An experiment's candidate.py."""
        ...

    def standing(self) -> Standing:
        """Where the search stands."""
        ...


class RunDesk:
    """The desk of a run directory. keep_alive: called where the search is needed and not there."""

    def __init__(self, directory: Path, keep_alive: Callable[[Path], None] | None = None) -> None:
        self._directory = directory
        self._queue = Queue(directory)
        self._keep_alive = keep_alive

    def submit(self, proposal: Proposal) -> Job:
        """See `Desk.submit`; the same source, comments apart, is one submission."""
        proposal = tidy(proposal)
        try:
            check_source(proposal.source)
        except CandidateError as error:
            raise UserError(
                f"the candidate was not handed in, and no experiment spent: {error.reason.advice}"
                + (f" ({one_line(error.detail)})" if error.detail else "")
            ) from None
        if self._keep_alive is not None and not (self._directory / "ledger.jsonl").is_file():
            self._keep_alive(self._directory)
        view = open_run(self._directory).view
        known = digest(proposal.source)
        for ticket in self._queue.tickets():
            waiting = self._queue.get(ticket)
            if waiting is not None and digest(waiting.source) == known:
                return self._woken(ticket)
        for experiment in view.experiments:
            if experiment.proposed.digest == known:
                state: State = "done" if experiment.result else "running"
                return Job(experiment.proposed.ticket, state, experiment=experiment.number)
        _refuse_when_over(view, len(self._queue.tickets()))
        numbers = {e.number for e in view.experiments}
        if proposal.parent is not None and proposal.parent not in numbers:
            raise UserError(f"parent {proposal.parent}: expected an experiment of this search")
        return self._woken(self._queue.put(proposal))

    def _woken(self, ticket: str) -> Job:
        if self._keep_alive is not None:
            self._keep_alive(self._directory)
        return self.job(ticket)

    def job(self, ticket: str) -> Job:
        """See `Desk.job`."""
        waiting = self._queue.tickets()
        for experiment in open_run(self._directory).view.experiments:
            if ticket and experiment.proposed.ticket == ticket:
                state: State = "done" if experiment.result else "running"
                return Job(ticket, state, experiment=experiment.number)
        if ticket in waiting:
            return Job(ticket, "queued", waiting.index(ticket))
        return Job(ticket, "unknown")

    def withdraw(self, ticket: str) -> Job:
        """See `Desk.withdraw`."""
        if not self._queue.remove(ticket):
            job = self.job(ticket)
            raise UserError(
                f"submission {ticket} is {job.state}: only a queued one can be taken back"
            )
        return Job(ticket, "unknown")

    def results(self) -> tuple[Result, ...]:
        """See `Desk.results`."""
        return tuple(result_of(e) for e in open_run(self._directory).view.finished)

    def source(self, experiment: int) -> str:
        """See `Desk.source`."""
        run = open_run(self._directory)
        return run.store.text(run.view.experiment(experiment).proposed.source)

    def standing(self) -> Standing:
        """See `Desk.standing`."""
        return standing_of(open_run(self._directory))


def wait(desk: Desk, ticket: str, seconds: float, tick: Callable[[Job], None]) -> Job:
    """Until the submission is done or the time is over; `tick` is called at every look."""
    end = time.monotonic() + seconds
    while True:
        job = desk.job(ticket)
        tick(job)
        if job.state in ("done", "unknown") or time.monotonic() >= end:
            return job
        time.sleep(_POLL)


def tidy(proposal: Proposal) -> Proposal:
    """Bounded words on one line. Raises UserError without a hypothesis."""
    hypothesis = one_line(proposal.hypothesis, TEXT)
    if not hypothesis:
        raise UserError("a candidate needs a hypothesis: what you expect of it, and why")
    return Proposal(
        source=proposal.source,
        family=one_line(proposal.family, 40) or "custom",
        title=one_line(proposal.title, TITLE) or hypothesis[:TITLE],
        hypothesis=hypothesis,
        expected=one_line(proposal.expected, TEXT) or "not said",
        parent=proposal.parent,
    )


def one_line(text: str, most: int = DETAIL) -> str:
    """Printable characters on one line, cut to `most`; what comes from outside is shown as this."""
    flat = " ".join(text.split())
    clean = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in flat)
    return clean if len(clean) <= most else clean[: most - 1] + "…"


def result_of(experiment: Experiment) -> Result:
    """An evaluated experiment in few words."""
    p, r, score, failure = (
        experiment.proposed, experiment.result, experiment.score, experiment.failure,
    )  # fmt: skip
    assert r is not None
    detail = failure.detail.strip().splitlines() if failure else []
    return Result(
        experiment=experiment.number,
        status=r.status,
        value=score.value if score else None,
        folds=tuple(f.value for f in score.folds) if score else (),
        reason=failure.reason.value if failure else None,
        advice=failure.advice if failure else None,
        detail=one_line(detail[-1]) if detail else None,
        title=one_line(p.title, TITLE),
        parent=p.parent,
        seconds=round(r.seconds, 1),
        duplicate_of=r.duplicate_of,
    )


def standing_of(run: Run) -> Standing:
    """Where a run stands."""
    view = run.view
    best = view.best
    return Standing(
        run=view.started.run,
        problem=view.started.problem,
        state=run.state,
        experiments=len(view.finished),
        budget=view.budget,
        v_name=view.v_name,
        best=best.number if best else None,
        best_value=best.score.value if best and best.score else None,
        rungs={r.name: getattr(r.outcome, "value", None) for r in view.rungs},
        notes=tuple(note.text for note in view.notes),
    )


def _refuse_when_over(view: SearchView, queued: int) -> None:
    if view.unsealing is not None:
        raise UserError("the sealed test of this run was opened: its search is over for good")
    if len(view.experiments) + queued >= view.budget:
        raise UserError(
            f"the budget of {view.budget} experiments is spent; a person can raise it with "
            "asia workspace or asia run and a larger --experiments"
        )


@dataclass(frozen=True)
class Order:
    """What a search that empties a queue was asked for; kept in its run directory."""

    problem: str
    agent: str
    seed: int
    experiments: int | None
    hours: float | None
    early_stopping: str | None
    isolation: str | None

    def save(self, directory: Path) -> None:
        """Write it."""
        from asia.search._controls import write_whole

        write_whole(directory / "control" / "order.json", json.dumps(asdict(self)).encode())

    @classmethod
    def load(cls, directory: Path) -> Order:
        """Read it. Raises UserError when the run was not started by a workspace or a server."""
        try:
            return cls(**json.loads((directory / "control" / "order.json").read_text("utf-8")))
        except FileNotFoundError:
            raise UserError(
                f"{directory.name} takes no submissions: it was not started by asia workspace or "
                "asia mcp"
            ) from None


def start_search(directory: Path) -> None:
    """Start the process that empties the queue, unless one does; returns once it does. Raises
    UserError with the last line it wrote when it ends at once."""
    if _runs(directory):
        return
    log = directory / "control" / "search.log"
    with log.open("ab") as stream:
        process = subprocess.Popen(
            [sys.executable, "-m", "asia.search", str(directory)],
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=stream,
            start_new_session=True,
            cwd="/",
        )
    end = time.monotonic() + _START_SECONDS
    while not _runs(directory):
        if process.poll() is not None and not _runs(directory):
            words = log.read_text("utf-8", "replace").strip().splitlines()
            raise UserError(f"the search did not start: {one_line(words[-1]) if words else log}")
        if time.monotonic() > end:
            raise UserError(f"the search did not start in {_START_SECONDS:g} s; see {log}")
        time.sleep(_POLL)


def _runs(directory: Path) -> bool:
    from asia.ledger import in_use

    ledger = directory / "ledger.jsonl"
    return ledger.is_file() and in_use(ledger)
