"""Submission server: accepts candidates and returns results, for processes other than the search.

It reads the ledger and writes to the queue of a run directory. The search that empties the queue is
a process of its own, which is started if necessary. The submitting process may end at any time.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from asia._text import one_line
from asia.agents import Proposal
from asia.candidate import check_source
from asia.drive._answers import (
    DryRunSummary,
    ExperimentSummary,
    SearchProgress,
    Submission,
    SubmissionState,
    dry_run_summary,
    progress_of,
    summary_of,
)
from asia.drive._detached import SearchRequest, attended, has_begun, runs
from asia.drive._evidence import EvidenceSummary, evidence_summary
from asia.drive._queue import TEXT, TITLE, Queue
from asia.drive._serve import requested_problem
from asia.errors import CandidateError, SandboxError, UserError
from asia.evaluation import LINEAR
from asia.ledger import Experiment, Run, Stopped, open_run, published
from asia.report import SimulatedCases
from asia.search import dry_run, simulated_excerpts
from asia.search._agent_view import digest

_POLL = 0.1
# Ticket of the baseline, which is not submitted; valid before the search has recorded it.
_BASELINE = "experiment-1"


class Desk(Protocol):
    """Submission server of a search. Every method raises UserError with the recommended action."""

    def submit(self, proposal: Proposal) -> Submission:
        """Hand in a candidate; its static errors are reported at once and cost no experiment."""
        ...

    def submission(self, ticket: str) -> Submission:
        """Return the state of a submission."""
        ...

    def withdraw(self, ticket: str) -> Submission:
        """Take a submission back that is still queued."""
        ...

    def results(self) -> tuple[ExperimentSummary, ...]:
        """Return all finished experiments."""
        ...

    def source(self, experiment: int) -> str:
        """An experiment's candidate.py."""
        ...

    def evidence(self, experiment: int) -> EvidenceSummary:
        """Return the evidence on a finished experiment besides its score."""
        ...

    def progress(self) -> SearchProgress:
        """Return the state of the search."""
        ...

    def attended(self) -> bool:
        """Return whether a process judges the submissions."""
        ...

    def simulated(self, experiment: int) -> SimulatedCases:
        """Some training cases of an experiment, simulated again; held-out ones too where the
        problem shows their residuals."""
        ...

    def dry_run(self, source: str) -> DryRunSummary:
        """Try a candidate on a short cut of training records: no experiment, no score."""
        ...


