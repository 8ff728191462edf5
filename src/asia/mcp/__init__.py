"""A search as a server of the Model Context Protocol.

The server is a thin adapter over a desk: a submission is a file in the run directory, the search
that empties the queue is a process of its own, and nothing else is state. It may die at any time.
Importing this package is cheap: the MCP SDK, an extra, is loaded when a server is made.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from asia.drive import Order, RunDesk, prepare_order, start_search
from asia.errors import UserError
from asia.mcp._config import CLIENTS, client_configuration
from asia.problem.load import Problem

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


def require_sdk() -> None:
    """Raises UserError where the extra is not installed."""
    if find_spec("mcp") is None or find_spec("mcp_types") is None:
        raise UserError(
            "asia mcp needs the MCP SDK, which is an extra: pip install 'asia-sysid[mcp]'"
        )


def open_search(order: Order, runs: Path, name: str | None) -> Opened:
    """Check the order and write it down; no search is started. Raises UserError."""
    prepared = prepare_order(order, runs, name)
    order.save(prepared.directory)
    desk = RunDesk(prepared.directory, start_search)
    return Opened(desk, prepared.problem, prepared.directory)


def serve_stdio(opened: Opened) -> None:
    """Until the client closes the connection."""
    from asia.mcp._server import make_server

    make_server(opened).run()


def serve_http(opened: Opened, address: str, token_variable: str | None) -> None:
    """Until interrupted. address: HOST:PORT on this machine, port 0 for any free one. The bearer
    token is taken out of the environment variable, or made up; it is told on stderr then. Raises
    UserError."""
    from asia.mcp._http import serve

    serve(opened, address, token_variable)
