"""Events of a search: one frozen dataclass an event, every field is JSON.

`experiment` is the number of an experiment, from 1. `failed` and `detail` say why something is
missing, "" where it is not. `value` is V and `folds` its part of each fold; None and () for a
failure.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import AliasChoices, Field, TypeAdapter, model_validator

from asia._timer import TimeSpent
from asia.judge.artifacts import ArtifactName
from asia.judge.scoring.checks.check import RecordedCheck
from asia.judge.scoring.confirmation import Confirmation
from asia.judge.scoring.euclidean_error import MeeTable
from asia.judge.scoring.outcome import Failure, FoldRecord, Outcome, TestScore
from asia.judge.scoring.repeated_fits import Attribution, ExpectedError, Interval
from asia.problem.protocol import EarlyStopping, ShownResidual


def _omitted(default: object) -> Any:
    """A field that is left out of the record where it has this value."""
    return Field(exclude_if=lambda value: value == default)


def _named(*names: str) -> Any:
    """A field with its name and those that it had in older ledgers."""
    return Field(validation_alias=AliasChoices(*names))


_Finite = Annotated[float, Field(allow_inf_nan=False)]
_FailedChecks = Annotated[tuple[str, ...], _omitted(())]

# Fits besides the first one of a candidate.


@dataclass(frozen=True)
class Fit:
    """A candidate fitted once more, from a seed that the evaluator chose.

    Retests, confirmations and ablations are fitted on every fold. A refit is fitted on all training
    records. A repetition is fitted on one fold, with the seed of the first fit.
    """

    seed: int = 0
    """Number of the seed; 0 is that of the search, and stands for any in older ledgers."""
    purpose: Literal["retest", "confirmation", "ablation", "refit", "repetition"] = "retest"
    """As where it is recorded; older ledgers say `retest` of all."""
    value: Annotated[_Finite | None, _named("value", "error", "ratio")] = None
    """V; of a refit its error on the training records in the metric of V, of a repetition its error
    over that of the first fit. None where there is none."""
    folds: Annotated[tuple[_Finite, ...], _omitted(())] = ()
    failed: Annotated[str, _omitted(""), _named("failed", "objection")] = ""
    """Why it is not used; "" where nothing speaks against it."""
    experiment: Annotated[int, _omitted(0)] = 0
    """The candidate, of a confirmation."""
    variant: Annotated[str, _omitted("")] = ""
    """Name of the variant of the best candidate, of an ablation."""
    source: Annotated[ArtifactName, _omitted("")] = ""
    """Source of that variant."""
    digest: Annotated[str, _omitted("")] = ""
    """Digest of its normalised AST."""
    fold: Annotated[int, _omitted(0)] = 0
    """The fold of a repetition, 1-based."""
    blocks: Annotated[tuple[tuple[float, ...], ...], _omitted(())] = ()
    """Part of each block of held-out samples in the score of a confirmation, one tuple a fold."""
    same: Annotated[bool, _omitted(False)] = False
    """True if every simulation is bitwise that of the first fit: the seed has no effect."""
    disagreement: Annotated[float | None, _omitted(None)] = None
    """Root mean square of the difference of a refit from the ensemble on the training records, over
    the standard deviation of the output, mean over the outputs; None where one of the two gives no
    answer."""
    seconds: Annotated[float, _omitted(0.0)] = field(default=0.0, compare=False)
    event: Literal["fit"] = "fit"


# What the gain of the best candidate is due to.


@dataclass(frozen=True)
class LeftOut:
    """The best candidate without what one experiment of its lineage changed."""

    experiment: int
    """The experiment that brought the change."""
    loss: Interval | None = None
    """Increase of V without the change, with a 95 % interval over the seeds; None if not known."""
    detail: str = ""


@dataclass(frozen=True)
class Ablated:
    """Contributions of the changes to the gain of a search."""

    best: Annotated[int, _named("best", "winner")]
    """The incumbent of the search."""
    baseline: int
    """The experiment that it is compared with."""
    seeds: int
    """Fits of a variant that depends on the seed."""
    crossing: Attribution | None
    """Model and training of the two crossed; None where that cannot be had."""
    detail: str
    left_out: tuple[LeftOut, ...] = ()
    """Each change of the lineage, the first one first."""
    event: Literal["ablated"] = "ablated"


# Requests, answers and token usage of language models and coding agents.


@dataclass(frozen=True)
class Usage:
    """Tokens and cost of a language model."""

    input_tokens: int = 0
    output_tokens: int = 0
    cached_tokens: int = 0
    """The part of `input_tokens` that the provider had cached."""
    cost: float | None = None
    """USD; None where it is not known."""
    turns: int = 0

    @property
    def tokens(self) -> int:
        """Input and output together."""
        return self.input_tokens + self.output_tokens


@dataclass(frozen=True)
class Exchanged:
    """A request to a language model and its reply. Headers are not kept."""

    experiment: int
    path: str
    request: ArtifactName
    response: ArtifactName
    status: int
    """HTTP status; 0 when there was no reply."""
    usage: Usage | None = None
    event: Literal["exchanged"] = "exchanged"


@dataclass(frozen=True)
class Streamed:
    """Output lines of an agent that runs as a command, as they came, in an artifact."""

    session: int
    lines: ArtifactName
    event: Literal["streamed"] = "streamed"


@dataclass(frozen=True)
class SessionStarted:
    """A command agent's process begins."""

    session: int
    grant: float | None
    agent: Annotated[str, _omitted("")] = ""
    """Its name, where a search has several."""
    event: Literal["session_started"] = "session_started"