class RunDesk:
    """The desk of a run directory."""

    def __init__(self, directory: Path, keep_alive: Callable[[Path], None] | None = None) -> None:
        """keep_alive: called with the run directory where the search is needed and does not run."""
        self._directory = directory.resolve()
        self._queue = Queue(self._directory)
        self._keep_alive = keep_alive
        self._aside = threading.Lock()
        self._seen: tuple[tuple[int, ...], Run] | None = None

    def run(self) -> Run:
        """Return the run with the reported scores, read again if its ledger has changed. A search
        that never began is started first.

        Raises:
            UserError: as `open_run`.
        """
        ledger = self._directory / "ledger.jsonl"
        if self._keep_alive is not None and not has_begun(self._directory):
            self._keep_alive(self._directory)
        if not ledger.is_file():
            return open_run(self._directory)
        stat = ledger.stat()
        timestamp = (stat.st_ino, stat.st_size, stat.st_mtime_ns)
        seen = self._seen
        if seen is None or seen[0] != timestamp:
            run = open_run(self._directory)
            seen = (timestamp, replace(run, view=published(run.view)))
            self._seen = seen
        return seen[1]

    def submit(self, proposal: Proposal) -> Submission:
        """See `Desk.submit`; the same source, comments apart, is one submission, unless its result
        depended on how fast the machine was."""
        proposal = tidy(proposal)
        try:
            check_source(proposal.source)
        except CandidateError as error:
            raise UserError(
                f"the candidate was not submitted and cost no experiment: {error.reason.advice}"
                + (f" ({one_line(error.detail)})" if error.detail else "")
            ) from None
        self.run()
        with self._queue.alone():
            known = self._known(digest(proposal.source))
            if known is None:
                ticket = self._put(proposal)
            elif known.state == "done":
                return known
            else:
                ticket = known.ticket
        try:
            self.wake()
        except UserError as error:
            raise UserError(f"submission {ticket} is stored and was not judged: {error}") from None
        return replace(self.submission(ticket), repeated=known is not None)

    def _known(self, wanted: str) -> Submission | None:
        """Return the submission with this digest; None if it was not submitted before. The queue is
        read first: submissions that leave it are in the ledger by then.
        """
        for ticket in self._queue.tickets():
            waiting = self._queue.get(ticket)
            if waiting is not None and digest(waiting.source) == wanted:
                return Submission(ticket, "queued", repeated=True)
        experiments = self.run().view.experiments
        for experiment in experiments:
            settled = experiment.result is None or not experiment.result.deadline
            if settled and experiment.proposed.digest == wanted:
                return replace(_submission_of(experiment), repeated=True)
        if not experiments and wanted == _baseline_digest(self._directory):
            return Submission(_BASELINE, "queued", repeated=True)
        return None

    def _put(self, proposal: Proposal) -> str:
        waiting = self._queue.tickets()
        run = self.run()
        view, budget = run.view, _budget(self._directory, run)
        over = _over(self._directory, run)
        if over is not None:
            raise UserError(f"the candidate was not judged: {over}")
        in_ledger = {e.proposed.ticket for e in view.experiments}
        # The baseline is the first experiment and is not submitted.
        spent = max(1, len(view.experiments)) + sum(t not in in_ledger for t in waiting)
        if spent >= budget:
            raise UserError(
                f"the candidate was not evaluated: the budget of {budget} experiments is spent; "
                "the user can raise it with asia agent workspace or asia agent mcp and a larger "
                "--experiments"
            )
        numbers = {1, *(e.number for e in view.experiments)}
        if proposal.parent is not None and proposal.parent not in numbers:
            raise UserError(f"parent {proposal.parent}: expected an experiment of this search")
        return self._queue.put(proposal)

    def wake(self) -> None:
        """Start the search where it has something to do and is not there. Raises UserError when it
        does not start, or is over."""
        run = self.run()
        if not self._queue.tickets() and run.view.experiments and run.view.pending is None:
            return
        over = _over(self._directory, run)
        if over is not None:
            raise UserError(over)
        if self._keep_alive is None:
            return
        self._keep_alive(self._directory)
        view = self.run().view
        ended = view.complete and not runs(self._directory)
        if ended and view.stopped is not None and self._queue.tickets():
            raise UserError(
                f"the search has ended ({view.stopped.reason}); the user can raise its budget with "
                "asia agent workspace or asia agent mcp and a larger --experiments or --hours"
            )

    def submission(self, ticket: str) -> Submission:
        """See `Desk.submission`."""
        waiting = self._queue.tickets()
        for experiment in self.run().view.experiments:
            if ticket == _ticket_of(experiment):
                return _submission_of(experiment)
        if ticket in waiting:
            return Submission(ticket, "queued", waiting.index(ticket))
        if ticket == _BASELINE:
            return Submission(ticket, "queued")
        return Submission(ticket, "unknown")

    def withdraw(self, ticket: str) -> Submission:
        """See `Desk.withdraw`."""
        if self._queue.withdraw(ticket):
            return Submission(ticket, "withdrawn")
        state = self.submission(ticket).state
        text = "about to be evaluated" if state == "queued" else state
        raise UserError(
            f"submission {one_line(ticket, 60)} is {text}: only a queued one can be withdrawn"
        )

    def results(self) -> tuple[ExperimentSummary, ...]:
        """See `Desk.results`."""
        return tuple(summary_of(e) for e in self.run().view.finished)

    def source(self, experiment: int) -> str:
        """See `Desk.source`."""
        run = self.run()
        return run.store.text(run.view.experiment(experiment).proposed.source)

    def evidence(self, experiment: int) -> EvidenceSummary:
        """See `Desk.evidence`."""
        return evidence_summary(self.run(), experiment)

    def progress(self) -> SearchProgress:
        """See `Desk.progress`."""
        run = self.run()
        return progress_of(replace(run, busy=runs(self._directory)))

    def attended(self) -> bool:
        """See `Desk.attended`."""
        return attended(self._directory)

    def simulated(self, experiment: int) -> SimulatedCases:
        """See `Desk.simulated`; one at a time."""
        run = self.run()
        with self._beside_the_search():
            return simulated_excerpts(run, experiment)

    def dry_run(self, source: str) -> DryRunSummary:
        """See `Desk.dry_run`; one at a time."""
        run = self.run()
        with self._beside_the_search():
            return dry_run_summary(dry_run(run, source))

    @contextmanager
    def _beside_the_search(self) -> Generator[None]:
        """While workers run that no experiment asks for. Raises UserError where some run already,
        or the sandbox fails."""
        if not self._aside.acquire(blocking=False):
            raise UserError("a dry run or a picture is in progress: wait for its end")
        try:
            yield
        except SandboxError as error:
            raise UserError(f"the sandbox failed ({error}); try again") from None
        finally:
            self._aside.release()


