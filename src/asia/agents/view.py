"""View of a search for agents, and the proposals that they return."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, runtime_checkable

from asia.candidate import KnownSystem
from asia.data.trajectory import Trajectory
from asia.errors import UserError
from asia.judge.scoring.residuals import Diagnostics
from asia.ledger.events import Event, Exchanged, Phase, Status, StopReason
from asia.problem.metrics import TrainingLoss, find_metric
from asia.problem.protocol import EarlyStopping

# There is no measured time, no validation residual and no test: an agent decides from V per fold,
# status, the candidates' logs and training-side residual analysis. It may look at all training
# records, as a user would.


LINEAR, PARENT = "linear", "its parent"
"""Variants of a candidate that are what it begins with, see `asia.search.fair_trial`."""


@dataclass(frozen=True)
class Effort:
    """Budget of the search: total experiments, and seconds for the fit of a fold."""

    experiments: int = 15
    fit_seconds: float = 120.0


@dataclass(frozen=True, kw_only=True)
class Facts(KnownSystem):
    """Public facts about the problem.

    `records` are the training trajectories; in cross-validation each contains the held-out outputs
    of some fold.

    Attributes:
        notes, strategies: notes from the literature and suggested strategies, in the user's
            words
        groups: names of the records held out together, one tuple a fold, () where folds are cut
            inside the records
        early_stopping: `validation` lets a fit ask for its score on the held-out part
        terms: computes terms that a linear model lacks, with the place ("at the input", "in the
            dynamics", "at the output") and the share of its residual that each explains, the
            largest first; () where nothing is found
        linear: settings of the best linear model, () for those of the baseline
        identification: facts about the plant of a control problem
    """

    description: str = ""
    records: tuple[Trajectory, ...] = field(repr=False)
    early_stopping: EarlyStopping = "inner"
    folds: int = 2
    groups: tuple[tuple[str, ...], ...] = ()
    budget: Effort = Effort()
    notes: str = ""
    strategies: str = ""
    linear: tuple[tuple[str, Any], ...] = ()
    terms: Callable[[], tuple[tuple[str, str, float], ...]] = field(
        default=tuple, compare=False, repr=False
    )
    identification: Facts | None = None

    @property
    def past(self) -> int:
        """Samples before the first simulated one."""
        return max(self.n_past_u, self.n_past_y)

    @property
    def loss(self) -> TrainingLoss:
        """The training loss that goes with the metric."""
        return find_metric(self.metric).loss

    @property
    def samples(self) -> int:
        """Training samples in all records."""
        return sum(len(r) for r in self.records)

    @property
    def fit_samples(self) -> int:
        """Training samples of one fold, about."""
        return round(self.samples * (1.0 - 1.0 / self.folds))


@dataclass(frozen=True)
class Trial:
    """Evaluated experiment.

    Attributes:
        value, folds: V and V per fold; None and () when there is no score
        failure: description of the failure and its remedy
        error: message of the candidate itself: data, not to be trusted
        evidence: further findings as lines of text, for the best and the last trial; () for the
            others
        diagnoses: checks that do not pass on the training records, by name, with the share of the
            residual that each explains, the largest first; with `evidence`
        lowest: with retests, whether its own fit was the best so far
        order: states that the fits report, median over the folds; None where they report none
        variant: variant that was scored in its place, `LINEAR` and `PARENT` for what it began with;
            "" where it left nothing open
    """

    number: int
    parent: int | None
    phase: Phase
    family: str
    title: str
    hypothesis: str
    expected: str
    source: str = field(repr=False)
    status: Status
    value: float | None
    folds: tuple[float, ...]
    failure: str | None
    diagnostics: tuple[Diagnostics, ...]
    curves: tuple[tuple[tuple[float, float], ...], ...] = field(default=(), repr=False)
    error: str = field(default="", repr=False)
    evidence: tuple[str, ...] = field(default=(), repr=False)
    diagnoses: tuple[tuple[str, float], ...] = ()
    lowest: bool = False
    order: int | None = None
    variant: str = ""

    @property
    def improved(self) -> bool:
        """Whether it was the best so far, by significance or by its own fit."""
        return self.status == "keep" or self.lowest

    @property
    def train_error(self) -> float | None:
        """Mean over folds of the normalised training error."""
        if not self.diagnostics:
            return None
        return sum(d.train_error for d in self.diagnostics) / len(self.diagnostics)


@dataclass(frozen=True)
class Running:
    """An experiment that was proposed and has no result yet, as a `Trial` names its parts."""

    number: int
    parent: int | None
    family: str
    title: str
    hypothesis: str
    expected: str
    source: str = field(repr=False)


@dataclass(frozen=True)
class AgentView:
    """Read-only view of the search.

    `is_known(source)` returns whether a candidate with the same normalised source was tried.

    Attributes:
        notes: messages of the user during the search, oldest first
        linear, mean: V of the best linear model and of the mean of the training outputs, None
            where unknown
        remaining: experiments left
        running: pending experiments, oldest first; () unless several are proposed ahead of
            their results
    """

    facts: Facts
    seed: int
    phase: Literal["explore", "refine"]
    trials: tuple[Trial, ...]
    remaining: int
    is_known: Callable[[str], bool] = field(repr=False)
    notes: tuple[str, ...] = ()
    linear: float | None = None
    mean: float | None = None
    running: tuple[Running, ...] = ()

    @property
    def proposed(self) -> tuple[Trial | Running, ...]:
        """All that was proposed so far, in order."""
        return (*self.trials, *self.running)

    @property
    def experiments(self) -> int:
        """Total budget."""
        return len(self.proposed) + self.remaining

    @property
    def ranked(self) -> tuple[Trial, ...]:
        """Scored trials, best first."""
        scored = [(t.value, t.number, t) for t in self.trials if t.value is not None]
        return tuple(t for _, _, t in sorted(scored, key=lambda item: item[:2]))

    @property
    def best(self) -> Trial | None:
        """The incumbent."""
        return self.ranked[0] if self.ranked else None


@dataclass(frozen=True)
class Proposal:
    """Candidate with its rationale.

    Attributes:
        expected: predicted effect, recorded before the evaluation
        parent: the experiment it was derived from
        ticket: name of a submission
        remark: message for the user about the search, "" for none
        fair: whether the linear model is scored in its place where that is as good inside the
            training records
        agent: name of the one that proposes it, "" where the search has one agent alone
    """

    source: str
    family: str
    title: str
    hypothesis: str
    expected: str
    parent: int | None = None
    ticket: str = ""
    remark: str = ""
    fair: bool = False
    agent: str = ""


class Agent(Protocol):
    """Proposes candidates. Must be a function of the view, and of its journal where it keeps one,
    so that a search resumes."""

    @property
    def name(self) -> str:
        """Short name, part of the run's name."""
        ...

    def propose(self, view: AgentView) -> Proposal | None:
        """The next candidate, or None when there is nothing left to try."""
        ...


# Interface between the search and agents that wait, ask a language model or run as a command.


class InterruptedWaitError(Exception):
    """Error of an agent that waits, when the search has another task first; the agent is called
    again."""


class AgentStoppedError(Exception):
    """Raised by an agent that ends the search, with the reason that the ledger will give."""

    def __init__(self, reason: StopReason, detail: str = "") -> None:
        super().__init__(detail or reason)
        self.reason: StopReason = reason
        self.detail = detail


class DivergedError(UserError):
    """Error in a replay: the agent requests something that the record does not hold."""


class Journal(Protocol):
    """Journal of an attached agent: written from any thread, read again after a restart."""

    @property
    def exchanges(self) -> tuple[Exchanged, ...]:
        """All requests made so far, those of earlier sittings too."""
        ...

    @property
    def experiments(self) -> int:
        """Candidates proposed so far."""
        ...

    def record(self, event: Event) -> None:
        """Append an event to the ledger; on return it is on the disk."""
        ...

    def put(self, data: bytes) -> str:
        """Keep bytes; their name."""
        ...

    def get(self, name: str) -> bytes:
        """Bytes kept earlier."""
        ...

    def interrupted(self) -> bool:
        """Return whether the user has a note, a pause or a stop for the search."""
        ...


def proposes_ahead(agent: object) -> bool:
    """Return whether an agent may be asked while others of its proposals run.

    Its attribute of this name says so. It then reads `view.running`, and proposes no candidate
    listed there.
    """
    return bool(getattr(agent, "proposes_ahead", False))


def settings_of(agent: object) -> dict[str, str]:
    """Return the settings that shape an agent's proposals, for the ledger and without secrets.

    Its method `recorded` gives them; an agent without it has none.
    """
    recorded: Callable[[], dict[str, str]] | None = getattr(agent, "recorded", None)
    return {} if recorded is None else recorded()


@runtime_checkable
class Closing(Protocol):
    """An agent that has something to end when the search is over."""

    def stopped(self, reason: StopReason) -> None:
        """The search has stopped. Called once, before the best candidate is fitted on all data."""
        ...

    def leaving(self) -> None:
        """Called last, after an error or an interrupt too; the journal still takes events."""
        ...


@runtime_checkable
class Attached(Protocol):
    """An agent that keeps a journal."""

    def attach(self, journal: Journal) -> None:
        """Called once, before the first proposal."""
        ...


# Agent for submitted candidates: from a user in a shell, a coding agent, or a client of a server.


class SubmittedAgent:
    """Agent that proposes the submissions of `take`, and waits while there are none.

    Args:
        waiting: called while there is no submission, with the seconds waited so far; it may
            raise AgentStoppedError to end the search, or any other exception to interrupt it
    """

    def __init__(
        self,
        name: str,
        take: Callable[[], Proposal | None],
        waiting: Callable[[float], None] = lambda seconds: None,
    ) -> None:
        self._name, self._take, self._waiting = name, take, waiting
        self._journal: Journal | None = None

    @property
    def name(self) -> str:
        """Name of the submitter."""
        return self._name

    def attach(self, journal: Journal) -> None:
        """Register to be woken when the user has a note or a request."""
        self._journal = journal

    def propose(self, view: AgentView) -> Proposal:
        """The next one brought."""
        del view
        start = time.monotonic()
        while True:
            proposal = self._take()
            if proposal is not None:
                return proposal
            if self._journal is not None and self._journal.interrupted():
                raise InterruptedWaitError
            self._waiting(time.monotonic() - start)
            time.sleep(0.1)