@dataclass(frozen=True)
class SessionEnded:
    """A command agent's process has ended."""

    session: int
    outcome: str
    usage: Usage | None
    event: Literal["session_ended"] = "session_ended"


# The top candidates of a finished search fitted again, and what that says.


@dataclass(frozen=True)
class ConfirmedCandidate:
    """One candidate with its repeated fits."""

    experiment: int
    first: float
    """V of the search's own fit, by which it was chosen."""
    value: Interval
    """V over the repeats alone; V of the search where fits do not depend on the seed."""
    spread: float | None
    """Standard deviation of V over the repeats; 0 where fits do not depend on the seed, None where
    there are fewer than two."""
    repeats: int
    """Repeats that have a score."""
    failed: int
    deterministic: bool
    best_rank: int
    """1 plus the candidates that are better, beyond doubt."""
    worst_rank: int
    """The number of candidates less those that are worse, beyond doubt."""


@dataclass(frozen=True)
class ConfirmedPair:
    """Two candidates against each other."""

    first: int
    second: int
    difference: Interval
    """V of the second less that of the first, over the same folds, blocks and seeds."""

    @property
    def apart(self) -> bool:
        """Return whether the first candidate is significantly better."""
        return self.difference.low > 0.0


@dataclass(frozen=True)
class Confirmed:
    """Result of repeated fits of the best candidates."""

    best: Annotated[int, _named("best", "winner")]
    """The incumbent of the search."""
    seeds: int
    """Repeats of a candidate whose fits depend on the seed."""
    tried: int
    """Candidates with a score and a source of their own, of which the handed-over one was
    the best."""
    level: float
    """The level at which all differences hold together."""
    candidates: tuple[ConfirmedCandidate, ...]
    """The lowest V first."""
    pairs: tuple[ConfirmedPair, ...]
    noise: float | None
    """Standard deviation of V over seeds, pooled over the candidates; None if not known."""
    expected: ExpectedError | None
    """The error to expect of the best candidate's fold models, as the search fitted them, on a new
    record, in the measure of V; None where it is not known."""
    expected_level: float = 0.9
    ensemble: Interval | None = None
    """The same of the mean of the fold models' simulations; None if not known."""
    failed: tuple[int, ...] = ()
    """Experiments all of whose repeats failed; they are not ranked."""
    after_unsealing: bool = False
    """True if the sealed test had been opened before."""
    event: Literal["confirmed"] = "confirmed"


# The models that a search ends with, and how they were compared.


Use = Literal["ensemble", "refit", "stack"]


