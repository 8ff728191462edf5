"""What a search records. One dataclass an event; every field is JSON."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from asia._stopwatch import TimeSpent
from asia.protocol import EarlyStopping, ShownResidual
from asia.scoring import Diagnostics, Failure, MeeTable, Outcome, TestScore

Status = Literal["keep", "discard", "crash", "timeout", "invalid"]
Phase = Literal["baseline", "explore", "refine"]
StopReason = Literal[
    "budget", "saturated", "exhausted", "hours", "user", "stuck", "tokens", "cost", "time", "agent"
]
RESUMABLE: frozenset[StopReason] = frozenset({"user", "stuck", "tokens", "cost", "time", "agent"})
"""Reasons after which the same command goes on; the others need a larger budget."""


@dataclass(frozen=True)
class Started:
    """First event: what is searched, by whom, under which rules."""

    run: str
    """Name of the run."""
    problem: str
    """Name of the problem."""
    agent: str
    """Name of the agent."""
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
    """What that level lacks, for people."""
    environment: dict[str, str]
    """Python, platform and package versions."""
    early_stopping: EarlyStopping = "inner"
    """With `validation` candidates saw their score on the held-out parts: V is not leak-free."""
    agent_settings: dict[str, str] = field(default_factory=dict[str, str])
    """Settings of the agent that shape the search."""
    ladder: float | None = None
    """The share of V by which a new best must be better for whoever proposes to see it; None where
    all of V is shown."""
    guard_digest: str | None = None
    """Commits the guard records; None when the problem has none."""
    layers: tuple[str, ...] = ()
    """The layers of the isolation that were in force."""
    salt: str = ""
    """Seeds the choice of cases that new bests are checked on; never shown to agents."""
    isolation_strict: bool = False
    """Whether the folds of a candidate ran one after the other, so that none could tell another."""
    lessons: str | None = None
    """Artifact of the lessons that its agents were given; None for none."""
    folds: tuple[str, ...] = ()
    """What each fold holds out, in words; () in older ledgers."""
    residuals: ShownResidual = "train"
    """With `held_out` those who propose saw residuals of the held-out samples."""
    event: Literal["started"] = "started"

    @property
    def isolation_words(self) -> str:
        """The level, and whether folds ran one after the other."""
        return f"{self.isolation}, strict" if self.isolation_strict else self.isolation


@dataclass(frozen=True)
class RungScored:
    """A trivial reference."""

    name: str
    """Name of the rung."""
    outcome: Outcome
    """Its score, or why there is none."""
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
    """What the agent expects of V."""
    source: str
    """Artifact of `candidate.py`."""
    digest: str
    """Digest of its normalised AST."""
    ticket: str = ""
    """The submission it came by; "" where an agent was asked."""
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
    """How often the fit asked for its score on the held-out part."""
    findings: str | None = None
    """Artifact of `asia.evaluation.FoldFindings`; None in older ledgers."""


@dataclass(frozen=True)
class Evaluated:
    """What came of a candidate."""

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
    """Duration of the evaluation."""
    duplicate_of: int | None = None
    """The experiment whose outcome was reused."""
    deadline: bool = False
    """Whether the outcome depends on how fast the machine was."""
    validation_scores: int = 0
    """Validation scores given in all folds, failed ones too."""
    isolation: str | None = None
    """The level that kept the candidate in; None in older ledgers."""
    left_behind: tuple[int, ...] = ()
    """Process ids of workers that the kernel did not let end."""
    spent: tuple[TimeSpent, ...] = field(default=(), compare=False)
    """Where the seconds went since the last event that says so; () in older ledgers."""
    event: Literal["evaluated"] = "evaluated"


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
    """A person's note to the agent, seen from the next proposal on."""

    text: str
    """The note."""
    event: Literal["steered"] = "steered"


@dataclass(frozen=True)
class Usage:
    """What a language model consumed."""

    input_tokens: int = 0
    """Tokens of the requests."""
    output_tokens: int = 0
    """Tokens of the replies."""
    cached_tokens: int = 0
    """The part of `input_tokens` that the provider had cached."""
    cost: float | None = None
    """USD; None where it is not known."""
    turns: int = 0
    """Replies of the model."""

    @property
    def tokens(self) -> int:
        """Input and output together."""
        return self.input_tokens + self.output_tokens


