"""Web server on this machine for a folder of runs."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Final
from urllib.parse import quote

import uvicorn

from asia.errors import UserError
from asia.interfaces.view.app import TokenOnly, kept_token, make_app
from asia.interfaces.view.followed import RunFolder
from asia.interfaces.view.streams import Starter, Streams

_HOST: Final = "127.0.0.1"
_END_SECONDS = 1


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
    with _listening(port) as listener:
        bound = listener.getsockname()[1]
        token, streams = kept_token(runs), Streams()
        app = TokenOnly(make_app(RunFolder(runs), streams, token, starter), token, bound)
        config = uvicorn.Config(
            app,
            log_level="error",
            ws="none",
            lifespan="off",
            server_header=False,
            timeout_graceful_shutdown=_END_SECONDS,
        )
        page = "" if run is None else f"runs/{quote(run, safe='')}"
        address = f"http://{_HOST}:{bound}/{page}?token={token}"
        with contextlib.suppress(KeyboardInterrupt):
            _LocalServer(config, streams, partial(on_start, address)).run(sockets=[listener])


class _LocalServer(uvicorn.Server):
    """Says when it has begun. Ends the open streams when it is interrupted: it would wait for
    them."""

    def __init__(
        self, config: uvicorn.Config, streams: Streams, on_start: Callable[[], object]
    ) -> None:
        super().__init__(config)
        self._streams = streams
        self._on_start = on_start

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start the server. From here on an interrupt is a clean end."""
        await super().startup(sockets)
        self._on_start()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """A signal."""
        self._streams.end()
        super().handle_exit(sig, frame)


def _listening(port: int) -> socket.socket:
    try:
        return socket.create_server((_HOST, port))
    except OSError as error:
        raise UserError(
            f"--port {port}: {os.strerror(error.errno or 0)}; another asia view may be there: name "
            "another port, or 0 for a free one"
        ) from None