@dataclass(frozen=True)
class RefitCheck:
    """Errors of the fold models and of each start of the refit on the training records."""

    fold_errors: tuple[float | None, ...]
    """The error of each fold model, in the metric of V; None where it gives no answer."""
    ensemble_error: float | None
    """The error of the mean of their answers; None where one gives none."""
    fold_disagreement: float | None
    """Root mean square of the difference of a fold model from the mean of the others, over the
    standard deviation of the output, mean over fold models and outputs; None where one gives no
    answer, or where there is one fold."""
    starts: tuple[Fit, ...]
    kept: int | None = None
    """The start that is the refit, 1-based; None where there is no refit."""


@dataclass(frozen=True)
class StackMember:
    """The ensemble of the fold models of an experiment, as a part of a stack."""

    experiment: int
    weight: float
    """The share of its simulation; those of all members add up to 1."""


@dataclass(frozen=True)
class Stack:
    """A weighted mean of the ensembles of several experiments."""

    members: tuple[StackMember, ...]
    """The largest weight first."""
    value: float
    """V by nested cross-validation: each fold is judged with weights chosen on the other folds."""
    folds: tuple[float, ...]


@dataclass(frozen=True)
class Feedback:
    """Inputs that follow earlier outputs in the training records, and a best candidate that was
    fitted as if they did not."""

    inputs: tuple[str, ...]
    pole: float | None
    """Largest modulus of the poles of a linear one-step model, where it is unstable."""
    declared: Annotated[bool, _omitted(False)] = False
    """[loop] names the feedback."""
    sound: Annotated[int | None, _omitted(None)] = None
    """Experiment of least V whose fit takes the loop into account."""


@dataclass(frozen=True)
class StressTest:
    """Simulation of a model on training inputs in other combinations."""

    model: Use
    experiment: int
    """Its experiment; of a stack the member with the largest weight."""
    reach: float | None
    """Largest distance of an output from the middle of its training range, in half ranges; None
    where the model diverges or fails."""
    output: str
    """Name of that output."""
    linear: float | None
    """Largest distance for the best linear model; None where it was not asked."""
    outcome: Literal["bounded", "drifts", "diverges"]
    """drifts: far away, but no faster than the measured outputs move, as an integrator does."""


BOUNDED_REACH = 5.0
"""Reach up to which a model is bounded, in half ranges."""


# The course of a search: its start, its experiments, its end.


Status = Literal[
    "keep", "inconclusive", "mixed", "unconfirmed", "discard", "crash", "timeout", "invalid"
]
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
    problem: str
    agent: str
    seed: int
    experiments: int
    hours: float | None
    """Budget of wall-clock hours; None is open."""
    outputs: tuple[str, ...]
    lock_digest: str
    """sha256 of the run's `problem.lock.toml`."""
    protocol_digest: str
    test_digest: str | None
    """Commits the sealed test before experiment 1; None when the problem has no test."""
    isolation: str
    isolation_notes: tuple[str, ...]
    """Protection that this isolation level lacks, for display."""
    environment: dict[str, str]
    """Python, platform and package versions."""
    early_stopping: EarlyStopping = "inner"
    """With `validation`, candidates saw their score on the held-out parts: V is not leak-free."""
    agent_settings: dict[str, str] = field(default_factory=dict[str, str])
    guard_digest: str | None = None
    """Commits the guard records; None when the problem has none."""
    layers: tuple[str, ...] = ()
    """The layers of the isolation that were in force."""
    salt: str = ""
    """Seeds the choice of cases that new bests are checked on; never shown to agents."""
    isolation_strict: bool = False
    """True if folds were fitted sequentially, so that none could inform another."""
    lessons: ArtifactName | None = None
    """The lessons of earlier searches, in older ledgers only."""
    folds: tuple[str, ...] = ()
    """Description of the held-out part of each fold; () in older ledgers."""
    residuals: ShownResidual = "train"
    """Residuals that agents saw: with `held_out`, those of the held-out samples."""
    legs: Annotated[tuple[()], _omitted(())] = ()
    ladder: Annotated[None, _omitted(None)] = None
    stop_folds: Annotated[Literal[False], _omitted(False)] = False
    """Settings of older ledgers, which are refused where one is set."""
    retests: int = 0
    """The most fits from other seeds of a candidate about to be kept, which must then be better by
    the significance threshold; 0 where one fit decides, as in older ledgers."""
    parallel: Annotated[int, _omitted(1)] = 1
    """Maximum number of concurrent experiments. Each is proposed once all but the last `parallel` -
    1 before it have their results.
    """
    device: Annotated[Literal["cpu", "gpu"], _omitted("cpu")] = "cpu"
    """`gpu` in older ledgers only, where candidates trained networks on one."""
    gate: Annotated[bool, _omitted(False)] = False
    """True if the agent can read the training records, so that V alone is no evidence and the gain
    of a new best must be confirmed; False in older ledgers."""
    retest_limit: Annotated[float | None, _omitted(None)] = None
    """V over that of the linear reference from which on a candidate is not fitted from other seeds;
    None in older ledgers, where all are."""
    by_folds: Annotated[bool, _omitted(False)] = False
    """True if a new best must also be better over the held-out samples of all folds by more than
    chance, and clearly worse in none; False in older ledgers."""
    event: Literal["started"] = "started"

    @property
    def isolation_words(self) -> str:
        """The level, and whether folds ran one after the other."""
        return f"{self.isolation}, strict" if self.isolation_strict else self.isolation


