"""Published results of the benchmarks."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cache
from importlib import resources

from asia.errors import InternalError

_COLUMNS = [
    "benchmark",
    "year",
    "method",
    "authors",
    "test_rmse",
    "training_time",
    "white_to_black_box",
    "source",
]
_NONE = "-"


@dataclass(frozen=True)
class Entry:
    """A published result."""

    year: int
    """The year of publication."""
    method: str
    """The method or model."""
    authors: str
    """Authors of the result."""
    figures: tuple[float | None, ...]
    """Test RMSE for each figure of the benchmark, in its official unit; None where none is
    published."""
    source: str
    """Source of the published figure."""
    training_time: str = ""
    """The class of training time; "" where it is not known."""

    @property
    def test_rmse(self) -> float:
        """The only figure, of a benchmark that has one."""
        (value,) = self.figures
        assert value is not None
        return value

    @property
    def words(self) -> str:
        """Method, authors and year."""
        return f"{self.method} ({self.authors}, {self.year})"


@cache
def leaderboard(problem_name: str) -> tuple[Entry, ...]:
    """Published results of a built-in problem in the order of the list; empty when it has none."""
    file = resources.files("asia").joinpath("problems", "leaderboards.csv")
    lines = [x for x in file.read_text("utf-8").splitlines() if x and not x.startswith("#")]
    reader = csv.DictReader(lines, strict=True)
    if reader.fieldnames != _COLUMNS:
        raise InternalError(f"leaderboards.csv has columns {reader.fieldnames}")
    return tuple(
        Entry(
            int(row["year"]),
            row["method"],
            row["authors"],
            tuple(None if v == _NONE else float(v) for v in row["test_rmse"].split()),
            row["source"],
            row["training_time"],
        )
        for row in reader
        if row["benchmark"] == problem_name
    )
