"""Addresses of the live view, behind an access token."""

from __future__ import annotations

import contextlib
import secrets
from dataclasses import dataclass, replace
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Final
from urllib.parse import parse_qs, quote, urlencode

from anyio.to_thread import run_sync
from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import (
    HTMLResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
    StreamingResponse,
)
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from asia._files import PACKAGE, config_folder, name_of_place, read_private, write_private
from asia.errors import UserError
from asia.interfaces.view.comparison import (
    Compared,
    compared_overlay,
    comparison_page,
    comparison_part,
)
from asia.interfaces.view.followed import RunFolder, Snapshot
from asia.interfaces.view.gallery import gallery_page
from asia.interfaces.view.pages import (
    FIRST,
    GALLERY,
    Chosen,
    digest_of,
    experiment_page,
    experiment_part,
    experiment_rows,
    overlay_part,
    progress_part,
    run_page,
    runs_page,
    runs_table,
    section_part,
    tab_page,
)
from asia.interfaces.view.render import fill, run_address
from asia.interfaces.view.streams import Starter, Streams, tell
from asia.report.page.render import page_style

# Routes of the pages and their contents.


_KINDS: Final = {".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
_STATIC: Final = ("view.css", "view.js", "zoom.js", "icon.svg")
_LONGEST_BODY: Final = 20_000


def make_app(
    folder: RunFolder, streams: Streams, token: str, starter: Starter | None = None
) -> Starlette:
    """Return the web application for a folder of runs. `TokenOnly` must wrap it. starter: what
    starts searches; None where the pages start none."""
    pages = _Pages(folder, streams, token, starter)
    routes = [
        Route("/", pages.listed),
        Route("/events", pages.list_events),
        Route("/runs", pages.start, methods=["POST"]),
        Route("/static/{name}", pages.static),
        Route("/compare", pages.compare),
        Route("/compare/part", pages.compare_part),
        Route("/compare/overlays/{index:int}", pages.compare_overlay),
        Route("/runs/{run}", pages.run),
        Route("/runs/{run}/events", pages.run_events),
        Route("/runs/{run}/curve", pages.curve),
        Route("/runs/{run}/rows", pages.rows),
        Route("/runs/{run}/sections/{key}", pages.section),
        Route("/runs/{run}/experiments/{number:int}", pages.experiment),
        Route("/runs/{run}/experiments/{number:int}/part", pages.experiment_part),
        Route("/runs/{run}/experiments/{number:int}/overlays/{index:int}", pages.overlay),
        Route(f"/runs/{{run}}/{GALLERY}", pages.gallery),
        Route("/runs/{run}/{key}", pages.tab),
        Route("/runs/{run}/{what}", pages.steer, methods=["POST"]),
    ]
    return Starlette(routes=routes, exception_handlers={UserError: pages.refuse})


@dataclass(frozen=True)
class _Pages:
    """A method an address. Those that are not coroutines run in threads."""

    folder: RunFolder
    streams: Streams
    token: str
    """Token that a page sends with a command of the user."""
    starter: Starter | None

    def _snapshot(self, request: Request, *, with_records: bool = False) -> Snapshot:
        return self.folder.get(request.path_params["run"]).snapshot(with_records=with_records)

    def listed(self, request: Request) -> Response:
        listed = self.folder.listed()
        digest = digest_of(runs_table(listed))
        given = self.starter
        start = None if given is None else (given.problems, given.agents)
        return HTMLResponse(runs_page(self.folder.folder, listed, digest, self.token, start))

    def run(self, request: Request) -> Response:
        return HTMLResponse(run_page(self._snapshot(request), self.token, _chosen(request)))

    def curve(self, request: Request) -> Response:
        return HTMLResponse(progress_part(self._snapshot(request).subject))

    def rows(self, request: Request) -> Response:
        after, most = (_number(request, key) for key in ("after", "most"))
        subject = self._snapshot(request).subject
        return HTMLResponse(experiment_rows(subject, _chosen(request), after, most or FIRST))

    def section(self, request: Request) -> Response:
        found = section_part(self._snapshot(request, with_records=True), request.path_params["key"])
        return Response(status_code=204) if found is None else HTMLResponse(found)

    def tab(self, request: Request) -> Response:
        return HTMLResponse(
            tab_page(self._snapshot(request), request.path_params["key"], self.token)
        )

    def gallery(self, request: Request) -> Response:
        snapshot, after = self._snapshot(request, with_records=True), _number(request, "after")
        # Unlike the list, the lowest V first unless the address says otherwise.
        chosen = _chosen(request)
        if "order" not in request.query_params:
            chosen = replace(chosen, order="v")
        return HTMLResponse(gallery_page(snapshot, self.token, chosen, after))

    def experiment(self, request: Request) -> Response:
        snapshot = self._snapshot(request, with_records=True)
        return HTMLResponse(experiment_page(snapshot, request.path_params["number"], self.token))

    def experiment_part(self, request: Request) -> Response:
        number = request.path_params["number"]
        return HTMLResponse(experiment_part(self._snapshot(request, with_records=True), number))

    def overlay(self, request: Request) -> Response:
        number, index = (request.path_params[key] for key in ("number", "index"))
        first, last = (_number(request, key) for key in ("first", "last"))
        snapshot = self._snapshot(request, with_records=True)
        return HTMLResponse(overlay_part(snapshot, number, index, first or 0, last))

    def compare(self, request: Request) -> Response:
        return HTMLResponse(comparison_page(self._compared(request), self.token))

    def compare_part(self, request: Request) -> Response:
        return HTMLResponse(comparison_part(self._compared(request)))

    def compare_overlay(self, request: Request) -> Response:
        first, last = (_number(request, key) for key in ("first", "last"))
        compared, index = self._compared(request), request.path_params["index"]
        return HTMLResponse(compared_overlay(compared, index, first or 0, last))

    def _compared(self, request: Request) -> list[Compared]:
        chosen = [name.rpartition("/") for name in request.query_params.getlist("e")]
        names = dict.fromkeys((*request.query_params.getlist("run"), *(one[0] for one in chosen)))
        found: list[Compared] = []
        for name in names:
            snapshot = self.folder.get(name).snapshot(with_records=True)
            numbers = [int(n) for run, _, n in chosen if run == name and n.isdecimal()]
            found.append(Compared(snapshot, tuple(dict.fromkeys(numbers))))
        if not found:
            raise UserError("there is nothing to compare: choose runs in the list of searches")
        return found

    async def run_events(self, request: Request) -> Response:
        followed = await run_sync(self.folder.get, request.path_params["run"])
        messages = self.streams.of_run(followed, _mark(request))
        return StreamingResponse(messages, media_type="text/event-stream")

    async def list_events(self, request: Request) -> Response:
        messages = self.streams.of_list(self.folder, _mark(request))
        return StreamingResponse(messages, media_type="text/event-stream")

    async def start(self, request: Request) -> Response:
        if self.starter is None:
            raise UserError("these pages start no searches: use asia run")
        text = await _sent_text(request)
        words, name = await run_sync(self.starter.start, self.folder.folder, text)
        return JSONResponse({"words": words, "address": run_address(name)})

    async def steer(self, request: Request) -> Response:
        text = await _sent_text(request)
        snapshot = await run_sync(self._snapshot, request)
        words = await run_sync(tell, snapshot.run, request.path_params["what"], text)
        return JSONResponse({"words": words})

    def static(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name == "page.css":
            return Response(page_style(), media_type=_KINDS[".css"])
        if name not in _STATIC:
            return Response(status_code=404)
        file = PACKAGE / "interfaces" / "view" / "static" / name
        return Response(file.read_bytes(), media_type=_KINDS[name[name.rindex(".") :]])

    def refuse(self, request: Request, error: Exception) -> Response:
        words = str(error)
        if request.method == "POST":
            return JSONResponse({"words": words}, 409)
        trail = (("Searches", "/"),)
        page = fill("refused.html", token=self.token, title="Not shown", trail=trail, words=words)
        return HTMLResponse(page, 404)


async def _sent_text(request: Request) -> str:
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > _LONGEST_BODY:
            raise UserError(f"a request has at most {_LONGEST_BODY} bytes")
    return body.decode("utf-8", "replace")


def _chosen(request: Request) -> Chosen:
    found = (request.query_params.get(key, "")[:200] for key in ("kind", "words", "order"))
    return Chosen(*found)


def _number(request: Request, key: str) -> int | None:
    """A count that the address names; None where it names none."""
    text = request.query_params.get(key, "")
    return int(text) if text.isdecimal() and len(text) < 16 else None


def _mark(request: Request) -> str:
    """Return the state that the page shows: the last message that it received, else the state it
    was loaded with.
    """
    return request.headers.get("last-event-id") or request.query_params.get("mark", "")


# Access control: the pages answer only browsers on this machine that hold the token.
#
# 127.0.0.1 belongs to every process and every user of the machine, agents with a network among
# them, so that reading needs the token too. The printed address contains it; the first answer puts
# it into a cookie. Requests that change a search need it once more, in a header that no other site
# can send.


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
    """Return the token of a folder of runs. It is made once and kept in the user's config folder,
    readable for its owner alone, so that pages that are open find a server that was started again.
    The folder of runs, which may come from somebody else, has no influence on it. Where it cannot
    be kept it is a new one."""
    path = token_path(runs)
    found = (read_private(path) or b"").decode("ascii", "replace").strip()
    if len(found) >= _LEAST_TOKEN and found.isascii():
        return found
    fresh = secrets.token_urlsafe(32)
    with contextlib.suppress(OSError):
        write_private(path, fresh.encode())
    return fresh


def token_path(runs: Path) -> Path:
    """Return the file of the token of a folder of runs."""
    return config_folder() / "view" / f"{name_of_place(runs)}.token"


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
        return parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]

    def _remembered(self, headers: Headers) -> str:
        try:
            found = SimpleCookie(headers.get("cookie", "")).get(self._cookie)
        except CookieError:
            return ""
        return found.value if found is not None else ""

    def _is_token(self, words: str) -> bool:
        return secrets.compare_digest(words.encode("utf-8", "replace"), self._token.encode())