@dataclass(frozen=True)
class ReferenceScored:
    """Score of a reference model."""

    name: str
    outcome: Outcome
    failed_checks: _FailedChecks = field(default=(), compare=False)
    structure: Annotated[tuple[int, int] | None, _omitted(None)] = None
    """Order and delay of a linear model, where all folds have the same; in ledgers that name no
    `source`."""
    source: Annotated[str, _omitted("")] = ""
    """Candidate of a linear model, where it is another one than the usual baseline."""
    event: Literal["reference", "rung"] = "reference"
    """Older ledgers say `rung`."""


@dataclass(frozen=True)
class Proposed:
    """A candidate about to be evaluated."""

    experiment: int
    parent: int | None
    """The experiment it was made from."""
    phase: Phase
    family: str
    title: str
    hypothesis: str
    expected: str
    """Expected V, in the words of the agent."""
    source: ArtifactName
    digest: str
    """Digest of its normalised AST."""
    ticket: str = ""
    """The submission it came by; "" where an agent was asked."""
    remark: str = ""
    """Comment of the agent on the state of the search, for display; "" for none."""
    fair: Annotated[bool, _omitted(False)] = False
    """True if the linear model is scored in its place where that is as good."""
    agent: Annotated[str, _omitted("")] = ""
    """Name of the one that proposed it, in a search of several agents."""
    event: Literal["proposed"] = "proposed"


@dataclass(frozen=True)
class Variant:
    """A setting that a candidate left open, or its linear model, compared on inner held-out parts
    of the training records."""

    name: str
    error: float | None = None
    """Metric as it enters V, mean over the parts; None where a fit or simulation failed."""
    failed: str = ""
    """Reason of a failure."""
    behind: float = 0.0
    """How much larger it is than that of the best variant, mean over the parts."""
    deviation: float = 0.0
    """Standard error of that difference, or of the best one's error if that is smaller."""
    chosen: bool = False
    """Whether its source was scored: the first variant that is no further behind than that."""


def _with_scores(fields: Any) -> Any:
    """Join the scores of the folds with their records, which older ledgers hold apart. Records
    without a score are left out."""
    if isinstance(fields, dict) and "folds" in fields:
        known: dict[str, Any] = dict(fields)
        records, outcome = known.pop("folds"), dict(known["outcome"])
        if records and len(outcome.get("folds", ())) == len(records):
            pairs = zip(outcome["folds"], records, strict=True)
            outcome["folds"] = [{**score, **record} for score, record in pairs]
        return {**known, "outcome": outcome}
    return fields


