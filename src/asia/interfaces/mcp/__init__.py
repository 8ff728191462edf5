"""A search as a server of the Model Context Protocol.

The server is a thin adapter over a desk: a submission is a file in the run directory, the search
that empties the queue is a process of its own, and nothing else is state. It may die at any time.
Importing this package is cheap: the MCP SDK, an extra, is loaded when a server is made.
"""

from __future__ import annotations

from importlib.util import find_spec

from asia.errors import UserError
from asia.interfaces.mcp.answers import AGENT, Opened, open_search
from asia.interfaces.mcp.config import CLIENTS, client_configuration

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
