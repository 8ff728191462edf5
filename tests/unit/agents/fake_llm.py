"""A scripted OpenAI-compatible server on loopback: real HTTP, made-up answers."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

PROMPT_TOKENS = 1000
REPLY_TOKENS = 200


@dataclass(frozen=True)
class Told:
    """One answer of the server. body: instead of a chat completion with `text`."""

    text: str | None = ""
    status: int = 200
    headers: dict[str, str] = field(default_factory=dict)
    body: object = None
    finish: str = "stop"

    def content(self) -> bytes:
        if self.body is not None:
            return self.body if isinstance(self.body, bytes) else json.dumps(self.body).encode()
        if self.status != 200:
            return json.dumps({"error": {"message": f"made up {self.status}"}}).encode()
        return json.dumps({
            "id": "made-up",
            "object": "chat.completion",
            "created": 1,
            "model": "made-up",
            "choices": [{
                "index": 0,
                "message": {"role": "assistant", "content": self.text},
                "finish_reason": self.finish,
            }],
            "usage": {
                "prompt_tokens": PROMPT_TOKENS,
                "completion_tokens": REPLY_TOKENS,
                "total_tokens": PROMPT_TOKENS + REPLY_TOKENS,
                "prompt_tokens_details": {"cached_tokens": 10},
            },
        }).encode()  # fmt: skip


@dataclass
class FakeServer:
    """Answers in order; with none left it says 500. `asked` holds the requests as they came."""

    answers: list[Told]
    asked: list[dict[str, Any]] = field(default_factory=list)
    keys: list[str] = field(default_factory=list)
    models: tuple[str, ...] = ("made-up",)
    url: str = ""

    def answer(self, body: bytes, key: str) -> Told:
        self.asked.append(json.loads(body))
        self.keys.append(key)
        return self.answers.pop(0) if self.answers else Told(status=500)


@contextmanager
def fake_llm(answers: Sequence[Told], port: int = 0) -> Iterator[FakeServer]:
    server = FakeServer(list(answers))

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["content-length"]))
            self._send(server.answer(body, self.headers.get("authorization", "")))

        def do_GET(self) -> None:
            known = self.path.endswith("/models")
            listed = [{"id": name, "object": "model"} for name in server.models]
            self._send(Told(body={"data": listed}) if known else Told(status=404))

        def _send(self, told: Told) -> None:
            content = told.content()
            self.send_response(told.status)
            for name, value in {"content-type": "application/json", **told.headers}.items():
                self.send_header(name, value)
            self.send_header("content-length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None:
            del format, args

    with ThreadingHTTPServer(("127.0.0.1", port), Handler) as http:
        http.daemon_threads = True
        server.url = f"http://127.0.0.1:{http.server_address[1]}/v1"
        thread = threading.Thread(target=http.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        try:
            yield server
        finally:
            http.shutdown()
            thread.join()


def said(source: str, *, family: str = "made up", title: str = "made up", more: str = "") -> Told:
    """An answer in the form that was asked for."""
    return Told(
        f"HYPOTHESIS: made up\nEXPECTED: made up\nFAMILY: {family}\nTITLE: {title}\n{more}"
        f"```python\n{source}```\n"
    )