@dataclass(frozen=True)
class Evaluated:
    """Outcome of a candidate."""

    experiment: int
    status: Status
    outcome: Outcome
    output: ArtifactName | None
    """Its prints; None where it printed nothing."""
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
    retests: tuple[Fit, ...] = ()
    """Its fits from other seeds; () where it was not about to be kept."""
    threshold: Annotated[float | None, _named("threshold", "floor")] = None
    """Required improvement of the mean over seeds; None without incumbent or if one fit decides."""
    lowest: bool = False
    """True if V of the first fit was the lowest so far and its model passed the checks of a final
    model. False if one fit decides, and in older ledgers.
    """
    elapsed: Annotated[float | None, _omitted(None)] = None
    """Seconds that the search waited for it, decision included; None where one experiment runs at
    a time, which takes `seconds`."""
    failed_checks: _FailedChecks = field(default=(), compare=False)
    confirmation: Annotated[Confirmation | None, _omitted(None)] = None
    """Gain of a new best where nobody could read the answers; None where it was not asked."""
    variants: Annotated[tuple[Variant, ...], _omitted(())] = ()
    """Variants that were compared before the candidate was scored, from simple to free."""
    source: Annotated[ArtifactName | None, _omitted(None)] = None
    """The variant that was scored; None for the candidate as it was proposed."""
    event: Literal["evaluated"] = "evaluated"
    _earlier = model_validator(mode="before")(_with_scores)

    @property
    def folds(self) -> tuple[FoldRecord, ...]:
        """The records of all folds; () where one of them failed."""
        return self.outcome.folds


@dataclass(frozen=True)
class Landed:
    """The first fit of an experiment that ended before those proposed earlier had their results. It
    waits for its turn; a search that is killed meanwhile takes it up from here."""

    experiment: int
    outcome: Outcome
    output: ArtifactName | None
    seconds: float
    """Duration of the fit and its simulations."""
    validation_scores: int = 0
    variants: Annotated[tuple[Variant, ...], _omitted(())] = ()
    source: Annotated[ArtifactName | None, _omitted(None)] = None
    """As in `Evaluated`."""
    event: Literal["landed"] = "landed"
    _earlier = model_validator(mode="before")(_with_scores)

    @property
    def folds(self) -> tuple[FoldRecord, ...]:
        """The records of all folds; () where one of them failed."""
        return self.outcome.folds


@dataclass(frozen=True)
class Extended:
    """The budget was raised."""

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
    """Note of the user to the agent, visible from the next proposal on."""

    text: str
    event: Literal["steered"] = "steered"


@dataclass(frozen=True)
class Noted:
    """A note or tags of a user, for people. Agents do not see them."""

    author: str
    text: str
    """The note, or the reason of the tags."""
    experiment: Annotated[int, _omitted(0)] = 0
    """The experiment that it is about; 0 for the run."""
    tags: Annotated[tuple[str, ...], _omitted(())] = ()
    """Tags that it adds."""
    removed: Annotated[tuple[str, ...], _omitted(())] = ()
    """Tags that it takes away."""
    event: Literal["noted"] = "noted"


@dataclass(frozen=True)
class Refitted:
    """The best candidate fitted once more on all training data."""

    experiment: int
    model: ArtifactName | None
    """None when that fit failed, or when no start is worth using; see `fold`."""
    detail: str
    """Why there is none."""
    again: Fit | None = None
    """The repetition of one fold; None in older ledgers."""
    spent: tuple[TimeSpent, ...] = field(default=(), compare=False)
    check: RefitCheck | None = None
    """Comparison of the refit with the fold models; None in older ledgers."""
    stack: Stack | None = None
    """The weighted mean of several experiments; None where it would be the best candidate alone."""
    use: Use | None = None
    """The model to use; None in older ledgers."""
    reason: str = ""
    """Why this one, in a sentence."""
    fold: Annotated[int, _omitted(0)] = 0
    """The fold whose model takes the place of the refit, 1-based; 0 for a refit."""
    estimates: ArtifactName | None = None
    """Estimates of its parameters; None where it gives none, and in older ledgers."""
    stress: tuple[StressTest, ...] = ()
    """Stress tests in the order in which models were considered; () in older ledgers."""
    feedback: Annotated[Feedback | None, _omitted(None)] = None
    cause: Annotated[str, _omitted("")] = ""
    """Why no candidate beats the mean of the output; "" where one does."""
    failed_checks: _FailedChecks = field(default=(), compare=False)
    event: Literal["refitted"] = "refitted"


