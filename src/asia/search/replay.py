"""A search again from its ledger, with no network: the agent is asked again with the same view, its
candidates are evaluated again, and all is compared with what was recorded."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

from asia._progress import tracked
from asia.agents.registry import COMPANION, recorded_agent
from asia.agents.view import Agent, AgentStoppedError, AgentView, Attached, DivergedError
from asia.errors import InternalError, UserError
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.evaluation.references import first_source, score_references
from asia.judge.sandbox.types import Isolation
from asia.judge.scoring.outcome import Failure, Outcome, Score
from asia.ledger.artifacts import Store, without_artifacts
from asia.ledger.events import (
    Evaluated,
    Event,
    Exchanged,
    Proposed,
    ReferenceScored,
    Status,
    Stopped,
)
from asia.ledger.run import Run, open_run
from asia.ledger.verification import check_lock
from asia.ledger.view import SearchView, replay
from asia.problem.load import load_lock
from asia.problem.problem import Problem
from asia.search.agent_views import agent_view, as_bytes, problem_facts
from asia.search.decision import decide
from asia.search.guard import Gate
from asia.search.run import (
    LOCK,
    environment,
    environment_changes,
    level_here,
    make_evaluator,
)

OutcomeAgreement = Literal["same", "close", "differs", "exempt", "unfinished"]
ProposalAgreement = Literal["same", "differs", "taken", "none"]


@dataclass(frozen=True)
class Replayed:
    """Replay of one experiment, reference model or stop."""

    name: str
    """Name of the step, for example `#07` or `stop`."""
    outcome: OutcomeAgreement
    """`same`: bitwise; `close`: within the tolerance; `exempt`: affected by the deadline."""
    proposal: ProposalAgreement = "none"
    """`taken` from the ledger without an agent to ask; `none` for a reference model."""
    status: Status | None = None
    V: float | None = None
    again: float | None = None
    """The value now."""
    apart: float | None = None
    """Relative difference of the two; None without two scores."""
    detail: str = ""

    @property
    def agrees(self) -> bool:
        """Return whether the replay agrees with the ledger."""
        return self.outcome != "differs" and self.proposal != "differs"


@dataclass(frozen=True)
class ReplayReport:
    """Result of a replay."""

    run: str
    tolerance: float
    """Relative difference of V up to which outcomes agree; 0 for bitwise."""
    exchanges: int = 0
    """Answers of a language model that the ledger holds."""
    items: tuple[Replayed, ...] = ()
    notes: tuple[str, ...] = ()
    """Differences between this machine and the recorded one."""

    @property
    def agrees(self) -> bool:
        """Return whether all steps agree."""
        return all(item.agrees for item in self.items)

    @property
    def apart(self) -> float:
        """Largest relative difference of two scores."""
        return max((item.apart for item in self.items if item.apart is not None), default=0.0)


def replay_run(
    directory: Path,
    on_item: Callable[[Replayed], None],
    tolerance: float = 0.0,
    *,
    trusted: Collection[str] = (),
    isolation: Isolation | None = None,
) -> ReplayReport:
    """Replay a finished or interrupted run; nothing is written.

    Args:
        on_item: called with each step.
        tolerance: relative difference of V and of its folds up to which outcomes agree; 0 asks for
            bitwise equality.
        trusted: agent classes, `module:Class`, that may be imported besides those of ASIA and of
            installed packages.
        isolation: level of the candidates; None for the strongest of this machine.

    Raises:
        UserError: the run does not verify, its data changed, its agent is not trusted, or the
            package of its agent is missing.
    """
    run = open_run(directory)
    started = run.view.started
    if not run.store.kept:
        raise UserError(without_artifacts(directory))
    check_lock(directory, started)
    problem = load_lock(directory / LOCK)
    agent = recorded_agent(started.agent, started.agent_settings, trusted)
    level = level_here(isolation)
    notes: list[str] = []
    if level.value != started.isolation:
        notes.append(f"isolation {level.value} here, {started.isolation} then")
    notes += environment_changes(started.environment, environment(started.agent))
    evaluator = make_evaluator(problem, run.view, isolation=level, controllers=True)
    replaying = _Replaying(run, problem, evaluator, agent, tolerance, on_item)
    replaying.run_all()
    answered = sum(200 <= e.status < 300 for e in run.view.exchanges)
    return ReplayReport(run.name, tolerance, answered, tuple(replaying.items), tuple(notes))


@dataclass
class _Replaying:
    """A replay under way."""

    run: Run
    problem: Problem
    evaluator: Evaluator
    agent: Agent | None
    """None if candidates were submitted from outside."""
    tolerance: float
    on_item: Callable[[Replayed], None]
    items: list[Replayed] = field(default_factory=list[Replayed])

    @cached_property
    def _gate(self) -> Gate:
        return Gate(self.problem, self.evaluator, self.run.store)

    def run_all(self) -> None:
        """Replay every event in order, each with the view before it."""
        run, events = self.run, [line.event for line in self.run.lines]
        journal = _ReplayJournal(run.store, run.view.exchanges)
        if isinstance(self.agent, Attached):
            self.agent.attach(journal)
        self._references([event for event in events if isinstance(event, ReferenceScored)])
        asked: dict[int, Replayed] = {}
        for place, event in enumerate(tracked(events, "event")):
            match event:
                case Proposed():
                    before = replay(events[:place])
                    journal.experiments = len(before.experiments)
                    asked[event.experiment] = self._propose(event, before)
                case Evaluated():
                    item = asked.pop(event.experiment)
                    self._add(self._evaluate(item, event, replay(events[:place])))
                case Stopped(reason="exhausted") if self.agent is not None:
                    self._add(self._stop(self.agent, replay(events[:place])))
                case _:
                    pass
        for item in asked.values():
            self._add(replace(item, outcome="unfinished"))

    def _add(self, item: Replayed) -> None:
        self.items.append(item)
        self.on_item(item)

    def _references(self, recorded: list[ReferenceScored]) -> None:
        metric, truth = self.problem.protocol.metric, self.problem.truth
        again = {r.name: r.outcome for r in score_references(self.evaluator, metric, truth, set())}
        for one in recorded:
            item = Replayed(f"reference {one.name}", "same")
            if isinstance(one.outcome, Failure) and one.outcome.reason.status == "timeout":
                item = replace(item, outcome="exempt", detail="the deadline affected it")
            elif one.name not in again:
                detail = "this version has no such reference model"
                item = replace(item, outcome="differs", detail=detail)
            else:
                item = self._compare(item, one.outcome, again[one.name])
            self._add(item)

    def _propose(self, event: Proposed, before: SearchView) -> Replayed:
        """Ask again, and compare every word of the answer."""
        item = Replayed(f"#{event.experiment:02d}", "same", "taken")
        source = self.run.store.get(event.source)
        detail = ""
        if event.phase == "baseline":
            if as_bytes(first_source(self.problem)) != source:
                detail = "the baseline differs"
        elif self.agent is None or self._is_submitted(event):
            return item
        else:
            try:
                proposal = self.agent.propose(self._seen(before))
                detail = "" if proposal else "the agent has no proposal here"
            except DivergedError as error:
                proposal, detail = None, str(error)
            except AgentStoppedError as end:
                proposal, detail = None, f"the agent ends the search here: {end.detail}"
            if proposal is None:
                return replace(item, proposal="differs", detail=detail)
            pairs = {
                "source": (source, as_bytes(proposal.source)),
                "family": (event.family, proposal.family),
                "title": (event.title, proposal.title),
                "hypothesis": (event.hypothesis, proposal.hypothesis),
                "expectation": (event.expected, proposal.expected),
                "parent": (event.parent, proposal.parent),
            }
            different = [what for what, (there, here) in pairs.items() if there != here]
            detail = f"the proposal differs in {', '.join(different)}" if different else ""
        return replace(item, proposal="differs" if detail else "same", detail=detail)

    def _is_submitted(self, event: Proposed) -> bool:
        """Return whether a coding agent beside the search's own one proposed this."""
        beside = self.run.view.started.agent_settings.get(COMPANION)
        return beside is not None and event.agent not in ("", beside)

    def _seen(self, before: SearchView) -> AgentView:
        """The agent's view, with the budget of that time."""
        budget = replace(self.problem.budget, experiments=before.budget, hours=before.hours)
        facts = problem_facts(replace(self.problem, budget=budget))
        return agent_view(facts, before, self.run.store)

    def _evaluate(self, item: Replayed, event: Evaluated, view: SearchView) -> Replayed:
        item = replace(item, status=event.status, V=_value(event.outcome))
        if event.duplicate_of is not None:
            twin = next(i for i in self.items if i.name == f"#{event.duplicate_of:02d}")
            again = replace(item, again=twin.again, apart=twin.apart)
            return _concluded(again, twin.outcome, f"twin of {twin.name}")
        if event.deadline:
            return _concluded(item, "exempt", "the deadline affected it")
        proposed = view.experiment(event.experiment).proposed
        source = self.run.store.text(proposed.source)
        judged = decide(
            self.evaluator, source, view, proposed=proposed, confirm=self._gate.confirm,
            store=self.run.store,
        )  # fmt: skip
        item = self._compare(item, event.outcome, judged.evaluation.outcome)
        if item.outcome != "same":
            return item
        if judged.status != event.status:
            return _concluded(item, "differs", f"the decision is {judged.status} now")
        if judged.retests != event.retests and not self.tolerance:
            return _concluded(item, "differs", "the result with another seed differs")
        return item

    def _stop(self, agent: Agent, before: SearchView) -> Replayed:
        """The end of the search: the agent must end it again."""
        try:
            ended = agent.propose(self._seen(before)) is None
        except AgentStoppedError:
            ended = True
        detail = "" if ended else "the agent continues here"
        return Replayed("stop", "same" if ended else "differs", "same", detail=detail)

    def _compare(self, item: Replayed, there: Outcome, here: Outcome) -> Replayed:
        item = replace(item, V=_value(there), again=_value(here))
        if isinstance(there, Failure) or isinstance(here, Failure):
            then, now = (
                f"{one.reason.value} in fold {one.fold}" if isinstance(one, Failure) else "a score"
                for one in (there, here)
            )
            if then == now:
                return item
            return _concluded(item, "differs", f"{now} now, {then} then")
        # The largest difference of V and of the folds, relative to the larger one.
        pairs = [(there.value, here.value)]
        pairs += [(a.value, b.value) for a, b in zip(there.folds, here.folds, strict=True)]
        apart = max(abs(b - a) / max(a, b) if a != b else 0.0 for a, b in pairs)
        item = replace(item, apart=apart)
        if there == here:
            return item
        detail = f"V {there.value!r} then, {here.value!r} now"
        return _concluded(item, "close" if apart <= self.tolerance else "differs", detail)


@dataclass
class _ReplayJournal:
    """The ledger as an agent reads it in a replay; nothing can be added."""

    store: Store
    exchanges: tuple[Exchanged, ...]
    experiments: int = 0

    def record(self, event: Event) -> None:
        """Raises InternalError."""
        raise InternalError(f"a replay was about to record '{event.event}'")

    def put(self, data: bytes) -> str:
        """The name these bytes would have."""
        return hashlib.sha256(data).hexdigest()

    def get(self, name: str) -> bytes:
        """Bytes of the run."""
        return self.store.get(name)

    def interrupted(self) -> bool:
        """Nobody interrupts a replay."""
        return False


def _value(outcome: Outcome) -> float | None:
    return outcome.value if isinstance(outcome, Score) else None


def _concluded(item: Replayed, outcome: OutcomeAgreement, detail: str) -> Replayed:
    """The item with this outcome and a further detail."""
    parts = [part for part in (item.detail, detail) if part]
    return replace(item, outcome=outcome, detail="; ".join(parts))
