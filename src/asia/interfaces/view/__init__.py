"""The page of a run, live: a server on this machine alone that follows ledgers as they grow."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from asia._plugins import is_installed
from asia.errors import UserError

if TYPE_CHECKING:
    from asia.interfaces.view.streams import Starter

__all__ = ["PORT", "require_server", "serve_view"]

PORT = 8731
"""Default port of the pages."""


def require_server() -> None:
    """Raises UserError where the extra is not installed."""
    if not (is_installed("starlette") and is_installed("uvicorn")):
        raise UserError(
            "asia view needs Starlette and uvicorn, which are an extra: "
            "pip install '.[view]' in a clone of ASIA"
        )


def serve_view(
    runs: Path,
    run: str | None,
    port: int,
    on_start: Callable[[str], object],
    starter: Starter | None = None,
) -> None:
    """Serve the runs below `runs` on 127.0.0.1 until interrupted.

    run: whose page the address leads to; None for the list. port: 0 for any free one. on_start is
    called with the address, which bears the token, once it answers. starter: starts searches for
    the pages. Raises UserError where the port is taken.
    """
    from asia.interfaces.view.server import serve

    serve(runs, run, port, on_start, starter)
