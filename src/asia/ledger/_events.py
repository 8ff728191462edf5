"""What a search records. One dataclass an event; every field is JSON."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from asia.protocol import EarlyStopping
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
    """First event: what is searched, by whom, under which rules. `test_digest` commits the sealed
    test before experiment 1; it is None when the problem has no test. With `early_stopping`
    `validation` candidates saw their score on the held-out parts: V is not leak-free.
    `agent_settings` are those of the agent that shape the search; `ladder` is the share of V
    by which a new best must be better for whoever proposes to be told, None where all is told;
    `guard_digest` commits the guard records; `layers` are those of the isolation; `salt` is what
    the choice of cases that would-be winners are checked on hangs on, and told to nobody."""

    run: str
    problem: str
    agent: str
    seed: int
    experiments: int
    hours: float | None
    outputs: tuple[str, ...]
    lock_digest: str
    protocol_digest: str
    test_digest: str | None
    isolation: str
    isolation_notes: tuple[str, ...]
    environment: dict[str, str]
    early_stopping: EarlyStopping = "inner"
    agent_settings: dict[str, str] = field(default_factory=dict[str, str])
    ladder: float | None = None
    guard_digest: str | None = None
    layers: tuple[str, ...] = ()
    salt: str = ""
    event: Literal["started"] = "started"


@dataclass(frozen=True)
class RungScored:
    """A trivial reference."""

    name: str
    outcome: Outcome
    event: Literal["rung"] = "rung"


@dataclass(frozen=True)
class Proposed:
    """A candidate about to be evaluated. `source` is the artifact, `digest` its normalised AST;
    `ticket` names the submission it came by, "" where an agent was asked."""

    experiment: int
    parent: int | None
    phase: Phase
    family: str
    title: str
    hypothesis: str
    expected: str
    source: str
    digest: str
    ticket: str = ""
    event: Literal["proposed"] = "proposed"


@dataclass(frozen=True)
class FoldRecord:
    """Artifacts and training-side evidence of one fold, and how often the fit was told its score
    on the held-out part."""

    model: str
    y_hat: str
    curve: str
    diagnostics: Diagnostics
    fit_seconds: float
    validation_scores: int = 0


@dataclass(frozen=True)
class Evaluated:
    """What came of a candidate. `duplicate_of` names the experiment whose outcome was reused;
    `deadline` marks an outcome that depends on how fast the machine was; `validation_scores` counts
    those given in all folds, failed ones too; `isolation` is the level that kept the candidate in,
    None in records from before it was written here; `left_behind` are worker processes, by pid,
    that the kernel did not let die."""

    experiment: int
    status: Status
    outcome: Outcome
    folds: tuple[FoldRecord, ...]
    output: str | None
    seconds: float
    duplicate_of: int | None = None
    deadline: bool = False
    validation_scores: int = 0
    isolation: str | None = None
    left_behind: tuple[int, ...] = ()
    event: Literal["evaluated"] = "evaluated"


@dataclass(frozen=True)
class Extended:
    """The budget was raised to `experiments` and `hours`; None is open."""

    experiments: int
    hours: float | None = None
    event: Literal["extended"] = "extended"


@dataclass(frozen=True)
class Stopped:
    """The search ended."""

    reason: StopReason
    detail: str = ""
    event: Literal["stopped"] = "stopped"


@dataclass(frozen=True)
class Resumed:
    """A search that had stopped for one of `RESUMABLE` goes on."""

    event: Literal["resumed"] = "resumed"


@dataclass(frozen=True)
class Steered:
    """A person's note to the agent, seen from the next proposal on."""

    text: str
    event: Literal["steered"] = "steered"


@dataclass(frozen=True)
class Usage:
    """What a language model consumed. cost in USD, None where it is not known; turns: replies of
    the model."""

    input_tokens: int = 0
    output_tokens: int = 0
    cached_tokens: int = 0
    cost: float | None = None
    turns: int = 0

    @property
    def tokens(self) -> int:
        """Input and output together."""
        return self.input_tokens + self.output_tokens


