"""A problem as the rest of ASIA sees it, and handles to its data. Holds no test outputs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from asia.problem._types import Array, Budget, Physics, ProtocolRule, Signal, Trajectory


@dataclass(frozen=True)
class CsvSource:
    """Records in CSV files, one a file; absolute paths."""

    paths: tuple[Path, ...]


@dataclass(frozen=True)
class BenchmarkSource:
    """A data set of the package nonlinear-benchmarks, by the name of its loader."""

    benchmark: str


@dataclass(frozen=True)
class SimulatedSource:
    """A system simulated by ASIA's own code; the seed fixes every number."""

    system: str
    seed: int


@dataclass(frozen=True)
class NanodroneSource:
    """The flights of the nanodrone benchmark's repository."""


DataSource = CsvSource | BenchmarkSource | SimulatedSource | NanodroneSource


@dataclass(frozen=True)
class TestSource:
    """How to open the test records; never their values.

    source: None when the problem has no test data. sha256: what the data must hash to, known
    once they were sealed.
    """

    source: DataSource | None
    sha256: str | None = None


@dataclass(frozen=True)
class Seal:
    """What may be known of the test records before they are opened.

    sha256: digest of all values, None when the problem has no test data. names, lengths: of the
    records. shared_samples: test samples inside runs of consecutive samples, inputs and outputs,
    that also occur in a training record.
    """

    sha256: str | None
    names: tuple[str, ...] = ()
    lengths: tuple[int, ...] = ()
    shared_samples: int = 0


@dataclass(frozen=True, eq=False)
class Problem:
    """What a search is about.

    sampling_time in seconds; train: the records the search may use; data: where they came from;
    baseline: source of the problem's own first candidate; truth: noise-free outputs (T, ny) of
    the training records, for simulated systems only; test: handle for the one opener of test
    data; warnings: doubts about the data, in plain words; notes, strategies: what the literature
    says and what to try, in plain words, for agents that read, "" for none.
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
