"""Published results of a benchmark, for problems that come with them."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from importlib import resources

from asia.errors import InternalError

_COLUMNS = ["year", "method", "authors", "test_rmse", "source"]


@dataclass(frozen=True)
class Entry:
    """A published result; `test_rmse` in the unit of the output, `source` where it stands."""

    year: int
    method: str
    authors: str
    test_rmse: float
    source: str


def leaderboard(problem_name: str) -> tuple[Entry, ...]:
    """Published results of a built-in problem in the order of the list; empty when it has none."""
    problems = {p.name: p for p in resources.files("asia").joinpath("problems").iterdir()}
    if problem_name not in problems:
        return ()
    file = problems[problem_name].joinpath("leaderboard.csv")
    if not file.is_file():
        return ()
    lines = [x for x in file.read_text("utf-8").splitlines() if x and not x.startswith("#")]
    reader = csv.DictReader(lines, strict=True)
    if reader.fieldnames != _COLUMNS:
        raise InternalError(f"leaderboard of '{problem_name}' has columns {reader.fieldnames}")
    return tuple(
        Entry(int(r["year"]), r["method"], r["authors"], float(r["test_rmse"]), r["source"])
        for r in reader
    )
