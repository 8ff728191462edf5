"""The course of a search: its start, its experiments, its end."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from asia._stopwatch import TimeSpent
from asia.ledger._events.final import RefitCheck, Stack, Use
from asia.protocol import EarlyStopping, ShownResidual
from asia.scoring import Diagnostics, Outcome

Status = Literal["keep", "inconclusive", "discard", "crash", "timeout", "invalid"]
Phase = Literal["baseline", "explore", "refine"]
StopReason = Literal[
    "budget", "saturated", "exhausted", "hours", "user", "stuck", "tokens", "cost", "time", "agent"
]
Device = Literal["cpu", "gpu"]
HandOverReason = Literal[
    "planned", "saturated", "exhausted", "stuck", "tokens", "cost", "time", "agent"
]
# Left out of the record where one experiment runs at a time.
_AtOnce = Annotated[int, Field(exclude_if=lambda value: value == 1)]
# Left out where the search's own machine fitted.
_Elsewhere = Annotated[str, Field(exclude_if=lambda value: value == "")]
# Omitted if no GPU was requested.
_Device = Annotated[Device, Field(exclude_if=lambda value: value == "cpu")]
_Flag = Annotated[bool, Field(exclude_if=lambda value: not value)]
_Bound = Annotated[float | None, Field(exclude_if=lambda value: value is None)]
_Count = Annotated[int, Field(exclude_if=lambda value: value == 0)]
_FailedChecks = Annotated[tuple[str, ...], Field(exclude_if=lambda value: not value)]
_Elapsed = Annotated[float | None, Field(exclude_if=lambda value: value is None)]

RESUMABLE: frozenset[StopReason] = frozenset({"user", "stuck", "tokens", "cost", "time", "agent"})
"""Reasons after which the same command goes on; the others need a larger budget."""


@dataclass(frozen=True)
class Leg:
    """The part of a relay in which one agent proposes."""

    agent: str
    """Name of the agent."""
    experiments: int | None = None
    """Number of experiments of the leg; the baseline counts as one of the first leg. None for all
    that remain, which only the last leg may have.
    """
    settings: dict[str, str] = field(default_factory=dict[str, str])
    """Settings of the agent that shape the search."""


@dataclass(frozen=True)
class Started:
    """First event: what is searched, by whom, under which rules."""

    run: str
    """Name of the run."""
    problem: str
    """Name of the problem."""
    agent: str
    """Name of the agent, of a relay the names of all."""
    seed: int
    """Seed of the search."""
    experiments: int
    """Budget of experiments."""
    hours: float | None
    """Budget of wall-clock hours; None is open."""
    outputs: tuple[str, ...]
    """Names of the outputs."""
    lock_digest: str
    """sha256 of the run's `problem.lock.toml`."""
    protocol_digest: str
    """Digest of the protocol alone."""
    test_digest: str | None
    """Commits the sealed test before experiment 1; None when the problem has no test."""
    isolation: str
    """The level of isolation that candidates run at."""
    isolation_notes: tuple[str, ...]
    """Protection that this isolation level lacks, for display."""
    environment: dict[str, str]
    """Python, platform and package versions."""
    early_stopping: EarlyStopping = "inner"
    """Source of the score for early stopping. With `validation`, candidates saw their score on the
    held-out parts and V is not leak-free.
    """
    agent_settings: dict[str, str] = field(default_factory=dict[str, str])
    """Settings of the agent that shape the search."""
    ladder: float | None = None
    """Relative improvement of V that a new best needs before the agent sees it; None if all of V is
    shown.
    """
    guard_digest: str | None = None
    """Commits the guard records; None when the problem has none."""
    layers: tuple[str, ...] = ()
    """The layers of the isolation that were in force."""
    salt: str = ""
    """Seeds the choice of cases that new bests are checked on; never shown to agents."""
    isolation_strict: bool = False
    """True if the folds of a candidate were fitted sequentially, so that none could pass
    information to another.
    """
    lessons: str | None = None
    """Artifact with the lessons of earlier searches, in older ledgers only."""
    folds: tuple[str, ...] = ()
    """Description of the held-out part of each fold; () in older ledgers."""
    residuals: ShownResidual = "train"
    """Residuals that agents saw: with `held_out`, those of the held-out samples."""
    legs: tuple[Leg, ...] = ()
    """The agents that propose one after the other; () where one agent does."""
    retests: int = 0
    """The most fits from other seeds of a candidate about to be kept, which must then be better by
    the floor; 0 where one fit decides, as in older ledgers."""
    parallel: _AtOnce = 1
    """Maximum number of concurrent experiments. Each is proposed once all but the last `parallel` -
    1 before it have their results.
    """
    stop_folds: _Flag = False
    """True if the remaining folds of a first fit are pruned once V must be above
    `Proposed.over`.
    """
    device: _Device = "cpu"
    """Device of candidates that train networks; `environment` names the GPU."""
    event: Literal["started"] = "started"

    @property
    def isolation_words(self) -> str:
        """The level, and whether folds ran one after the other."""
        return f"{self.isolation}, strict" if self.isolation_strict else self.isolation