@dataclass(frozen=True)
class Exchanged:
    """A request to a language model and what came back, in artifacts; `experiment` is the one it
    was made for, `status` that of HTTP, 0 when there was no answer; headers are not kept."""

    experiment: int
    path: str
    request: str
    response: str
    status: int
    usage: Usage | None = None
    event: Literal["exchanged"] = "exchanged"


@dataclass(frozen=True)
class Streamed:
    """Output lines of an agent that runs as a command, as they came, in an artifact."""

    session: int
    lines: str
    event: Literal["streamed"] = "streamed"


@dataclass(frozen=True)
class SessionStarted:
    """A command agent's process begins; it may spend `grant` USD, None where money has no cap."""

    session: int
    grant: float | None
    event: Literal["session_started"] = "session_started"


@dataclass(frozen=True)
class SessionEnded:
    """A command agent's process has ended: how, and what this session consumed."""

    session: int
    outcome: str
    usage: Usage | None
    event: Literal["session_ended"] = "session_ended"


@dataclass(frozen=True)
class Again:
    """A fold of the winner fitted a second time, with the same seed: its error over that of the
    first time, 1 where the fit repeats itself; None and the reason where it failed."""

    fold: int
    ratio: float | None
    failed: str = ""


@dataclass(frozen=True)
class Refitted:
    """The winner fitted once more on all training data: `model`, or None when that fit failed; and
    on one fold `again`, None in records from before that was done."""

    experiment: int
    model: str | None
    detail: str
    again: Again | None = None
    event: Literal["refitted"] = "refitted"


@dataclass(frozen=True)
class GuardScore:
    """How the ensemble of an experiment's fold models does on the guard records, in the search's
    metric over the standard deviations of the training records."""

    experiment: int
    outcome: Outcome


@dataclass(frozen=True)
class GuardLooked:
    """The guard records were looked at, for the `look`-th time, with the last new bests; `pick` is
    the best of them there."""

    look: int
    scores: tuple[GuardScore, ...]
    pick: int | None
    event: Literal["guard"] = "guard"


@dataclass(frozen=True)
class TestRecord:
    """One model on the sealed test; `y_hat` is the artifact of its simulation, `mee` the table of
    Mean Euclidean Errors where the protocol asks for one."""

    scores: tuple[TestScore, ...]
    y_hat: str
    mee: MeeTable | None = None


@dataclass(frozen=True)
class Unsealing:
    """The sealed test is about to be opened; from here on the search is over. `opened_before`
    names the runs beside this one that had opened the same test; `process_consent`: a person said
    yes to opening it though the candidates ran at level process, where they could read it."""

    experiment: int
    test_digest: str
    opened_before: tuple[str, ...]
    process_consent: bool = False
    event: Literal["unsealing"] = "unsealing"


@dataclass(frozen=True)
class Unsealed:
    """What the sealed test said. `ensemble` is the mean of the fold models, `refit` the
    winner fitted on all training data; `measured` is the artifact of the test outputs, one
    (lengths[i], ny) array a trajectory, from the first simulated sample on; `skip` of them are left
    out of the scores. With a `horizon` a trajectory's windows stand one after the other, the last
    of which may repeat some samples."""

    experiment: int
    test_digest: str
    channels: tuple[str, ...]
    trajectories: tuple[str, ...]
    lengths: tuple[int, ...]
    skip: int
    measured: str
    ensemble: TestRecord | Failure
    refit: TestRecord | Failure | None
    horizon: int | None = None
    event: Literal["unsealed"] = "unsealed"


Event = (
    Started
    | RungScored
    | Proposed
    | Evaluated
    | Extended
    | Stopped
    | Resumed
    | Steered
    | Exchanged
    | Streamed
    | SessionStarted
    | SessionEnded
    | Refitted
    | GuardLooked
    | Unsealing
    | Unsealed
)

adapter: TypeAdapter[Event] = TypeAdapter(Annotated[Event, Field(discriminator="event")])
