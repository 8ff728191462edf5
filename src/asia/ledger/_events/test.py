"""The guard records and the sealed test."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from asia._stopwatch import TimeSpent
from asia.ledger._events.final import Use
from asia.scoring import Failure, MeeTable, Outcome, TestScore


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
    """Scores of the last new bests on the guard records."""
    pick: int | None
    """The best of them on the guard records."""
    spent: tuple[TimeSpent, ...] = field(default=(), compare=False)
    """Profile of the time, see `Evaluated`."""
    event: Literal["guard"] = "guard"


@dataclass(frozen=True)
class TestedModel:
    """Scores of one model on the sealed test."""

    scores: tuple[TestScore, ...]
    """Score of each test metric."""
    y_hat: str
    """Artifact of its simulation."""
    mee: MeeTable | None = None
    """The table of Mean Euclidean Errors, where the protocol asks for one."""


@dataclass(frozen=True)
class TestBands:
    """The output bands of the model to use, on the sealed test."""

    model: Use
    """The model to use."""
    level: float
    """The share of measured outputs that the bands are meant to hold."""
    covered: tuple[float, ...]
    """The share of the scored samples that they hold, one an output."""
    outside: float
    """The share of the scored samples outside the region of validity."""
    lower: str
    """Artifact of their lower edges, one (lengths[i], ny) array a trajectory."""
    upper: str
    """Artifact of their upper edges."""


@dataclass(frozen=True)
class Unsealing:
    """The sealed test is about to be opened; from here on the search is over."""

    experiment: int
    """The winner."""
    test_digest: str
    """Digest of the test."""
    opened_before: tuple[str, ...]
    """Other runs in the same folder that had opened the same test before."""
    process_consent: bool = False
    """True if the user agreed to open the test although candidates ran at level process, where they
    could read it.
    """
    event: Literal["unsealing"] = "unsealing"


@dataclass(frozen=True)
class Unsealed:
    """Result of the sealed test."""

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
    stack: TestedModel | Failure | None = None
    """The weighted mean of several experiments; None where the search has none."""
    bands: TestBands | None = None
    """Coverage of the bands of the model to use; None if a fold model does not simulate the
    test.
    """
    failed_checks: Annotated[tuple[str, ...], Field(exclude_if=lambda value: not value)] = ()
    """Failed checks, see `Evaluated`."""
    event: Literal["unsealed"] = "unsealed"