@dataclass(frozen=True)
class RungScored:
    """A trivial reference."""

    name: str
    """Name of the reference model."""
    outcome: Outcome
    """Its score, or why there is none."""
    failed_checks: _FailedChecks = field(default=(), compare=False)
    """As in `Evaluated`."""
    event: Literal["rung"] = "rung"


@dataclass(frozen=True)
class Proposed:
    """A candidate about to be evaluated."""

    experiment: int
    """1-based."""
    parent: int | None
    """The experiment it was made from."""
    phase: Phase
    """The phase of the search."""
    family: str
    """The model family, in the agent's words."""
    title: str
    """The candidate on one line."""
    hypothesis: str
    """Why it should be better."""
    expected: str
    """Expected V, in the words of the agent."""
    source: str
    """Artifact of `candidate.py`."""
    digest: str
    """Digest of its normalised AST."""
    ticket: str = ""
    """The submission it came by; "" where an agent was asked."""
    leg: int = 0
    """The leg of a relay that it belongs to, 1-based; 0 where one agent proposes."""
    agent: str = ""
    """The agent of that leg; "" where one agent proposes, and for the baseline."""
    remark: str = ""
    """Comment of the agent on the state of the search, for display; "" for none."""
    over: _Bound = None
    """V above which the folds that are left do not count; None where all of them do."""
    event: Literal["proposed"] = "proposed"


@dataclass(frozen=True)
class FoldEvidence:
    """Artifacts and training-side evidence of one fold."""

    model: str
    """Artifact of the fitted model."""
    y_hat: str
    """Artifact of the simulated held-out outputs."""
    curve: str
    """Artifact of the candidate's log."""
    diagnostics: Diagnostics
    """Residual analysis of the training simulation."""
    fit_seconds: float
    """Duration of the fit."""
    validation_scores: int = 0
    """Number of requests of the fit for its score on the held-out part."""
    findings: str | None = None
    """Artifact of `asia.evaluation.FoldFindings`; None in older ledgers."""
    machine: _Elsewhere = ""
    """The machine that fitted it; "" for the search's own."""
    isolation: _Elsewhere = ""
    """The level that was in force on that machine; "" for the search's own, which the result
    names."""
    device: _Elsewhere = ""
    """JAX device as reported by the worker, which runs the candidate; "" if no GPU was
    requested.
    """


@dataclass(frozen=True)
class Retest:
    """A candidate about to be kept, fitted again on every fold from another seed."""

    value: float | None = None
    """V of these fits; None where one failed."""
    folds: tuple[float, ...] = ()
    """Its part of each fold; () where one failed."""
    failed: str = ""
    """The reason of the failure."""
    same: bool = False
    """True if every simulation is bitwise equal to that of the first fit, so that the seed has no
    effect.
    """
    seconds: float = field(default=0.0, compare=False)
    """Duration."""


