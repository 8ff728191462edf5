"""A desk on a unix socket, for drivers that must not see the run directory.

One JSON object a line each way: {"op": ..., ...} -> {"ok": ...} or {"error": sentence}. A request
is at most `MOST_BYTES` long, and is checked as what it is: words from an agent.
"""

from __future__ import annotations

import json
import os
import socket
import socketserver
import threading
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from asia.agents import Proposal
from asia.drive._desk import Desk, Job, Result, Standing
from asia.errors import UserError

MOST_BYTES = 1_000_000
_SILENCE_SECONDS = 30.0
_CONNECTIONS = 32
_SLOT_SECONDS = 1.0


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class _Submit(_Request):
    op: Literal["submit"] = "submit"
    source: str
    hypothesis: str
    expected: str = ""
    family: str = ""
    title: str = ""
    parent: int | None = None


class _Job(_Request):
    op: Literal["job", "withdraw"]
    ticket: str


class _Source(_Request):
    op: Literal["source"] = "source"
    experiment: int


class _Plain(_Request):
    op: Literal["results", "standing"]


_requests: TypeAdapter[_Submit | _Job | _Source | _Plain] = TypeAdapter(
    Annotated[_Submit | _Job | _Source | _Plain, Field(discriminator="op")]
)
_results = TypeAdapter(tuple[Result, ...])
_standing = TypeAdapter(Standing)


class DeskServer:
    """Serves a desk at `path` until closed; a context manager."""

    def __init__(self, path: Path, desk: Desk) -> None:
        self.path = path
        path.unlink(missing_ok=True)
        handler = _handler(desk)
        self._server = _Server(str(path), handler)
        os.chmod(path, 0o600)
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *raised: object) -> None:
        # A server that never served would wait for its own end for ever.
        if self._thread.ident is not None:
            self._server.shutdown()
        self._server.server_close()
        self.path.unlink(missing_ok=True)


class _Server(socketserver.ThreadingUnixStreamServer):
    daemon_threads = True

    def __init__(self, path: str, handler: type[socketserver.StreamRequestHandler]) -> None:
        super().__init__(path, handler)
        self._slots = threading.BoundedSemaphore(_CONNECTIONS)

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._slots.acquire(timeout=_SLOT_SECONDS):
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except BaseException:
            self._slots.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._slots.release()


def _handler(desk: Desk) -> type[socketserver.StreamRequestHandler]:
    class Handler(socketserver.StreamRequestHandler):
        timeout = _SILENCE_SECONDS

        def handle(self) -> None:
            try:
                raw = self.rfile.readline(MOST_BYTES + 1)
                self.wfile.write(_answer(desk, raw) + b"\n")
            except OSError:
                return

    return Handler


def _answer(desk: Desk, raw: bytes) -> bytes:
    try:
        if len(raw) > MOST_BYTES or not raw.endswith(b"\n"):
            raise UserError(f"a request is one line of at most {MOST_BYTES} bytes")
        answer = {"ok": _call(desk, _requests.validate_json(raw))}
        return json.dumps(answer, allow_nan=False).encode()
    except UserError as error:
        answer = {"error": str(error)}
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        answer = {"error": f"the request is not one that is known: {first['msg']}"}
    except Exception as error:  # noqa: BLE001 - the border: every request has an answer
        answer = {"error": f"the search could not answer ({type(error).__name__}); try again"}
    return json.dumps(answer).encode()


def _call(desk: Desk, request: _Submit | _Job | _Source | _Plain) -> Any:
    match request:
        case _Submit():
            words = request.model_dump(exclude={"op"})
            return asdict(desk.submit(Proposal(**words)))
        case _Job(op="job"):
            return asdict(desk.job(request.ticket))
        case _Job():
            return asdict(desk.withdraw(request.ticket))
        case _Source():
            return desk.source(request.experiment)
        case _Plain(op="results"):
            return [asdict(result) for result in desk.results()]
        case _Plain():
            return asdict(desk.standing())


class SocketDesk:
    """The other end: a `Desk`."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def submit(self, proposal: Proposal) -> Job:
        """See `Desk.submit`."""
        words = asdict(proposal)
        del words["ticket"]
        return Job(**self._ask({"op": "submit", **words}))

    def job(self, ticket: str) -> Job:
        """See `Desk.job`."""
        return Job(**self._ask({"op": "job", "ticket": ticket}))

    def withdraw(self, ticket: str) -> Job:
        """See `Desk.withdraw`."""
        return Job(**self._ask({"op": "withdraw", "ticket": ticket}))

    def results(self) -> tuple[Result, ...]:
        """See `Desk.results`."""
        return _results.validate_python(self._ask({"op": "results"}))

    def source(self, experiment: int) -> str:
        """See `Desk.source`."""
        return self._ask({"op": "source", "experiment": experiment})

    def standing(self) -> Standing:
        """See `Desk.standing`."""
        return _standing.validate_python(self._ask({"op": "standing"}))

    def _ask(self, request: dict[str, Any]) -> Any:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as channel:
            channel.settimeout(_SILENCE_SECONDS)
            try:
                channel.connect(str(self._path))
                channel.sendall(json.dumps(request).encode() + b"\n")
                with channel.makefile("rb") as stream:
                    raw = stream.readline()
            except OSError as error:
                raise UserError(
                    f"the search does not answer at {self._path} ({error.strerror or error}): it "
                    "has ended, or was never started"
                ) from None
        try:
            answer = json.loads(raw)
        except (ValueError, RecursionError):
            raise UserError(
                f"the search hung up at {self._path} without an answer: it has ended, or too many "
                "ask at once; try again"
            ) from None
        if "error" in answer:
            raise UserError(str(answer["error"]))
        return answer["ok"]
