"""Recorder of the traffic with a language model's server, and its replay.

It is a transport of the HTTP client: all requests pass here, and in a replay none is sent. Bodies
are kept, headers never.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from typing import Any

import httpx2

from asia.agents.view import DivergedError, Journal
from asia.ledger.events import Exchanged, Usage

_NEVER_SENT = ("ConnectError", "ConnectTimeout", "PoolTimeout", "UnsupportedProtocol", "ProxyError")


class Cassette(httpx2.BaseTransport):
    """Transport that answers recorded requests from the record and records all others.

    Answers with an error are recorded and not served again: a resumed search asks anew, and a
    replay needs only the answers that its agent used.

    Args:
        inner: transport of unrecorded requests; None in a replay
        admit: called with a request's body before it is sent; it may raise
        usage_of: reads a response's usage
        secret: removed from all that is kept
    """

    def __init__(
        self,
        journal: Journal,
        inner: httpx2.BaseTransport | None,
        admit: Callable[[bytes], None],
        usage_of: Callable[[bytes], Usage | None],
        secret: str = "",
    ) -> None:
        self._journal, self._inner, self._admit = journal, inner, admit
        self._usage_of = usage_of
        self._secret = secret.encode() if len(secret) >= 8 else b""
        self._experiment = 0
        self._recorded: list[Exchanged] = []

    def rewind(self) -> None:
        """Start a proposal: recorded answers for this experiment are served first."""
        self._experiment = self._journal.experiments + 1
        self._recorded = [
            e
            for e in self._journal.exchanges
            if e.experiment == self._experiment and _answered(e.status)
        ]

    def handle_request(self, request: httpx2.Request) -> httpx2.Response:
        """Return the answer, with its body read."""
        body = self._kept(request.read())
        path = request.url.path
        served = self._serve(path, body)
        if served is not None:
            return _response(200, served)
        if self._inner is None:
            raise DivergedError(self._difference(body))
        self._admit(body)
        try:
            answer = self._inner.handle_request(request)
            content = self._kept(answer.read())
        except httpx2.TransportError as error:
            self._record(path, body, json.dumps({"error": type(error).__name__}).encode(), 0)
            raise
        answer.close()
        self._record(path, body, content, answer.status_code)
        return _response(answer.status_code, content, answer.headers.get("retry-after"))

    def close(self) -> None:
        """Close the connections."""
        if self._inner is not None:
            self._inner.close()

    def _serve(self, path: str, body: bytes) -> bytes | None:
        """Return the next recorded answer to the same request.

        Answers before it belong to requests that are not repeated, because a note of the user came
        between.
        """
        wanted = request_key(path, body)
        for place, exchange in enumerate(self._recorded):
            if request_key(exchange.path, self._journal.get(exchange.request)) == wanted:
                del self._recorded[: place + 1]
                return self._journal.get(exchange.response)
        return None

    def _record(self, path: str, body: bytes, content: bytes, status: int) -> None:
        usage = self._usage_of(content) if _answered(status) else None
        put = self._journal.put
        self._journal.record(
            Exchanged(self._experiment, path, put(body), put(content), status, usage)
        )

    def _kept(self, data: bytes) -> bytes:
        return data.replace(self._secret, b"[key]") if self._secret else data

    def _difference(self, body: bytes) -> str:
        """Describe the first difference between the request and the recorded one."""
        if not self._recorded:
            return f"experiment {self._experiment}: a request more than the record holds"
        there = self._journal.get(self._recorded[0].request).decode("utf-8", "replace")
        here = body.decode("utf-8", "replace")
        pairs = enumerate(zip(there, here, strict=False))
        at = next((i for i, (a, b) in pairs if a != b), min(len(there), len(here)))
        return (
            f"experiment {self._experiment}: the request differs from the one on record at "
            f"character {at}: {here[at : at + 60]!r} instead of {there[at : at + 60]!r}"
        )


def request_key(path: str, body: bytes) -> str:
    """sha256 of method, path and body, its JSON in canonical form."""
    try:
        text = json.dumps(json.loads(body), sort_keys=True, separators=(",", ":"))
    except (ValueError, RecursionError):
        text = body.decode("utf-8", "replace")
    return hashlib.sha256(f"POST {path}\n{text}".encode("utf-8", "surrogatepass")).hexdigest()


def may_have_cost(exchange: Exchanged, content: bytes) -> bool:
    """Return whether the server may have counted tokens for it: answered, or sent and never
    answered."""
    if exchange.status != 0:
        return _answered(exchange.status)
    try:
        kind: Any = json.loads(content).get("error")
    except (ValueError, RecursionError, AttributeError):
        return True
    return kind not in _NEVER_SENT


def _answered(status: int) -> bool:
    return 200 <= status < 300


def _response(status: int, content: bytes, retry_after: str | None = None) -> httpx2.Response:
    headers = {"content-type": "application/json"}
    if retry_after is not None:
        headers["retry-after"] = retry_after
    return httpx2.Response(status, headers=headers, content=content)