@dataclass(frozen=True)
class Evaluated:
    """Outcome of a candidate."""

    experiment: int
    """1-based."""
    status: Status
    """The decision on it."""
    outcome: Outcome
    """Its score, or why there is none."""
    folds: tuple[FoldEvidence, ...]
    """Evidence of each fold; () for a failure."""
    output: str | None
    """Artifact of what it printed; None where it printed nothing."""
    seconds: float
    """Duration of the evaluation, retests included."""
    duplicate_of: int | None = None
    """The experiment whose outcome was reused."""
    deadline: bool = False
    """True if the outcome depends on the speed of the machine."""
    validation_scores: int = 0
    """Validation scores given in all folds, failed ones too."""
    isolation: str | None = None
    """The level that kept the candidate in; None in older ledgers."""
    left_behind: tuple[int, ...] = ()
    """Process ids of workers that the kernel did not let end."""
    spent: tuple[TimeSpent, ...] = field(default=(), compare=False)
    """Profile of the time since the last event with a profile; () in older ledgers."""
    retests: tuple[Retest, ...] = ()
    """Its fits from other seeds; () where it was not about to be kept."""
    floor: float | None = None
    """Significance threshold: improvement of the mean over seeds that was required. None without an
    incumbent, or if one fit decides.
    """
    lowest: bool = False
    """True if V of the first fit was the lowest so far and its model passed the checks of a final
    model. False if one fit decides, and in older ledgers.
    """
    elapsed: _Elapsed = None
    """Seconds that the search waited for it, decision included; None where one experiment runs at
    a time, which takes `seconds`."""
    ended_folds: _Count = field(default=0, compare=False)
    """Number of folds that were cancelled while they ran, because V was far above the best without
    them. It depends on the machine.
    """
    failed_checks: _FailedChecks = field(default=(), compare=False)
    """Diagnostics that raised an exception, a line each."""
    event: Literal["evaluated"] = "evaluated"


@dataclass(frozen=True)
class Landed:
    """The first fit of an experiment that ended before those proposed earlier had their results. It
    waits for its turn; a search that is killed meanwhile takes it up from here."""

    experiment: int
    """1-based."""
    outcome: Outcome
    """Its score, or why there is none; nothing is decided yet."""
    folds: tuple[FoldEvidence, ...]
    """Evidence of each fold; () for a failure."""
    output: str | None
    """Artifact of what it printed; None where it printed nothing."""
    seconds: float
    """Duration of the fit and its simulations."""
    validation_scores: int = 0
    """Validation scores given in all folds, failed ones too."""
    ended_folds: _Count = field(default=0, compare=False)
    """Number of cancelled folds, see `Evaluated`."""
    event: Literal["landed"] = "landed"


@dataclass(frozen=True)
class HandedOver:
    """A leg of a relay is over and the next one begins."""

    leg: int
    """The leg that begins, 1-based."""
    agent: str
    """Its agent."""
    reason: HandOverReason
    """Why the one before is over."""
    after: int
    """Experiments that were made before."""
    detail: str = ""
    """More about it, for people."""
    event: Literal["handed_over"] = "handed_over"


@dataclass(frozen=True)
class Extended:
    """The budget was raised."""

    experiments: int
    """The new budget of experiments."""
    hours: float | None = None
    """The new budget of hours; None is open."""
    event: Literal["extended"] = "extended"


@dataclass(frozen=True)
class Stopped:
    """The search ended."""

    reason: StopReason
    """Why."""
    detail: str = ""
    """More about it, for people."""
    event: Literal["stopped"] = "stopped"


@dataclass(frozen=True)
class Resumed:
    """A search that had stopped for one of `RESUMABLE` goes on."""

    event: Literal["resumed"] = "resumed"


@dataclass(frozen=True)
class Steered:
    """Note of the user to the agent, visible from the next proposal on."""

    text: str
    """The note."""
    event: Literal["steered"] = "steered"


@dataclass(frozen=True)
class Again:
    """A fold of the winner fitted a second time, with the same seed."""

    fold: int
    """1-based."""
    ratio: float | None
    """Its error over that of the first fit, 1 where the fit repeats itself; None where it
    failed."""
    failed: str = ""
    """Why it failed."""


@dataclass(frozen=True)
class Refitted:
    """The winner fitted once more on all training data."""

    experiment: int
    """The winner."""
    model: str | None
    """Artifact of the model; None when that fit failed, or when no start is worth using."""
    detail: str
    """Why there is none."""
    again: Again | None = None
    """The second fit of one fold; None in older ledgers."""
    spent: tuple[TimeSpent, ...] = field(default=(), compare=False)
    """Profile of the time, see `Evaluated`."""
    check: RefitCheck | None = None
    """Comparison of the refit with the fold models; None in older ledgers."""
    stack: Stack | None = None
    """The weighted mean of several experiments; None where it would be the winner alone."""
    use: Use | None = None
    """The model to use; None in older ledgers."""
    reason: str = ""
    """Why this one, in a sentence."""
    estimates: str | None = None
    """Artifact of what the refit says of its parameters; None where it says nothing, and in older
    ledgers."""
    failed_checks: _FailedChecks = field(default=(), compare=False)
    """Failed checks, see `Evaluated`."""
    event: Literal["refitted"] = "refitted"
