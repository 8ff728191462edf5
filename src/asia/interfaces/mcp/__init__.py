"""A search as a server of the Model Context Protocol.

The server is a thin adapter over a desk: a submission is a file in the run directory, the search
that empties the queue is a process of its own, and nothing else is state. It may die at any time.
Importing this package is cheap: the MCP SDK, an extra, is loaded when a server is made.
"""

from dataclasses import dataclass
from pathlib import Path

from asia._plugins import is_installed
from asia.errors import UserError
from asia.interfaces.workspace.process import SearchRequest, prepare_request, start_search
from asia.interfaces.workspace.server import RunDesk
from asia.judge.sandbox.types import Isolation
from asia.problem.problem import Problem

AGENT = "mcp"


@dataclass(frozen=True)
class Opened:
    """A run that takes submissions, and the problem it is about."""

    desk: RunDesk
    problem: Problem
    directory: Path


def open_search(request: SearchRequest, runs: Path, name: str | None) -> Opened:
    """Check the request and write it down; no search is started. Raises UserError."""
    prepared = prepare_request(request, runs, name)
    request.save(prepared.directory)
    level = Isolation(prepared.started.isolation)
    desk = RunDesk(prepared.directory, start_search, level)
    return Opened(desk, prepared.problem, prepared.directory)


def require_sdk() -> None:
    """Raises UserError where the extra is not installed."""
    if not (is_installed("mcp") and is_installed("mcp_types")):
        raise UserError(
            "asia agent mcp needs the extra mcp: pip install '.[mcp]' in a clone of ASIA"
        )
