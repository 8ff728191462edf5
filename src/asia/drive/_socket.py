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
from asia.drive._answers import DryRunSummary, ExperimentSummary, SearchProgress, Submission
from asia.drive._desk import Desk
from asia.drive._evidence import EvidenceSummary
from asia.errors import UserError
from asia.report import SimulatedCases

MOST_BYTES = 1_000_000
_SILENCE_SECONDS = 30.0
_WORK_SECONDS = 1800.0
_CONNECTIONS = 32
_SLOT_SECONDS = 1.0


class _Call(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class _SubmitCall(_Call):
    op: Literal["submit"] = "submit"
    source: str
    hypothesis: str
    expected: str = ""
    family: str = ""
    title: str = ""
    parent: int | None = None


class _TicketCall(_Call):
    op: Literal["submission", "withdraw"]
    ticket: str


class _ExperimentCall(_Call):
    op: Literal["source", "evidence", "simulated"]
    experiment: int


class _DryRunCall(_Call):
    op: Literal["dry_run"] = "dry_run"
    source: str


class _PlainCall(_Call):
    op: Literal["results", "progress", "attended"]


_AnyCall = _SubmitCall | _TicketCall | _ExperimentCall | _DryRunCall | _PlainCall
_calls: TypeAdapter[_AnyCall] = TypeAdapter(Annotated[_AnyCall, Field(discriminator="op")])
_results = TypeAdapter(tuple[ExperimentSummary, ...])
_evidence = TypeAdapter(EvidenceSummary)
_simulated = TypeAdapter(SimulatedCases)
_progress = TypeAdapter(SearchProgress)
_dry_run = TypeAdapter(DryRunSummary)


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
        answer = {"ok": _call(desk, _calls.validate_json(raw))}
        return json.dumps(answer, allow_nan=False).encode()
    except UserError as error:
        answer = {"error": str(error)}
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        answer = {"error": f"unknown request: {first['msg']}"}
    except Exception as error:  # noqa: BLE001 - the border: every request has an answer
        answer = {"error": f"the search could not answer ({type(error).__name__}); try again"}
    return json.dumps(answer).encode()


def _call(desk: Desk, call: _AnyCall) -> Any:
    match call:
        case _SubmitCall():
            fields = call.model_dump(exclude={"op"})
            return asdict(desk.submit(Proposal(**fields)))
        case _TicketCall(op="submission"):
            return asdict(desk.submission(call.ticket))
        case _TicketCall():
            return asdict(desk.withdraw(call.ticket))
        case _ExperimentCall(op="source"):
            return desk.source(call.experiment)
        case _ExperimentCall(op="simulated"):
            return asdict(desk.simulated(call.experiment))
        case _ExperimentCall():
            return asdict(desk.evidence(call.experiment))
        case _DryRunCall():
            return asdict(desk.dry_run(call.source))
        case _PlainCall(op="results"):
            return [asdict(result) for result in desk.results()]
        case _PlainCall(op="attended"):
            return desk.attended()
        case _PlainCall():
            return asdict(desk.progress())


class SocketDesk:
    """The other end: a `Desk`."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def submit(self, proposal: Proposal) -> Submission:
        """See `Desk.submit`."""
        fields = {n: getattr(proposal, n) for n in _SubmitCall.model_fields if n != "op"}
        return Submission(**self._ask({"op": "submit", **fields}))

    def submission(self, ticket: str) -> Submission:
        """See `Desk.submission`."""
        return Submission(**self._ask({"op": "submission", "ticket": ticket}))

    def withdraw(self, ticket: str) -> Submission:
        """See `Desk.withdraw`."""
        return Submission(**self._ask({"op": "withdraw", "ticket": ticket}))

    def results(self) -> tuple[ExperimentSummary, ...]:
        """See `Desk.results`."""
        return _results.validate_python(self._ask({"op": "results"}))

    def source(self, experiment: int) -> str:
        """See `Desk.source`."""
        return self._ask({"op": "source", "experiment": experiment})

    def evidence(self, experiment: int) -> EvidenceSummary:
        """See `Desk.evidence`."""
        request = {"op": "evidence", "experiment": experiment}
        return _evidence.validate_python(self._ask(request))

    def progress(self) -> SearchProgress:
        """See `Desk.progress`."""
        return _progress.validate_python(self._ask({"op": "progress"}))

    def attended(self) -> bool:
        """See `Desk.attended`."""
        return bool(self._ask({"op": "attended"}))

    def simulated(self, experiment: int) -> SimulatedCases:
        """See `Desk.simulated`."""
        request = {"op": "simulated", "experiment": experiment}
        return _simulated.validate_python(self._ask(request, _WORK_SECONDS))

    def dry_run(self, source: str) -> DryRunSummary:
        """See `Desk.dry_run`."""
        request = {"op": "dry_run", "source": source}
        return _dry_run.validate_python(self._ask(request, _WORK_SECONDS))

    def _ask(self, request: dict[str, Any], seconds: float = _SILENCE_SECONDS) -> Any:
        """The answer, for which it waits so long."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as channel:
            channel.settimeout(seconds)
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
                f"the search closed the connection at {self._path} without an answer: it "
                "has ended, or there are too many requests at once; try again"
            ) from None
        if "error" in answer:
            raise UserError(str(answer["error"]))
        return answer["ok"]
