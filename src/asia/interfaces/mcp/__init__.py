"""A search as a server of the Model Context Protocol.

The server is a thin adapter over a desk: a submission is a file in the run directory, the search
that empties the queue is a process of its own, and nothing else is state. It may die at any time.
Importing this package is cheap: the MCP SDK, an extra, is loaded when a server is made.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from asia.errors import UserError
from asia.interfaces.mcp.config import CLIENTS, client_configuration
from asia.interfaces.workspace.process import SearchRequest, prepare_request, start_search
from asia.interfaces.workspace.server import RunDesk
from asia.problem.problem import Problem

__all__ = [
    "AGENT",
    "CLIENTS",
    "Opened",
    "client_configuration",
    "open_search",
    "require_sdk",
    "serve_http",
    "serve_stdio",
]

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
    desk = RunDesk(prepared.directory, start_search)
    return Opened(desk, prepared.problem, prepared.directory)


def require_sdk() -> None:
    """Raises UserError where the extra is not installed."""
    if find_spec("mcp") is None or find_spec("mcp_types") is None:
        raise UserError(
            "asia agent mcp needs the extra mcp: pip install '.[mcp]' in a clone of ASIA"
        )


def serve_stdio(opened: Opened) -> None:
    """Serve until the client closes the connection."""
    from asia.interfaces.mcp.server import make_server

    make_server(opened).run()


def serve_http(opened: Opened, address: str, token_variable: str | None) -> None:
    """Serve until interrupted. address: HOST:PORT on this machine, port 0 for any free one.

    The bearer token is taken out of the environment variable `token_variable`; None makes one up
    and prints it on stderr. Raises UserError for another host or a token that is too short.
    """
    from asia.interfaces.mcp.http import serve

    serve(opened, address, token_variable)
