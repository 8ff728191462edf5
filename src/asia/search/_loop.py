"""Propose, evaluate, keep or discard, each step written to the ledger, until a stop rule holds.

With `parallel` experiments in flight, each is proposed once all but the last `parallel` - 1 before
it have their results, and results are decided and recorded in the order of proposal. So the course
of a search does not depend on which fit ends first.

All the loop knows is in the ledger: killed anywhere, the same call goes on from there.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from asia._boundary import diagnostic
from asia._stopwatch import Activity, Stopwatch
from asia.agents import (
    Agent,
    AgentStoppedError,
    Attached,
    Closing,
    InterruptedWaitError,
    Proposal,
    agent_of_leg,
)
from asia.evaluation import Evaluator, score_rungs
from asia.ledger import (
    Chain,
    Evaluated,
    Event,
    Exchanged,
    Experiment,
    GuardLooked,
    Landed,
    Phase,
    Proposed,
    Refitted,
    RungScored,
    SearchView,
    SessionEnded,
    SessionStarted,
    Steered,
    Stopped,
    Store,
    refresh,
    write_exports,
)
from asia.problem.load import Problem
from asia.search._agent_view import (
    KnownTrials,
    agent_view,
    as_bytes,
    digest,
    problem_facts,
)
from asia.search._guard import look_at_guard
from asia.search._steering import Steering
from asia.search.ahead.flights import Flights
from asia.search.ahead.landed import keep_folds, keep_output
from asia.search.deciding.judging import judge
from asia.search.deciding.rules import bound_on_folds, next_leg, stop_reason
from asia.search.final.ending import refit_winner

OnEvent = Callable[[Event, SearchView], None]

_PAUSE_POLL = 0.2


@dataclass(frozen=True)
class Loop:
    """Loop of one search: proposals, evaluations, decisions and their records."""

    problem: Problem
    """Problem to solve."""
    baseline: str
    """Source of the first experiment."""
    agent: Agent
    """Agent that proposes all candidates after the baseline; in a relay, several in sequence."""
    evaluator: Evaluator
    """Evaluator that fits and scores the candidates."""
    chain: Chain
    """The ledger, open for writing."""
    store: Store
    """Store of sources, models and predictions."""
    directory: Path
    """The directory of the run."""
    on_event: OnEvent
    """Called with every event once it is written."""
    _lock: threading.RLock = field(default_factory=threading.RLock, repr=False)
    _failed: list[str] = field(default_factory=list[str], repr=False)
    """Lines of the diagnostic boundary that no event has yet."""

    @property
    def watch(self) -> Stopwatch:
        """Profile of the search."""
        return self.evaluator.stopwatch

    @property
    def steering(self) -> Steering:
        """Requests of the user during the search."""
        return Steering(self.directory)

    @property
    def view(self) -> SearchView:
        """The ledger replayed."""
        with self._lock:
            return self.chain.view

    @cached_property
    def flights(self) -> Flights:
        """The first fits under way."""
        return Flights(self.view.started.parallel, self.evaluator, self.store, self._completed)

    @cached_property
    def known_trials(self) -> KnownTrials:
        """Trials that agents were shown so far."""
        return KnownTrials(self.store)

    def run(self) -> SearchView:
        """Rungs, search, refit of the winner, a look at the guard. What the ledger already holds is
        not redone."""
        if self.view.complete or self.view.unsealing:
            return self.view
        self._attach()
        try:
            self._search()
        finally:
            self.flights.close()
            if isinstance(self._proposer, Closing):
                self._proposer.leaving()
        return self.view

    @property
    def _proposer(self) -> Agent:
        """Agent whose turn it is to propose."""
        return agent_of_leg(self.agent, self.view.leg)

    def _attach(self) -> None:
        if isinstance(self._proposer, Attached):
            self._proposer.attach(LoopJournal(self, self.view.leg))

    def _search(self) -> None:
        self._score_references()
        while self.view.stopped is None:
            stopped = self._advance()
            if stopped is not None:
                self._end(stopped)
        if self.view.refitted is None:
            self._refit()
        if self.view.guard_due:
            with self.watch.activity(Activity.GUARD, swallows=True):
                look = look_at_guard(self.problem, self.evaluator, self.store, self.view)
            self.record(look)

    def _end(self, stopped: Stopped) -> None:
        """The end of the search, or of the leg of a relay that another one follows."""
        proposer = self._proposer
        following = next_leg(self.view, stopped)
        if following is None:
            self.record(stopped)
        if isinstance(proposer, Closing):
            proposer.stopped(stopped.reason)
        if following is not None:
            if isinstance(proposer, Closing):
                proposer.leaving()
            self.record(following)
            self._attach()

    def record(self, event: Event) -> None:
        """Append to the ledger, rewrite the generated files, tell the listener. From any thread."""
        with self._lock, self.watch.activity(Activity.LEDGER):
            if isinstance(event, Evaluated | Refitted | GuardLooked):
                event = replace(event, spent=self.watch.take())
            if isinstance(event, RungScored | Evaluated | Refitted) and self._failed:
                event = replace(event, failed_checks=(*event.failed_checks, *self._failed))
                self._failed.clear()
            self.chain.append(event)
            view = self.view
            if isinstance(event, Evaluated):
                with diagnostic("results.tsv and search_journal.md", self._failed):
                    write_exports(self.directory, view)
                refresh(self.directory)
            self.on_event(event, view)

    def _advance(self) -> Stopped | None:
        """Run one experiment, unless the user pauses or stops the search or the agent ends it."""
        for path, text in self.steering.notes():
            self.record(Steered(text))
            path.unlink()
        if self.steering.take_stop():
            self._settle_begun()
            return Stopped("user")
        if self.steering.paused:
            with self.watch.activity(Activity.IDLE):
                time.sleep(_PAUSE_POLL)
            return None
        try:
            return self._step()
        except InterruptedWaitError:
            return None

    def _score_references(self) -> None:
        names = {reference.name for reference in self.view.rungs}
        problem = self.problem
        with self.watch.activity(Activity.RUNGS, swallows=True):
            for reference in score_rungs(
                self.evaluator, problem.protocol.metric, problem.truth, names
            ):
                self.record(RungScored(reference.name, reference.outcome, reference.failed_checks))

    def _step(self) -> Stopped | None:
        """Propose a candidate if the budget allows another experiment, else take the oldest result.

        With results outstanding, the agent is asked again after each of them.

        Returns:
            The stop reason once nothing is left to propose or to await, else None.
        """
        self.flights.launch(self.view)
        if self._has_room:
            ended = self._ask()
            if ended is None:
                self.flights.launch(self.view)
                if self._has_room:
                    return None
            elif self.view.pending is None:
                return ended
        self._settle()
        return None

    @property
    def _has_room(self) -> bool:
        view = self.view
        return len(view.running) < view.started.parallel

    def _ask(self) -> Stopped | None:
        """Propose one experiment; why there is none."""
        view = self.view
        reason = stop_reason(view, self.problem.budget)
        if reason is not None:
            return Stopped(reason)
        try:
            with self.watch.activity(Activity.AGENT):
                proposed = self._propose(view)
        except AgentStoppedError as end:
            return Stopped(end.reason, end.detail)
        if proposed is None:
            return Stopped("exhausted")
        self.record(proposed)
        return None

    def _settle(self) -> None:
        """The result of the oldest experiment without one."""
        pending = self.view.pending
        assert pending is not None
        self.record(self._evaluate(pending))

    def _settle_begun(self) -> None:
        """Take the results of all pending evaluations, so that none is lost when the user stops the
        search.
        """
        while self.flights.any:
            self._settle()

    def _completed(self, landed: Landed) -> None:
        """Write down a first fit whose turn has not come; the oldest will have its result now."""
        with self._lock:
            oldest = self.view.pending
            if oldest is not None and oldest.number != landed.experiment:
                self.record(landed)

    def _propose(self, view: SearchView) -> Proposed | None:
        if not view.experiments:
            return replace(self._proposed(1, "baseline", _baseline(self.baseline)), agent="")
        seen = agent_view(problem_facts(self.problem), view, self.store, self.known_trials)
        proposal = self._proposer.propose(seen)
        if proposal is None:
            return None
        return self._proposed(len(view.experiments) + 1, seen.phase, proposal)

    def _proposed(self, number: int, phase: Phase, proposal: Proposal) -> Proposed:
        return Proposed(
            experiment=number,
            parent=proposal.parent,
            phase=phase,
            family=proposal.family,
            title=proposal.title,
            hypothesis=proposal.hypothesis,
            expected=proposal.expected,
            source=self.store.put(as_bytes(proposal.source)),
            digest=digest(proposal.source),
            ticket=proposal.ticket,
            leg=self.view.leg,
            agent=self.view.agent if self.view.leg else "",
            remark=proposal.remark,
            over=bound_on_folds(self.view),
        )

    def _evaluate(self, experiment: Experiment) -> Evaluated:
        view = self.view
        for twin in view.finished:
            settled = twin.result is not None and not twin.result.deadline
            if settled and twin.proposed.digest == experiment.proposed.digest:
                return _outcome_of_twin(experiment, twin)
        start, before = time.monotonic(), len(self.evaluator.left_behind)
        flown = self.flights.take(experiment)
        begin = time.monotonic()
        if flown is not None:
            self.watch.waited(flown.lane, begin - start)
        first = None if flown is None else flown.evaluation
        proposed = experiment.proposed
        source = self.store.text(proposed.source)
        judged = judge(self.evaluator, source, view, first, proposed.over)
        evaluation = judged.evaluation
        with self.watch.activity(Activity.LEDGER):
            folds = keep_folds(self.store, evaluation.folds)
            output = keep_output(self.store, evaluation.output)
        now = time.monotonic()
        return Evaluated(
            experiment=experiment.number,
            status=judged.status,
            outcome=evaluation.outcome,
            folds=folds,
            output=output,
            seconds=now - begin + (0.0 if flown is None else flown.seconds),
            deadline=judged.deadline,
            validation_scores=judged.validation_scores,
            isolation=self.evaluator.isolation.value,
            left_behind=tuple(self.evaluator.left_behind[before:]),
            retests=judged.retests,
            floor=judged.floor,
            lowest=judged.lowest,
            elapsed=None if view.started.parallel == 1 else now - start,
            ended_folds=evaluation.ended_folds,
            failed_checks=evaluation.failed_checks,
        )

    def _refit(self) -> None:
        best = self.view.best
        if best is None:
            return
        with self.watch.activity(Activity.REFIT, swallows=True):
            refitted = refit_winner(
                self.evaluator, self.view, best, self.store, self.problem.protocol.metric
            )
        self.record(refitted)


@dataclass(frozen=True)
class LoopJournal:
    """The ledger as an attached agent may use it."""

    loop: Loop
    """The search."""
    leg: int = 0
    """The leg whose agent keeps it; 0 where one agent proposes."""

    @property
    def exchanges(self) -> tuple[Exchanged, ...]:
        """Exchanges of this leg so far."""
        return tuple(e for e in self.loop.view.exchanges if e.leg == self.leg)

    @property
    def experiments(self) -> int:
        """Candidates proposed so far."""
        return len(self.loop.view.experiments)

    def record(self, event: Event) -> None:
        """Append an event, with the leg where it is one of an agent."""
        if isinstance(event, Exchanged | SessionStarted | SessionEnded):
            event = replace(event, leg=self.leg)
        self.loop.record(event)

    def put(self, data: bytes) -> str:
        """Keep bytes."""
        return self.loop.store.put(data)

    def get(self, name: str) -> bytes:
        """Bytes kept earlier."""
        return self.loop.store.get(name)

    def interrupted(self) -> bool:
        """Return whether a request of the user is waiting."""
        return self.loop.steering.waiting


def _baseline(source: str) -> Proposal:
    return Proposal(
        source=source,
        family="baseline",
        title="baseline",
        hypothesis="The problem's own baseline, untouched, is where every search starts.",
        expected="A reference value that the rest must beat.",
    )


def _outcome_of_twin(experiment: Experiment, twin: Experiment) -> Evaluated:
    """Return the outcome of the earlier experiment with the same normalised source."""
    r = twin.result
    assert r is not None
    status = "discard" if r.status == "keep" else r.status
    return Evaluated(
        experiment.number,
        status,
        r.outcome,
        r.folds,
        r.output,
        0.0,
        duplicate_of=twin.number,
        isolation=r.isolation,
    )
