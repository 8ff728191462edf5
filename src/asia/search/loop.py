"""Search loop: propose, evaluate, keep or discard, stop."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from statistics import fmean

from asia._diagnostic import diagnostic
from asia._timer import Activity, ActivityTimer
from asia.agents.relay import agent_of_leg
from asia.agents.view import (
    Agent,
    AgentStoppedError,
    Attached,
    Closing,
    InterruptedWaitError,
    Proposal,
)
from asia.judge.evaluation.background import BackgroundJob, JobSettings
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.evaluation.references import score_references
from asia.judge.evaluation.results import Evaluation, FoldResult, same_simulations
from asia.judge.scoring.confirmation import least_significant_difference
from asia.judge.scoring.outcome import Failure, Score
from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain
from asia.ledger.events import (
    Evaluated,
    Event,
    Exchanged,
    GuardLooked,
    Landed,
    Phase,
    Proposed,
    Refitted,
    Retest,
    RungScored,
    SessionEnded,
    SessionStarted,
    Status,
    Steered,
    Stopped,
)
from asia.ledger.exports import write_exports
from asia.ledger.index import refresh
from asia.ledger.view import Experiment, SearchView
from asia.problem.problem import Problem
from asia.search.agent_views import KnownTrials, agent_view, as_bytes, digest, problem_facts
from asia.search.final import refit_winner
from asia.search.guard import look_at_guard
from asia.search.pending import PendingFits, keep_folds, keep_output
from asia.search.rules import bound_on_folds, decide, next_leg, stop_reason
from asia.search.steering import Steering

# The fits of a candidate from other seeds, the next one begun where workers are free.


@contextmanager
def retest_fits(
    evaluator: Evaluator, fit: Callable[[int], Evaluation], most: int
) -> Generator[Callable[[int], Evaluation]]:
    """Prefetch fits: yield a function that returns the results of `fit(0)`, `fit(1)`, ... in order.

    Once all folds of one fit have started, the next fit begins; an unused one is cancelled. The
    results do not depend on that.

    Args:
        evaluator: the evaluator of the fits.
        fit: function that fits with a repeat number.
        most: maximum number of fits.
    """
    if not evaluator.may_fit_ahead:
        yield fit
        return
    with ExitStack() as opened:
        yield _RetestFits(evaluator, fit, most, opened).take


class _RetestFits:
    def __init__(
        self,
        evaluator: Evaluator,
        fit: Callable[[int], Evaluation],
        most: int,
        opened: ExitStack,
    ) -> None:
        self._evaluator, self._fit, self._most, self._opened = evaluator, fit, most, opened
        self._begun: list[_Begun] = []
        self._fits: list[BackgroundJob[Evaluation]] = []

    def take(self, number: int) -> Evaluation:
        for following in range(len(self._fits), min(number + 2, self._most)):
            self._begin(following)
        return self._fits[number].result()

    def _begin(self, number: int) -> None:
        before = self._begun[-1] if self._begun else None
        mine = _Begun(len(self._evaluator.data.folds))
        self._begun.append(mine)

        def fit() -> Evaluation:
            if before is not None:
                before.all.wait()
            try:
                return self._fit(number)
            finally:
                mine.all.set()

        job = self._evaluator.workers.background(fit, JobSettings(on_begin=mine.one))
        self._fits.append(self._opened.enter_context(job))


class _Begun:
    """Counter of the folds of a fit that have started."""

    def __init__(self, folds: int) -> None:
        self.all = threading.Event()
        self._left, self._lock = folds, threading.Lock()

    def one(self) -> None:
        """Count one more fold."""
        with self._lock:
            self._left -= 1
            if self._left <= 0:
                self.all.set()


# Fit, score and decide on one candidate.
#
# A candidate about to become the incumbent is fitted again from other seeds. It takes the title
# where its mean over the seeds is lower than the incumbent's by the floor. That is a statement on
# its method. Its first fit is a model by itself: where its V is the lowest so far, it is the one
# to hand over, whatever is said of the method.


_FIRST_SEED = 1_000_000
"""The number of the first seed of retests: those of `asia validate --repeat` count from 1, and
a seed that chose a winner must not confirm it too."""
_WORTH_A_RETEST = 0.5
"""The share of the floor by which a first fit must be lower: with less, two more fits make a
new best very unlikely."""

_NARROW = 0.1
"""The largest floor, over the mean, that an incumbent fitted from fewer seeds may leave: a wide one
would keep better candidates out."""


@dataclass(frozen=True)
class Judged:
    """A candidate and the decision on it."""

    evaluation: Evaluation
    """Its first fit, or why there is no score."""
    status: Status
    """The decision."""
    retests: tuple[Retest, ...] = ()
    """Its fits from other seeds."""
    floor: float | None = None
    """Significance threshold: required improvement of the mean over seeds; None without an
    incumbent, or if one fit decides.
    """
    deadline: bool = False
    """True if the speed of the machine influenced the decision."""
    validation_scores: int = 0
    """Validation scores given in all fits."""
    lowest: bool = False
    """True if the candidate's own fit is the best so far; its model is handed over until another is
    lower.
    """


@dataclass(frozen=True)
class _Decision:
    """Decision from the fits with several seeds."""

    status: Status
    retests: tuple[Retest, ...] = ()
    floor: float | None = None
    deadline: bool = False
    validation_scores: int = 0


def judge(
    evaluator: Evaluator,
    source: str,
    view: SearchView,
    evaluation: Evaluation | None = None,
    over: float | None = None,
) -> Judged:
    """Evaluate and decide, by the rule that the ledger names. A candidate that would be kept, or
    handed over, must also come back bitwise the same from its bytes, and answer like a model. With
    the Ladder every candidate with a score must: otherwise the check, and the time it takes, would
    say which one is kept. After an objection the folds stay. evaluation: where its first fit was
    made before; over: as in `Proposed`."""
    if evaluation is None:
        evaluation = evaluator.evaluate(source, over=over)
    asked = evaluation.validation_scores
    if isinstance(evaluation.outcome, Failure):
        status = evaluation.outcome.reason.status
        return Judged(evaluation, status, (), None, status == "timeout", asked)
    folds, answers = evaluation.folds, None
    lowest = view.started.retests > 0 and _is_best(evaluation.outcome, view)
    with ExitStack() as opened:
        if lowest and not evaluator.workers.is_sequential:
            # It is checked whatever the retests say.
            check = partial(evaluator.objection_to_answers, source, folds)
            answers = opened.enter_context(evaluator.workers.background(check))
        if view.started.retests:
            found = _Retesting(evaluator, source, evaluation, evaluation.outcome, view).decide()
        else:
            found = _Decision(decide(evaluation.outcome, view))
        status = found.status
        if lowest and status == "discard":
            # From other seeds its method is no better. Its own fit is.
            status = "inconclusive"
        if status == "keep" or lowest or view.started.ladder is not None:
            failure = _objection(evaluator, source, folds, answers)
            if failure is not None:
                evaluation = replace(evaluation, outcome=failure)
                status, lowest = failure.reason.status, False
    deadline = found.deadline or status == "timeout"
    asked += found.validation_scores
    return Judged(evaluation, status, found.retests, found.floor, deadline, asked, lowest)


def _objection(
    evaluator: Evaluator,
    source: str,
    folds: Sequence[FoldResult],
    answers: BackgroundJob[Failure | None] | None,
) -> Failure | None:
    """answers: the part of the checks that has been begun."""
    if answers is None:
        return evaluator.objection(source, folds)
    return answers.result() or evaluator.objection_to_consistency(source, folds)


@dataclass(frozen=True)
class _Retesting:
    """Repeated fits of a candidate with a score, compared with the incumbent."""

    evaluator: Evaluator
    source: str
    first: Evaluation
    score: Score
    view: SearchView

    def decide(self) -> _Decision:
        """`discard` where it is not lower than the incumbent, `inconclusive` where it is, but not
        by the floor. Each as soon as it is certain enough, so most candidates cost no fit
        more."""
        held = self.view.incumbent
        if held is None:
            # Nothing to beat; its spread is the first floor.
            return replace(self._repeat(()), status="keep")
        known = held.seed_values
        floor, lead = least_significant_difference(known, known), fmean(known) - self.score.value
        if lead <= 0.0:
            return _Decision("discard", floor=floor)
        if lead < _WORTH_A_RETEST * floor:
            return _Decision("inconclusive", floor=floor)
        return self._repeat(known)

    def _repeat(self, known: Sequence[float]) -> _Decision:
        """Fit from other seeds until the decision is clear, or there are no more."""
        most = self.view.started.retests
        with retest_fits(self.evaluator, self._fit, most) as fit:
            return self._decided(known, fit, most)

    def _fit(self, number: int) -> Evaluation:
        return self.evaluator.evaluate(self.source, _FIRST_SEED + number)

    def _decided(
        self, known: Sequence[float], fit: Callable[[int], Evaluation], most: int
    ) -> _Decision:
        retests: list[Retest] = []
        values, asked, timed_out, failed = [self.score.value], 0, False, False
        for number in range(most):
            begin = time.monotonic()
            again = fit(number)
            seconds = time.monotonic() - begin
            asked += again.validation_scores
            outcome = again.outcome
            if isinstance(outcome, Failure):
                retests.append(Retest(failed=outcome.reason.value, seconds=seconds))
                timed_out, failed = outcome.reason.status == "timeout", True
                break
            same = same_simulations(self.first.y_hats, again.y_hats)
            folds = tuple(fold.value for fold in outcome.folds)
            retests.append(Retest(outcome.value, folds, same=same, seconds=seconds))
            if same:
                # One fit shows it: the others would be the same.
                break
            values.append(outcome.value)
            higher = fmean(values) >= fmean(known) if known else False
            if higher or (known and _is_lower(values, known) and _is_narrow(values)):
                break
        status, floor = _decision(values, known, failed=failed)
        return _Decision(status, tuple(retests), floor, timed_out, asked)


def _is_best(score: Score, view: SearchView) -> bool:
    best = view.best.score if view.best else None
    return best is None or score.value < best.value


def _decision(
    values: Sequence[float], known: Sequence[float], *, failed: bool
) -> tuple[Status, float | None]:
    if not known:
        return "keep", None
    floor = least_significant_difference(values, known)
    if fmean(values) >= fmean(known):
        return "discard", floor
    return "keep" if not failed and _is_lower(values, known) else "inconclusive", floor


def _is_lower(values: Sequence[float], known: Sequence[float]) -> bool:
    """Return whether the mean is lower by more than the threshold, or by any amount if neither
    depends on the seed.
    """
    return fmean(known) - fmean(values) > least_significant_difference(values, known)


def _is_narrow(values: Sequence[float]) -> bool:
    """Return whether these seeds suffice for an incumbent: the threshold that they give is
    small.
    """
    return least_significant_difference(values, values) <= _NARROW * fmean(values)


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
    def flights(self) -> PendingFits:
        """The first fits under way."""
        return PendingFits(self.view.started.parallel, self.evaluator, self.store, self._completed)

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
            for reference in score_references(
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
        start, before = time.monotonic(), len(self.evaluator.workers.left_behind)
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
            isolation=self.evaluator.workers.isolation.value,
            left_behind=tuple(self.evaluator.workers.left_behind[before:]),
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
