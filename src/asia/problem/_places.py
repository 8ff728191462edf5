"""Where on this machine the test records of a problem are."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from asia.data._store import key_folder
from asia.data.sources.benchmarks import cache_folder
from asia.data.sources.kinds import (
    BenchmarkSource,
    CsvSource,
    DataSource,
    NanodroneSource,
    SealedSource,
)
from asia.data.sources.nanodrone import flight_paths
from asia.problem._problem import Problem


def kept_places(problem: Problem) -> tuple[Path, ...]:
    """Files and folders that neither candidates nor agents may read: plain test records, or the
    key of encrypted ones, and files of guard records. Raises UserError for a benchmark that is not
    on this machine."""
    source = problem.test.source
    test = () if source is None else _places(source, "test")
    return (*test, *problem.guard.paths)


def record_places(problem: Problem) -> tuple[Path, ...]:
    """Files and folders with the training records, which hold what a fold keeps from its
    candidate. Raises as `kept_places`."""
    return _places(problem.data, "train")


def _places(source: DataSource | SealedSource, part: Literal["train", "test"]) -> tuple[Path, ...]:
    match source:
        case CsvSource(paths):
            return paths
        case SealedSource():
            return (key_folder(),)
        case BenchmarkSource(name):
            return (cache_folder(name),)
        case NanodroneSource():
            return flight_paths(part)
        case _:
            return ()


def kept_words(problem: Problem) -> str:
    """How the test is kept, in plain words; "" without a test."""
    match problem.test.source:
        case CsvSource():
            return (
                "in plain files; isolation alone keeps candidates off them, and asia init --seal "
                "would encrypt them"
            )
        case SealedSource():
            return "encrypted; the search does not need its key"
        case BenchmarkSource() | NanodroneSource():
            return (
                "a public download: the plain files stay on this machine, isolation alone keeps "
                "candidates off them, and whoever knows the data set knows them"
            )
        case None:
            return ""
        case _:
            return "simulated from a seed that the problem names: whoever has ASIA can repeat it"
