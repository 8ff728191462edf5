"""Where records come from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


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


@dataclass(frozen=True)
class SealedSource:
    """Test records in an encrypted store at an absolute path; sha256: the digest of the records
    that were sealed."""

    path: Path
    sha256: str


DataSource = CsvSource | BenchmarkSource | SimulatedSource | NanodroneSource


@dataclass(frozen=True)
class GuardSource:
    """How to read the guard records; never their values. One of: CSV files at absolute paths, names
    of a benchmark's training records, which are then no training records, or how many records of a
    simulated system. sha256: as in `TestSource`."""

    paths: tuple[Path, ...] = ()
    names: tuple[str, ...] = ()
    count: int = 0
    sha256: str | None = None

    def __bool__(self) -> bool:
        return bool(self.paths or self.names or self.count)