# The guard records and the sealed test.


@dataclass(frozen=True)
class GuardScore:
    """The ensemble of an experiment's fold models on the guard records."""

    experiment: int
    outcome: Outcome
    """The search's metric over the standard deviations of the training records."""


@dataclass(frozen=True)
class GuardLooked:
    """The guard records were looked at."""

    look: int
    scores: tuple[GuardScore, ...]
    pick: int | None
    """The best of them on the guard records."""
    spent: tuple[TimeSpent, ...] = field(default=(), compare=False)
    total: Annotated[Confirmation | None, _omitted(None)] = None
    """Gain of the final best over the first one; None where it cannot be had, and in older
    ledgers."""
    event: Literal["guard"] = "guard"


@dataclass(frozen=True)
class TestedModel:
    """Scores of one model on the sealed test."""

    scores: tuple[TestScore, ...]
    y_hat: ArtifactName
    mee: MeeTable | None = None
    """The table of Mean Euclidean Errors, where the protocol asks for one."""
    error: Annotated[float | None, _omitted(None)] = None
    """The search's metric as it enters V, over the standard deviations of the training outputs;
    None in older ledgers."""


@dataclass(frozen=True)
class TestBands:
    """The output bands of the model to use, on the sealed test."""

    model: Use
    level: float
    """The share of measured outputs that the bands are meant to hold."""
    covered: tuple[float, ...]
    """The share of the scored samples that they hold, one an output."""
    outside: float
    """The share of the scored samples outside the region of validity."""
    lower: ArtifactName
    """Their lower edges, one (lengths[i], ny) array a trajectory."""
    upper: ArtifactName


@dataclass(frozen=True)
class Unsealing:
    """The sealed test is about to be opened; from here on the search is over."""

    experiment: int
    test_digest: str
    opened_before: tuple[str, ...]
    """Other runs known to the user that had opened the same test before, with the time."""
    process_consent: bool = False
    """True if the user agreed although candidates ran at level process and could read it."""
    event: Literal["unsealing"] = "unsealing"


@dataclass(frozen=True)
class Unsealed:
    """Result of the sealed test."""

    experiment: int
    test_digest: str
    channels: tuple[str, ...]
    trajectories: tuple[str, ...]
    lengths: tuple[int, ...]
    """Samples of each, from the first simulated one on."""
    skip: int
    """Samples at the start of each that the scores leave out."""
    measured: ArtifactName
    """The test outputs, one (lengths[i], ny) array a trajectory."""
    ensemble: TestedModel | Failure
    refit: TestedModel | Failure | None
    """The best candidate fitted on all training data."""
    horizon: int | None = None
    """Samples of a window, None for long simulations. A trajectory's windows stand one after the
    other; the last may repeat some samples."""
    stack: TestedModel | Failure | None = None
    """The weighted mean of several experiments; None where the search has none."""
    bands: TestBands | None = None
    """Bands of the model to use; None if a fold model does not simulate the test."""
    failed_checks: _FailedChecks = ()
    event: Literal["unsealed"] = "unsealed"


# The validation report of a finished model: what each check said.


@dataclass(frozen=True)
class Validated:
    """All checks of the model to use."""

    experiment: int
    model: Use
    record: str
    """The new record that was simulated; "" for what the folds held out."""
    record_digest: str
    """Digest of that record; "" without one."""
    checks: tuple[RecordedCheck, ...]
    curves: ArtifactName
    passed: int
    doubtful: int
    failed: int
    worst: str = ""
    """The check to look at first; "" where all pass."""
    after_unsealing: bool = False
    """True if the sealed test had been opened before."""
    event: Literal["validated"] = "validated"


Event = (
    Started | ReferenceScored | Proposed | Evaluated | Landed | Extended | Stopped
    | Resumed | Steered | Noted | Exchanged | Streamed | SessionStarted | SessionEnded | Refitted
    | GuardLooked | Unsealing | Unsealed | Fit | Confirmed | Ablated | Validated
)  # fmt: skip

adapter: TypeAdapter[Event] = TypeAdapter(Annotated[Event, Field(discriminator="event")])
