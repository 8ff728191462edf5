"""A problem as the rest of ASIA sees it, and handles to its data. Holds no test outputs."""

from __future__ import annotations

from dataclasses import dataclass, field

from asia.data._trajectory import Array, Signal, Trajectory
from asia.data.sources.kinds import DataSource, GuardSource, SealedSource
from asia.problem._budget import Budget
from asia.problem.physics.types import Physics
from asia.protocol._rules import ProtocolRule


@dataclass(frozen=True)
class TestSource:
    """How to open the test records; never their values.

    source: None when the problem has no test data. sha256: what the data must hash to, known
    once they were sealed.
    """

    source: DataSource | SealedSource | None
    sha256: str | None = None


@dataclass(frozen=True)
class Seal:
    """What may be known of the test records before they are opened.

    sha256: digest of all values, None when the problem has no test data. names, lengths: of the
    records. shared_samples: test samples inside runs of consecutive samples, inputs and outputs,
    that also occur in a training record. guard: digest of the guard records, None without any.
    """

    sha256: str | None
    names: tuple[str, ...] = ()
    lengths: tuple[int, ...] = ()
    shared_samples: int = 0
    guard: str | None = None


@dataclass(frozen=True, eq=False)
class Problem:
    """What a search is about.

    sampling_time in seconds; train: the records the search may use; data: where they came from;
    baseline: source of the problem's own first candidate; truth: noise-free outputs (T, ny) of the
    training records, for simulated systems only; test: handle for the one opener of test data;
    guard: handle for the records that no agent sees; warnings: doubts about the data, in plain
    words; notes, strategies: what the literature says and what to try, in plain words, for agents
    that read, "" for none.
    """

    name: str
    description: str
    sampling_time: float
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    train: tuple[Trajectory, ...]
    data: DataSource
    test: TestSource
    protocol: ProtocolRule
    budget: Budget
    physics: Physics | None = None
    baseline: str | None = None
    truth: tuple[Array, ...] | None = None
    warnings: tuple[str, ...] = ()
    notes: str = ""
    strategies: str = ""
    guard: GuardSource = field(default_factory=GuardSource)