@dataclass(frozen=True)
class Exchanged:
    """A request to a language model and its reply. Headers are not kept."""

    experiment: int
    """The experiment it was made for."""
    path: str
    """Path of the request."""
    request: str
    """Artifact of its body."""
    response: str
    """Artifact of the reply's body."""
    status: int
    """HTTP status; 0 when there was no reply."""
    usage: Usage | None = None
    """What the exchange consumed."""
    event: Literal["exchanged"] = "exchanged"


@dataclass(frozen=True)
class Streamed:
    """Output lines of an agent that runs as a command, as they came, in an artifact."""

    session: int
    """Number of the session."""
    lines: str
    """The artifact."""
    event: Literal["streamed"] = "streamed"


@dataclass(frozen=True)
class SessionStarted:
    """A command agent's process begins."""

    session: int
    """Number of the session."""
    grant: float | None
    """USD that it may spend; None where money has no cap."""
    event: Literal["session_started"] = "session_started"


@dataclass(frozen=True)
class SessionEnded:
    """A command agent's process has ended."""

    session: int
    """Number of the session."""
    outcome: str
    """How it ended."""
    usage: Usage | None
    """What it consumed."""
    event: Literal["session_ended"] = "session_ended"


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
    """Artifact of the model; None when that fit failed."""
    detail: str
    """Why it failed."""
    again: Again | None = None
    """The second fit of one fold; None in older ledgers."""
    spent: tuple[TimeSpent, ...] = field(default=(), compare=False)
    """As in `Evaluated`."""
    event: Literal["refitted"] = "refitted"


@dataclass(frozen=True)
class GuardScore:
    """The ensemble of an experiment's fold models on the guard records."""

    experiment: int
    """1-based."""
    outcome: Outcome
    """The search's metric over the standard deviations of the training records."""


@dataclass(frozen=True)
class GuardLooked:
    """The guard records were looked at."""

    look: int
    """Number of this look."""
    scores: tuple[GuardScore, ...]
    """Of the last new bests."""
    pick: int | None
    """The best of them on the guard records."""
    spent: tuple[TimeSpent, ...] = field(default=(), compare=False)
    """As in `Evaluated`."""
    event: Literal["guard"] = "guard"


@dataclass(frozen=True)
class TestedModel:
    """One model on the sealed test."""

    scores: tuple[TestScore, ...]
    """One a test metric."""
    y_hat: str
    """Artifact of its simulation."""
    mee: MeeTable | None = None
    """The table of Mean Euclidean Errors, where the protocol asks for one."""


@dataclass(frozen=True)
class Unsealing:
    """The sealed test is about to be opened; from here on the search is over."""

    experiment: int
    """The winner."""
    test_digest: str
    """Digest of the test."""
    opened_before: tuple[str, ...]
    """Runs beside this one that had opened the same test."""
    process_consent: bool = False
    """A person agreed to open it though candidates ran at level process, where they could read
    it."""
    event: Literal["unsealing"] = "unsealing"


@dataclass(frozen=True)
class Unsealed:
    """What the sealed test said."""

    experiment: int
    """The winner."""
    test_digest: str
    """Digest of the test."""
    channels: tuple[str, ...]
    """Names of the outputs."""
    trajectories: tuple[str, ...]
    """Names of the test trajectories."""
    lengths: tuple[int, ...]
    """Samples of each, from the first simulated one on."""
    skip: int
    """Samples at the start of each that the scores leave out."""
    measured: str
    """Artifact of the test outputs, one (lengths[i], ny) array a trajectory."""
    ensemble: TestedModel | Failure
    """The mean of the fold models."""
    refit: TestedModel | Failure | None
    """The winner fitted on all training data."""
    horizon: int | None = None
    """Samples of a window, None for long simulations. A trajectory's windows stand one after the
    other; the last may repeat some samples."""
    event: Literal["unsealed"] = "unsealed"


Event = (
    Started | RungScored | Proposed | Evaluated | Extended | Stopped | Resumed | Steered | Exchanged
    | Streamed | SessionStarted | SessionEnded | Refitted | GuardLooked | Unsealing | Unsealed
)  # fmt: skip

adapter: TypeAdapter[Event] = TypeAdapter(Annotated[Event, Field(discriminator="event")])