def _ticket_of(experiment: Experiment) -> str:
    """Return the ticket of an experiment. Experiments that were not submitted, such as the
    baseline, have one too.
    """
    return experiment.proposed.ticket or f"experiment-{experiment.number}"


def _submission_of(experiment: Experiment) -> Submission:
    state: SubmissionState = "done" if experiment.result else "running"
    return Submission(_ticket_of(experiment), state, experiment=experiment.number)


def wait(desk: Desk, ticket: str, seconds: float, tick: Callable[[Submission], None]) -> Submission:
    """Wait for a submission until it is done or the time is over.

    Args:
        desk: the submission server.
        ticket: identifier of the submission.
        seconds: maximum waiting time, s.
        tick: called at every poll.

    Raises:
        UserError: no search is running to judge the submission.
    """
    end = time.monotonic() + seconds
    while True:
        there = desk.attended()  # before the submission, so that a last result is not lost
        submission = desk.submission(ticket)
        tick(submission)
        if submission.state in ("done", "unknown") or time.monotonic() >= end:
            return submission
        if not there:
            when = "while" if submission.state == "running" else "before"
            raise UserError(
                f"the process of the search ended {when} it evaluated the candidate. The "
                "candidate is stored: repeat the command (control/search.log of the run "
                "may show why)"
            )
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


def _over(directory: Path, run: Run) -> str | None:
    """Why nothing can be handed in any more, budget of experiments aside."""
    view = run.view
    if view.unsealing is not None:
        return "the sealed test of this run was opened: its search cannot continue"
    if view.stopped is None:
        return None
    stop = max(line.seq for line in run.lines if isinstance(line.event, Stopped))
    request = SearchRequest.find(directory)
    again = request is not None and request.records > stop
    if view.stopped.reason == "user" and not again:
        return "the user stopped this search; repeat the command that started it to resume"
    return None


def _baseline_digest(directory: Path) -> str | None:
    """Return the digest of the baseline; None if no request names its problem."""
    request = SearchRequest.find(directory)
    return None if request is None else digest(requested_problem(request).baseline or LINEAR)


def _budget(directory: Path, run: Run) -> int:
    """Experiments in all, in a relay up to the turn of the next agent; a larger request counts
    before the search has seen it."""
    request = SearchRequest.find(directory)
    requested = request.experiments if request is not None else None
    return max(run.view.leg_end, requested or 0)
