"""Streamable HTTP on this machine, behind a bearer token."""

import hmac
import os
import secrets
import socket
import sys

import uvicorn
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from asia._text import say
from asia.errors import UserError
from asia.interfaces.mcp import Opened
from asia.interfaces.mcp.server import make_server

LOOPBACK = ("127.0.0.1", "::1", "localhost")
LEAST_TOKEN = 16


class BearerOnly:
    """Passes requests that bear the token, answers all others with 401."""

    def __init__(self, app: ASGIApp, token: str) -> None:
        self._app = app
        self._expected = f"Bearer {token}".encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI."""
        if scope["type"] == "http":
            given = [value for name, value in scope["headers"] if name == b"authorization"]
            if len(given) != 1 or not hmac.compare_digest(given[0], self._expected):
                body = {"error": "a bearer token is needed: send Authorization: Bearer TOKEN"}
                refusal = JSONResponse(body, 401, {"WWW-Authenticate": "Bearer"})
                await refusal(scope, receive, send)
                return
        await self._app(scope, receive, send)


def serve(opened: Opened, address: str, token_variable: str | None) -> None:
    """Serve until interrupted.

    Args:
        address: HOST:PORT on this machine, port 0 for any free one
        token_variable: environment variable with the bearer token, which is removed from the
            environment; None for a new token, printed on stderr

    Raises:
        UserError: for another host, or a token that is too short
    """
    host, colon, port = address.rpartition(":")
    host = host.strip("[]")
    if not colon or not port.isdecimal() or int(port) > 65535:
        raise UserError(f"--http {address}: expected HOST:PORT, such as 127.0.0.1:8765")
    if host not in LOOPBACK:
        raise UserError(
            f"--http {address}: expected a host of this machine ({', '.join(LOOPBACK)}), "
            "since the token is not encrypted; from another machine, forward the port: ssh "
            "-L"
        )
    if token_variable is None:
        token = secrets.token_urlsafe(32)
    else:
        # Removed from the environment: the search that is started does not need it.
        token = os.environ.pop(token_variable, "").strip()
        if len(token) < LEAST_TOKEN or not token.isascii() or not token.isprintable():
            raise UserError(
                f"--token-env {token_variable}: expected a token of at least {LEAST_TOKEN} ASCII "
                "characters in that environment variable"
            )
    with _listening(host, int(port)) as listener:
        app = BearerOnly(make_server(opened).streamable_http_app(host=host), token)
        config = uvicorn.Config(app, log_level="warning", ws="none", timeout_graceful_shutdown=2)
        shown = f"[{host}]" if ":" in host else host
        say(f"asia: http://{shown}:{listener.getsockname()[1]}/mcp", file=sys.stderr)
        if token_variable is None:
            say(f"asia: token {token}", file=sys.stderr)
        sys.stderr.flush()
        uvicorn.Server(config).run(sockets=[listener])


def _listening(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise UserError(
            f"--http {host}:{port}: {os.strerror(error.errno or 0)}; choose another port, or 0 for "
            "a free one"
        ) from None
