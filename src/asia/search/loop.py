"""Search loop: propose, evaluate, keep or discard, stop."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from asia._diagnostic import diagnostic
from asia._timer import Activity, ActivityTimer
from asia.agents.view import (
    Agent,
    AgentStoppedError,
    Attached,
    Closing,
    InterruptedWaitError,
    Proposal,
)
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.evaluation.references import score_references
from asia.judge.scoring.outcome import explained_variance, folds_below
from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain
from asia.ledger.events import (
    Evaluated,
    Event,
    Exchanged,
    GuardLooked,
    Landed,
    Proposed,
    ReferenceScored,
    Refitted,
    Steered,
    Stopped,
)
from asia.ledger.index import refresh
from asia.ledger.view import Experiment, SearchView
from asia.presentation.exports import write_exports
from asia.problem.obstacles import obstacle
from asia.problem.problem import Problem
from asia.search.agent_views import KnownTrials, agent_view, as_bytes, digest, problem_facts
from asia.search.decision import decide
from asia.search.final import refit_best
from asia.search.guard import Gate
from asia.search.pending import PendingFits, keep_outcome, keep_output, keep_source
from asia.search.rules import stop_reason
from asia.search.steering import Steering

# Propose, evaluate, keep or discard, each step written to the ledger, until a stop rule holds.
#
# With `parallel` experiments in flight, each is proposed once all but the last `parallel` - 1
# before it have their results, and results are decided and recorded in the order of proposal. So
# the course of a search does not depend on which fit ends first.
#
# All the loop knows is in the ledger: killed anywhere, the same call goes on from there.


OnEvent = Callable[[Event, SearchView], None]

_PAUSE_POLL = 0.2


@dataclass(frozen=True)
class Loop:
    """Loop of one search: proposals, evaluations, decisions and their records."""

    problem: Problem
    baseline: str
    """Source of the first experiment."""
    agent: Agent
    """Agent that proposes all candidates after the baseline."""
    evaluator: Evaluator
    chain: Chain
    """The ledger, open for writing."""
    store: Store
    directory: Path
    """The directory of the run."""
    on_event: OnEvent
    """Called with every event once it is written."""
    _lock: threading.RLock = field(default_factory=threading.RLock, repr=False)
    _failed: list[str] = field(default_factory=list[str], repr=False)
    """Lines of the diagnostic boundary that no event has yet."""

    @property
    def watch(self) -> ActivityTimer:
        """Profile of the search."""
        return self.evaluator.workers.stopwatch

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
    def pending_fits(self) -> PendingFits:
        """The first fits under way."""
        return PendingFits(self.view.started.parallel, self.evaluator, self.store, self._completed)

    @cached_property
    def gate(self) -> Gate:
        """Confirmation of new bests."""
        return Gate(self.problem, self.evaluator, self.store)

    @cached_property
    def known_trials(self) -> KnownTrials:
        """Trials that agents were shown so far."""
        return KnownTrials(self.store)

    def run(self) -> SearchView:
        """References, search, refit, guard; what the ledger already holds is not redone."""
        if self.view.complete or self.view.unsealing:
            return self.view
        if isinstance(self.agent, Attached):
            self.agent.attach(LoopJournal(self))
        try:
            self._search()
        finally:
            self.pending_fits.close()
            if isinstance(self.agent, Closing):
                self.agent.leaving()
        return self.view

    def _search(self) -> None:
        metric = self.problem.protocol.metric
        names = {reference.name for reference in self.view.references}
        with self.watch.activity(Activity.REFERENCES, swallows=True):
            for reference in score_references(self.evaluator, metric, self.problem.truth, names):
                folds = tuple(fold.score for fold in reference.outcome.folds)
                self.record(
                    ReferenceScored(
                        reference.name,
                        replace(reference.outcome, folds=folds),
                        reference.failed_checks,
                        source=reference.source,
                    )
                )
        while self.view.stopped is None:
            stopped = self._advance()
            if stopped is not None:
                self.record(stopped)
                if isinstance(self.agent, Closing):
                    self.agent.stopped(stopped.reason)
        best = self.view.best
        if self.view.refitted is None and best is not None:
            with self.watch.activity(Activity.REFIT, swallows=True):
                refitted = refit_best(
                    self.problem, self.evaluator, self.view, best, self.store, metric, self.gate
                )
                assert best.score is not None
                is_model = self.problem.control is None
                if is_model and folds_below(explained_variance(best.score), 0.0):
                    facts, value = problem_facts(self.problem), best.score.value
                    lowest = f" (best V {value:.3g} of #{best.number:02d})"
                    cause = obstacle(facts.records, facts.horizon, facts.past, lowest)
                    refitted = replace(refitted, cause=cause)
            self.record(refitted)
        if self.view.guard_due:
            with self.watch.activity(Activity.GUARD, swallows=True):
                look = self.gate.look(self.view)
            self.record(look)
        self.steering.record_noted(self.record)

    def record(self, event: Event) -> None:
        """Append to the ledger, rewrite the generated files, tell the listener. From any thread."""
        with self._lock, self.watch.activity(Activity.LEDGER):
            if isinstance(event, Evaluated | Refitted | GuardLooked):
                event = replace(event, spent=self.watch.take())
            if isinstance(event, ReferenceScored | Evaluated | Refitted) and self._failed:
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
        """Take the requests of the user, then propose a candidate if the budget allows another
        experiment, else take the oldest result.

        With results outstanding, the agent is asked again after each of them. Return why the search
        ends once the user stops it or nothing is left to propose or to await.
        """
        for path, text in self.steering.notes():
            self.record(Steered(text))
            path.unlink()
        self.steering.record_noted(self.record)
        if self.steering.take_stop():
            # None of the pending evaluations is lost.
            while self.pending_fits.any:
                self._settle()
            return Stopped("user")
        if self.steering.paused:
            with self.watch.activity(Activity.IDLE):
                time.sleep(_PAUSE_POLL)
            return None
        try:
            self.pending_fits.launch(self.view)
            if self._has_room:
                ended = self._propose()
                if ended is not None and self.view.pending is None:
                    return ended
                if ended is None:
                    self.pending_fits.launch(self.view)
                    if self._has_room:
                        return None
            self._settle()
        except InterruptedWaitError:
            pass
        return None

    @property
    def _has_room(self) -> bool:
        view = self.view
        return len(view.running) < view.started.parallel

    def _propose(self) -> Stopped | None:
        """Propose one experiment; return why there is none."""
        view = self.view
        reason = stop_reason(view, self.problem.budget)
        if reason is not None:
            return Stopped(reason)
        try:
            with self.watch.activity(Activity.AGENT):
                if not view.experiments:
                    phase, proposal = "baseline", _baseline(self.baseline)
                else:
                    facts = problem_facts(self.problem)
                    shown = agent_view(facts, self.view, self.store, self.known_trials)
                    phase, proposal = shown.phase, self.agent.propose(shown)
                if proposal is None:
                    return Stopped("exhausted")
                source = self.store.put(as_bytes(proposal.source))
        except AgentStoppedError as end:
            return Stopped(end.reason, end.detail)
        # The agent may have waited: the view is that of now.
        view = self.view
        self.record(
            Proposed(
                experiment=len(view.experiments) + 1,
                parent=proposal.parent,
                phase=phase,
                family=proposal.family,
                title=proposal.title,
                hypothesis=proposal.hypothesis,
                expected=proposal.expected,
                source=source,
                digest=digest(proposal.source),
                ticket=proposal.ticket,
                remark=proposal.remark,
                fair=proposal.fair,
                agent=proposal.agent,
            )
        )
        return None

    def _settle(self) -> None:
        """The result of the oldest experiment without one."""
        pending = self.view.pending
        assert pending is not None
        self.record(self._evaluate(pending))

    def _completed(self, landed: Landed) -> None:
        """Write down a first fit whose turn has not come; the oldest will have its result now."""
        with self._lock:
            oldest = self.view.pending
            if oldest is not None and oldest.number != landed.experiment:
                self.record(landed)

    def _evaluate(self, experiment: Experiment) -> Evaluated:
        view, proposed = self.view, experiment.proposed
        for twin in view.finished:
            known = twin.result
            if twin.proposed.digest == proposed.digest and known and not known.deadline:
                return Evaluated(
                    experiment=experiment.number,
                    status="discard" if known.status == "keep" else known.status,
                    outcome=known.outcome,
                    output=known.output,
                    seconds=0.0,
                    duplicate_of=twin.number,
                    isolation=known.isolation,
                    variants=known.variants,
                    source=known.source,
                )
        start, before = time.monotonic(), len(self.evaluator.workers.left_behind)
        fitted = self.pending_fits.take(experiment)
        begin = time.monotonic()
        if fitted is not None:
            self.watch.waited(fitted.lane, begin - start)
        first = None if fitted is None else fitted.tried
        source = self.store.text(proposed.source)
        decision = decide(
            self.evaluator, source, view, first, proposed, self.gate.confirm, self.store
        )
        evaluation = decision.evaluation
        with self.watch.activity(Activity.LEDGER):
            outcome = keep_outcome(self.store, evaluation)
            output = keep_output(self.store, evaluation.output)
            scored = keep_source(self.store, decision.tried, proposed)
        now = time.monotonic()
        return Evaluated(
            experiment=experiment.number,
            status=decision.status,
            outcome=outcome,
            output=output,
            seconds=now - begin + (0.0 if fitted is None else fitted.seconds),
            deadline=decision.deadline,
            validation_scores=decision.validation_scores,
            isolation=self.evaluator.workers.isolation.value,
            left_behind=tuple(self.evaluator.workers.left_behind[before:]),
            retests=decision.retests,
            threshold=decision.threshold,
            lowest=decision.lowest,
            elapsed=None if view.started.parallel == 1 else now - start,
            failed_checks=evaluation.failed_checks,
            confirmation=decision.confirmation,
            variants=decision.tried.variants,
            source=scored,
        )


@dataclass(frozen=True)
class LoopJournal:
    """The ledger as an attached agent may use it."""

    loop: Loop

    @property
    def exchanges(self) -> tuple[Exchanged, ...]:
        """Exchanges so far."""
        return self.loop.view.exchanges

    @property
    def experiments(self) -> int:
        """Candidates proposed so far."""
        return len(self.loop.view.experiments)

    def record(self, event: Event) -> None:
        """Append an event."""
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
        hypothesis="Every search starts with the unchanged baseline of the problem.",
        expected="A V to compare the other candidates with.",
    )
