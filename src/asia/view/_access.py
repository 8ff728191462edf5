"""Access control: the pages answer only browsers on this machine that hold the token.

127.0.0.1 belongs to every process and every user of the machine, agents with a network among them,
so that reading needs the token too. The printed address contains it; the first answer puts it into
a cookie. Requests that change a search need it once more, in a header that no other site can send.
"""

from __future__ import annotations

import secrets
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Final
from urllib.parse import parse_qs, quote, urlencode

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

TOKEN_HEADER: Final = "x-asia-token"
_LEAST_TOKEN = 16
_HOSTS = ("127.0.0.1", "localhost")
_READS = ("GET", "HEAD")
# Nothing comes from another host, nothing of a candidate runs, no other page frames this one.
_HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; "
        "style-src-attr 'unsafe-inline'; img-src 'self'; connect-src 'self'; "
        "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cache-control": "no-store",
}


def kept_token(runs: Path) -> str:
    """The token of a folder of runs. It is made once and kept there, readable for its owner alone,
    so that pages that are open find a server that was started again. Where it cannot be kept it is
    a new one."""
    path = runs / ".view-token"
    fresh = secrets.token_urlsafe(32)
    try:
        path.touch(mode=0o600, exist_ok=True)
        path.chmod(0o600)
        found = path.read_text("ascii").strip()
        if len(found) >= _LEAST_TOKEN:
            return found
        path.write_text(fresh, "ascii")
    except (OSError, ValueError):
        pass
    return fresh


class TokenOnly:
    """Passes requests that may be made, and refuses all others in words."""

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        self._app = app
        self._token = token
        self._hosts = {f"{host}:{port}" for host in _HOSTS}
        self._cookie = f"asia-view-{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        answer = self._refusal(scope) or self._greeting(scope) or self._app
        await answer(scope, receive, sent)

    def _refusal(self, scope: Scope) -> Response | None:
        """Why the request is not passed; None where it is, or where it brings the token."""
        headers = Headers(scope=scope)
        if headers.get("host", "") not in self._hosts:
            return PlainTextResponse("asia view answers to 127.0.0.1 and localhost only\n", 421)
        if scope["method"] in _READS:
            if self._is_token(self._brought(scope) or self._remembered(headers)):
                return None
            return PlainTextResponse(
                "This page needs the token: open the address that asia view printed.\n", 401
            )
        origin = headers.get("origin")
        own = origin is None or origin.removeprefix("http://") in self._hosts
        if not own or not self._is_token(headers.get(TOKEN_HEADER, "")):
            return PlainTextResponse("the token is missing or wrong\n", 403)
        return None

    def _greeting(self, scope: Scope) -> Response | None:
        """The same address without the token, which the browser keeps from now on."""
        if scope["method"] not in _READS or not self._brought(scope):
            return None
        query = parse_qs(scope["query_string"].decode("latin-1"))
        query.pop("token")
        rest = urlencode(query, doseq=True)
        # A path that begins with two slashes would name another host.
        path = "/" + quote(scope["path"].lstrip("/"))
        answer = RedirectResponse(path + (f"?{rest}" if rest else ""), 303)
        answer.set_cookie(self._cookie, self._token, httponly=True, samesite="strict")
        return answer

    def _brought(self, scope: Scope) -> str:
        found = parse_qs(scope["query_string"].decode("latin-1")).get("token", [])
        return found[0] if found else ""

    def _remembered(self, headers: Headers) -> str:
        try:
            found = SimpleCookie(headers.get("cookie", "")).get(self._cookie)
        except CookieError:
            return ""
        return found.value if found is not None else ""

    def _is_token(self, words: str) -> bool:
        return secrets.compare_digest(words.encode("utf-8", "replace"), self._token.encode())
