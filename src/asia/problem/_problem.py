"""A problem as the rest of ASIA sees it, and handles to its data. Holds no test outputs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from asia.data._trajectory import Array, Signal, Trajectory
from asia.data.sources import Channels, Source
from asia.problem._budget import Budget
from asia.problem.physics.types import Physics
from asia.protocol._rules import ProtocolRule


@dataclass(frozen=True)
class TestSource:
    """How to open the test records; never their values."""

    source: Source | None
    """Where they lie; None when the problem has no test data."""
    sha256: str | None = None
    """What the data must hash to, known once they were sealed."""


@dataclass(frozen=True)
class Seal:
    """What may be known of the test records before they are opened."""

    sha256: str | None
    """Digest of all values; None when the problem has no test data."""
    names: tuple[str, ...] = ()
    """Names of the records."""
    lengths: tuple[int, ...] = ()
    """Their numbers of samples."""
    shared_samples: int = 0
    """Test samples inside runs of consecutive samples, inputs and outputs, that also occur in a
    training record."""
    guard: str | None = None
    """Digest of the guard records; None without any."""


@dataclass(frozen=True, eq=False)
class Problem:
    """What a search is about."""

    name: str
    """Part of the run's name."""
    description: str
    """The system in plain English; "" for none."""
    sampling_time: float
    """s."""
    inputs: tuple[Signal, ...]
    """The inputs, in the order of `Trajectory.u`."""
    outputs: tuple[Signal, ...]
    """The outputs, in the order of `Trajectory.y`."""
    train: tuple[Trajectory, ...]
    """The records the search may use."""
    data: Source
    """Where the records come from."""
    test: TestSource
    """Handle for the one opener of test data."""
    protocol: ProtocolRule
    """How V and the test metric are computed."""
    budget: Budget
    """What the search may spend."""
    physics: Physics | None = None
    """The person's equations."""
    baseline: str | None = None
    """Source of the problem's own first candidate."""
    truth: tuple[Array, ...] | None = None
    """Noise-free outputs (T, ny) of the training records; for simulated systems only."""
    warnings: tuple[str, ...] = ()
    """Doubts about the data, in plain words."""
    notes: str = ""
    """What the literature says of such systems, for agents that read."""
    strategies: str = ""
    """What to try, in plain words, for agents that read."""
    guard_sha256: str | None = None
    """What the records that stand guard must hash to, known once a run has begun."""

    @property
    def channels(self) -> Channels:
        """Which channels of the data are read."""
        return Channels(self.inputs, self.outputs, self.sampling_time)


def kept_places(problem: Problem) -> tuple[Path, ...]:
    """Files and folders that neither candidates nor agents may read: plain test records, or the
    key of encrypted ones, and guard records. Raises UserError for data that are not on this
    machine."""
    source = problem.test.source
    test = () if source is None else source.places("test")
    return (*test, *problem.data.places("guard"))


def record_places(problem: Problem) -> tuple[Path, ...]:
    """Files and folders with the training records, which hold what a fold keeps from its
    candidate. Raises as `kept_places`."""
    return problem.data.places("train")
