"""The run that a server takes submissions for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from asia.drive import RunDesk, SearchRequest, prepare_request, start_search
from asia.problem.load import Problem

AGENT = "mcp"


@dataclass(frozen=True)
class Opened:
    """A run that takes submissions, and the problem it is about."""

    desk: RunDesk
    """Submission server of the run."""
    problem: Problem
    """Problem to solve."""
    directory: Path
    """The directory of the run."""


def open_search(request: SearchRequest, runs: Path, name: str | None) -> Opened:
    """Check the request and write it down; no search is started. Raises UserError."""
    prepared = prepare_request(request, runs, name)
    request.save(prepared.directory)
    desk = RunDesk(prepared.directory, start_search)
    return Opened(desk, prepared.problem, prepared.directory)
