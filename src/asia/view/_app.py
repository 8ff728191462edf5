"""Routes of the pages and their contents."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from importlib import resources
from typing import Final

from anyio.to_thread import run_sync
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from asia.errors import UserError
from asia.report.pieces import page_style, said, tag
from asia.view._followed import RunFolder, Snapshot
from asia.view._steer import tell
from asia.view._streams import Streams
from asia.view.pages.comparison import comparison_page, comparison_part
from asia.view.pages.experiment import experiment_page, experiment_part, overlay_part
from asia.view.pages.frame import whole_page
from asia.view.pages.news import digest_of
from asia.view.pages.rows import FIRST, experiment_rows
from asia.view.pages.run import progress_part, run_page, section_part
from asia.view.pages.runs import runs_page, runs_table

_KINDS: Final = {".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
_STATIC: Final = ("view.css", "view.js", "zoom.js", "icon.svg")
_LONGEST_BODY: Final = 20_000


def make_app(folder: RunFolder, streams: Streams, token: str) -> Starlette:
    """Return the web application for a folder of runs. `TokenOnly` must wrap it."""
    pages = _Pages(folder, streams, token)
    routes = [
        Route("/", pages.listed),
        Route("/events", pages.list_events),
        Route("/static/{name}", pages.static),
        Route("/compare", pages.compare),
        Route("/compare/part", pages.compare_part),
        Route("/runs/{run}", pages.run),
        Route("/runs/{run}/events", pages.run_events),
        Route("/runs/{run}/curve", pages.curve),
        Route("/runs/{run}/rows", pages.rows),
        Route("/runs/{run}/sections/{key}", pages.section),
        Route("/runs/{run}/experiments/{number:int}", pages.experiment),
        Route("/runs/{run}/experiments/{number:int}/part", pages.experiment_part),
        Route("/runs/{run}/experiments/{number:int}/overlays/{index:int}", pages.overlay),
        Route("/runs/{run}/{what}", pages.steer, methods=["POST"]),
    ]
    return Starlette(routes=routes, exception_handlers={UserError: pages.refuse})


@dataclass(frozen=True)
class _Pages:
    """A method an address. Those that are not coroutines run in threads."""

    folder: RunFolder
    """The runs."""
    streams: Streams
    """Open event streams."""
    token: str
    """Token that a page sends with a command of the user."""

    def _snapshot(self, request: Request, *, with_records: bool = False) -> Snapshot:
        return self.folder.get(request.path_params["run"]).snapshot(with_records=with_records)

    def listed(self, request: Request) -> Response:
        """The list of runs."""
        listed = self.folder.listed()
        digest = digest_of(runs_table(listed))
        return HTMLResponse(runs_page(self.folder.folder, listed, digest, self.token))

    def run(self, request: Request) -> Response:
        """The page of a run."""
        return HTMLResponse(run_page(self._snapshot(request), self.token))

    def curve(self, request: Request) -> Response:
        """V of every experiment, drawn."""
        return HTMLResponse(progress_part(self._snapshot(request).subject))

    def rows(self, request: Request) -> Response:
        """Earlier experiments for the list."""
        before, most = (_number(request, key) for key in ("before", "most"))
        subject = self._snapshot(request).subject
        return HTMLResponse(experiment_rows(subject, before, most or FIRST))

    def section(self, request: Request) -> Response:
        """A section of the report."""
        found = section_part(self._snapshot(request, with_records=True), request.path_params["key"])
        return Response(status_code=204) if found is None else HTMLResponse(found)

    def experiment(self, request: Request) -> Response:
        """The page of an experiment."""
        snapshot = self._snapshot(request, with_records=True)
        return HTMLResponse(experiment_page(snapshot, request.path_params["number"], self.token))

    def experiment_part(self, request: Request) -> Response:
        """Send the content of the experiment's page."""
        number = request.path_params["number"]
        return HTMLResponse(experiment_part(self._snapshot(request, with_records=True), number))

    def overlay(self, request: Request) -> Response:
        """Some samples of a held-out simulation, drawn."""
        number, index = (request.path_params[key] for key in ("number", "index"))
        first, last = (_number(request, key) for key in ("first", "last"))
        snapshot = self._snapshot(request, with_records=True)
        return HTMLResponse(overlay_part(snapshot, number, index, first or 0, last))

    def compare(self, request: Request) -> Response:
        """Two runs side by side."""
        return HTMLResponse(comparison_page(self._pair(request), self.token))

    def compare_part(self, request: Request) -> Response:
        """Send the content of the comparison's page."""
        return HTMLResponse(comparison_part(self._pair(request)))

    def _pair(self, request: Request) -> list[Snapshot]:
        names = request.query_params.getlist("run")
        if len(names) != 2:
            raise UserError(f"expected two runs to compare, got {len(names)}")
        return [self.folder.get(name).snapshot(with_records=True) for name in names]

    async def run_events(self, request: Request) -> Response:
        """Stream the changes of a run."""
        followed = await run_sync(self.folder.get, request.path_params["run"])
        return _stream(self.streams.of_run(followed, _mark(request)))

    async def list_events(self, request: Request) -> Response:
        """The list of runs, whenever it changes."""
        return _stream(self.streams.of_list(self.folder, _mark(request)))

    async def steer(self, request: Request) -> Response:
        """Pass a command of the user to the search."""
        text = await _body(request)
        snapshot = await run_sync(self._snapshot, request)
        words = await run_sync(tell, snapshot.run, request.path_params["what"], text)
        return JSONResponse({"words": words})

    def static(self, request: Request) -> Response:
        """Styles and scripts."""
        name = request.path_params["name"]
        if name == "page.css":
            return Response(page_style(), media_type=_KINDS[".css"])
        if name not in _STATIC:
            return Response(status_code=404)
        file = resources.files("asia").joinpath("view", "static", name)
        return Response(file.read_bytes(), media_type=_KINDS[name[name.rindex(".") :]])

    def refuse(self, request: Request, error: Exception) -> Response:
        """Send the message of an error."""
        words = str(error)
        if request.method == "POST":
            return JSONResponse({"words": words}, 409)
        main = (tag("h1", "This cannot be shown"), tag("p", said(words, 1000)))
        page = whole_page("Not shown", (("Searches", "/"),), main, self.token)
        return HTMLResponse(page, 404)


def _number(request: Request, key: str) -> int | None:
    """A count that the address names; None where it names none."""
    text = request.query_params.get(key, "")
    return int(text) if text.isdecimal() and len(text) < 16 else None


def _mark(request: Request) -> str:
    """Return the state that the page shows: the last message that it received, else the state it
    was loaded with.
    """
    return request.headers.get("last-event-id") or request.query_params.get("mark", "")


def _stream(messages: AsyncIterator[str]) -> Response:
    return StreamingResponse(messages, media_type="text/event-stream")


async def _body(request: Request) -> str:
    """Raises UserError where it is too long."""
    found = b""
    async for part in request.stream():
        found += part
        if len(found) > _LONGEST_BODY:
            raise UserError(f"a note has at most {_LONGEST_BODY} bytes")
    return found.decode("utf-8", "replace")
