"""Everything in ASIA that parses, as functions of bytes.

A target ends quietly, or with one of the errors that its parser promises; any other exception is a
finding. `python fuzz/run.py` and tests/unit/fuzz feed them.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from fuzz import hostile

from asia._source import source_facts
from asia.agents.llm.client import ChatClient, may_have_cost, read_answer, request_key
from asia.agents.llm.reply import MalformedReplyError, read_reply
from asia.agents.llm.settings import LlmSettings
from asia.candidate import check_source
from asia.data.intake.conversion import take_in
from asia.data.intake.sheet import Wanted
from asia.data.store import read_seal
from asia.errors import CandidateError, UserError
from asia.interfaces.coding_agents.presets import Stream
from asia.interfaces.workspace.process import Queue, SearchRequest
from asia.interfaces.workspace.server import RunDesk, tidy
from asia.interfaces.workspace.server import _answer as answer_request
from asia.interfaces.workspace.workspace import Workspace
from asia.ledger.chain import Chain
from asia.ledger.events import Exchanged, Started
from asia.ledger.run import open_run
from asia.problem.load import load_lock, load_problem
from asia.problem.physics import parse_expression

EXPECTED = (UserError, CandidateError, MalformedReplyError)

_NO_ANSWER = b"could not answer"
_TICKET = "00000000000000000001-00000000"
_SOURCE = "def fit(trajectories, context):\n    return None\n"
_PROBLEM = """\
sampling_time = 0.5
inputs = [{ name = "u", unit = "V" }]
outputs = ["y"]
[data]
train = ["train.csv"]
[protocol]
kind = "windows"
horizon = 5
folds = { kind = "contiguous", count = 2 }
past_inputs = 1
past_outputs = 1
[protocol.test]
metrics = ["rmse"]
skip = 0
[budget]
experiments = 3
[physics]
states = ["x"]
[physics.parameters]
a = { min = 1e-3, max = 1.0 }
[physics.dynamics]
x = "-a*sqrt(x) + u"
[physics.observation]
y = "x"
[physics.bounds]
x = { min = 0.0 }
"""
_STARTED = Started(
    run="toy",
    problem="toy",
    agent="mcp",
    seed=0,
    experiments=3,
    hours=None,
    outputs=("y",),
    lock_digest="0" * 64,
    protocol_digest="1" * 64,
    test_digest=None,
    isolation="process",
    isolation_notes=(),
    environment={},
)

_WORDS = {"source": _SOURCE, "hypothesis": "h", "expected": "e", "family": "f", "title": "t"}
_ORDER = {
    "problem": "toy",
    "agent": "mcp",
    "seed": 0,
    "experiments": None,
    "hours": None,
    "early_stopping": None,
    "isolation": None,
}
_FORM = b"HYPOTHESIS: a\nEXPECTED: b\nFAMILY: c\nTITLE: d\nPARENT: #3\n```python\n"
_CLAUDE = {"type": "assistant", "session_id": "a", "message": {"id": "b", "usage": {
    "input_tokens": 1, "output_tokens": 2, "cache_read_input_tokens": 3}}}  # fmt: skip
_ENDED = {"type": "result", "subtype": "success", "total_cost_usd": 0.1, "modelUsage": {
    "m": {"inputTokens": 1, "outputTokens": 2, "cacheReadInputTokens": 3}}}  # fmt: skip
_CODEX = b'{"type":"turn.completed","usage":{"input_tokens":1,"output_tokens":2}}'
_GEMINI = b'{"type":"result","status":"success","stats":{"input_tokens":1,"cached":0}}'
_SAID = {
    "choices": [{"message": {"content": "x"}, "finish_reason": "length"}],
    "usage": {"prompt_tokens": 1, "completion_tokens": 2,
              "prompt_tokens_details": {"cached_tokens": 1}},
}  # fmt: skip
_ASKED = {"model": "m", "base_url": "http://h:1/v1", "temperature": "0.5", "extra_body": "{}"}


@dataclass(frozen=True)
class Target:
    """A parser; seeds: inputs it understands, from which a fuzzer starts."""

    name: str
    parse: Callable[[bytes], None]
    seeds: tuple[bytes, ...]

    def __call__(self, data: bytes) -> None:
        """Raises whatever the parser does not promise."""
        with contextlib.suppress(*EXPECTED):
            self.parse(data)


def temporary_folder(name: str) -> tempfile.TemporaryDirectory[str]:
    """In memory where one can be had."""
    memory = Path("/dev/shm")
    parent = memory if os.access(memory, os.W_OK) else None
    return tempfile.TemporaryDirectory(prefix=f"asia-fuzz-{name}-", dir=parent)


class Place:
    """A folder, in memory where one can be had; the same files are written again and again. path:
    where it is to be made, None for a temporary one that ends with this object."""

    def __init__(self, path: Path | None = None) -> None:
        self._made = None if path else temporary_folder("parsers")
        self.path = path or Path(self._made.name if self._made else "")
        self.path.mkdir(exist_ok=True)
        rows = np.random.default_rng(0).normal(size=(60, 2)).tolist()
        table = "\n".join(["u,y", *(f"{u!r},{y!r}" for u, y in rows)])
        (self.path / "train.csv").write_text(table)
        (self.path / "description.md").write_text("A toy.")

    def put(self, name: str, data: bytes) -> Path:
        """Write a file."""
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        return path


NAMES = (
    "problem", "lock", "csv", "expression", "seal", "ledger", "request", "submission", "order",
    "workspace", "reply", "source", "stream", "completion", "settings", "frames",
)  # fmt: skip


def make_targets(place: Place) -> dict[str, Target]:
    """All targets by name; they write below `place`."""
    found = (
        *_problem_targets(place),
        *_run_targets(place),
        *_model_targets(),
        Target("frames", hostile.parse_frames, hostile.seeds()),
    )
    return {target.name: target for target in found}


def _problem_targets(place: Place) -> tuple[Target, ...]:
    def problem(data: bytes) -> None:
        load_problem(place.put("problem.toml", data))

    def lock(data: bytes) -> None:
        load_lock(place.put("problem.lock.toml", data))

    def csv(data: bytes) -> None:
        path = place.put("record.csv", data)
        take_in([path], Wanted(("u",), ("y",)), "train", 0.5)

    def expression(data: bytes) -> None:
        parse_expression(data.decode("utf-8", "replace"), "physics.dynamics.x")

    def seal(data: bytes) -> None:
        read_seal(place.put("test.sealed", data))

    texts = _PROBLEM.encode()
    header = 'name = "toy"\ndescription = "A toy."\n'
    digests = f'[digests]\ntrain = ["{"0" * 64}"]\ndescription = "0"\nprotocol = "0"\n'
    return (
        Target("problem", problem, (texts, b'[data]\nsource = "nanodrone"\n')),
        Target("lock", lock, ((header + _PROBLEM + digests).encode(),)),
        Target(
            "csv",
            csv,
            (
                b"time,u,y\n0,1,2\n0.5,3,4\n1,5,6\n",
                b't;u;"y"\n0;1,5;2\n0,5;2,5;3\n',
                "u\ty\n1\t2\n".encode("utf-16"),
            ),
        ),
        Target(
            "expression",
            expression,
            (b"-k1*sqrt(x1) + k4*u", b"clip(arctan2(x, 2)**0.5, -1e3, max(1, 2, x))"),
        ),
        Target("seal", seal, _seal_seeds()),
    )


def _seal_seeds() -> tuple[bytes, ...]:
    head = {
        "format": "asia-sealed-1",
        "key": "0" * 16,
        "sha256": "0" * 64,
        "inputs": ["u"],
        "outputs": ["y"],
        "sampling_time": 0.5,
        "files": [{"name": "c.csv", "bytes": 3, "samples": 20}],
        "shared_samples": 0,
        "payload_sha256": hashlib.sha256(b"gAAAAA==").hexdigest(),
    }
    return (json.dumps(head).encode() + b"\ngAAAAA==",)


def _run_targets(place: Place) -> tuple[Target, ...]:
    queued = place.path / "queued"
    with Chain(queued / "ledger.jsonl") as chain:
        chain.append(_STARTED)
    line = (queued / "ledger.jsonl").read_bytes()
    desk = RunDesk(queued)

    def ledger(data: bytes) -> None:
        raw = data[1:] if data[:1] == b"\0" else _chained(data)
        view = open_run(place.put("run/ledger.jsonl", raw).parent).view
        _ = (view.usage, view.best, view.complete, view.seconds, view.pending)

    def request(data: bytes) -> None:
        said = answer_request(desk, data.rstrip(b"\n") + b"\n")
        json.loads(said)
        assert _NO_ANSWER not in said, said

    def submission(data: bytes) -> None:
        place.put(f"other/control/queue/{_TICKET}.json", data)
        proposal = Queue(place.path / "other").get(_TICKET)
        if proposal is not None:
            check_source(tidy(proposal).source)

    def order(data: bytes) -> None:
        path = place.put("other/control/order.json", data)
        SearchRequest.find(path.parents[1])

    def workspace(data: bytes) -> None:
        Workspace.find(place.put("workspace/.asia/workspace.json", data).parents[1])

    return (
        Target("ledger", ledger, (b"\0" + line, line, line + _events())),
        Target(
            "request",
            request,
            (
                json.dumps({"op": "submit", **_WORDS, "parent": 1}).encode(),
                b'{"op": "submission", "ticket": "00000000000000000001-00000000"}',
                b'{"op": "source", "experiment": 1}',
                b'{"op": "progress"}',
            ),
        ),
        Target("submission", submission, (json.dumps({**_WORDS, "parent": None}).encode(),)),
        Target("order", order, (json.dumps(_ORDER).encode(),)),
        Target("workspace", workspace, (b'{"run": "/nowhere"}', b'{"run": null}')),
    )


def _chained(data: bytes) -> bytes:
    """A ledger of these events, whose chain is in order: whoever can write it can do that."""
    lines: list[bytes] = []
    prev = "0" * 64
    for raw in data.splitlines():
        try:
            body = json.loads(raw)
        except (ValueError, RecursionError):
            body = None
        if isinstance(body, dict):
            body = {k: v for k, v in body.items() if k not in ("self", "seq", "prev")}
            body = {"seq": len(lines), "prev": prev, "time": "2026-01-01T00:00:00.000", **body}
            with contextlib.suppress(ValueError):
                own = hashlib.sha256(_canonical(body)).hexdigest()
                raw = _canonical({**body, "self": own})
        lines.append(raw)
        prev = hashlib.sha256(raw).hexdigest()
    return b"".join(raw + b"\n" for raw in lines)


def _canonical(body: Mapping[str, object]) -> bytes:
    text = json.dumps(body, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    return text.encode()


def _events() -> bytes:
    fold = {"value": 0.5, "rmse": [0.5], "mae": [0.5], "fit_index": [50.0], "r2": [None]}
    events = (
        {
            "event": "proposed", "experiment": 1, "parent": None, "phase": "baseline",
            "family": "linear", "title": "t", "hypothesis": "h", "expected": "e",
            "source": "0" * 64, "digest": "1",
        },
        {
            "event": "evaluated", "experiment": 1, "status": "keep",
            "outcome": {"value": 0.5, "folds": [fold]}, "folds": [], "output": None,
            "seconds": 1.0,
        },
        {"event": "stopped", "reason": "budget"},
        {"event": "steered", "text": "more"},
        {"event": "exchanged", "experiment": 1, "path": "/", "request": "0", "response": "0",
         "status": 200, "usage": {"input_tokens": 1, "output_tokens": 2}},
        {"event": "session_ended", "session": 1, "outcome": "success", "usage": None},
        {"event": "refitted", "experiment": 1, "model": None, "detail": ""},
        {"event": "unsealing", "experiment": 1, "test_digest": "0",
         "opened_before": []},
    )  # fmt: skip
    return b"".join(json.dumps(event).encode() + b"\n" for event in events)


def _model_targets() -> tuple[Target, ...]:
    client = object.__new__(ChatClient)
    client._settings = LlmSettings("m", "http://127.0.0.1:1/v1")

    def reply(data: bytes) -> None:
        read_reply(data[1:].decode("utf-8", "replace"), cut=data[:1] == b"\1")

    def source(data: bytes) -> None:
        text = data.decode("utf-8", "surrogateescape")
        # Here, and not in the process that reads sources, where no fuzzer sees the way taken.
        with contextlib.suppress(SyntaxError, ValueError):
            source_facts(text)

    def stream(data: bytes) -> None:
        told = Stream(("claude", "codex", "gemini")[data[0] % 3 if data else 0])
        for line in data[1:].decode("utf-8", "replace").splitlines():
            told.feed(line)

    def completion(data: bytes) -> None:
        read_answer(data)
        client._usage(data)
        request_key("/v1/chat/completions", data)
        may_have_cost(Exchanged(1, "/", "0", "0", 0), data)

    def settings(data: bytes) -> None:
        try:
            given = json.loads(data)
        except (ValueError, RecursionError):
            return
        if isinstance(given, dict) and all(isinstance(v, str) for v in given.values()):
            LlmSettings.from_record(given).record()

    return (
        Target(
            "reply", reply, (b"\0" + _FORM + _SOURCE.encode() + b"```\n", b"\0<think>a</think>")
        ),
        Target("source", source, (_SOURCE.encode(), b"try:\n  from a import fit\nexcept E: pass")),
        Target(
            "stream",
            stream,
            (
                b"\0" + json.dumps(_CLAUDE).encode() + b"\n" + json.dumps(_ENDED).encode(),
                b"\1" + _CODEX,
                b"\2" + _GEMINI,
            ),
        ),
        Target("completion", completion, (json.dumps(_SAID).encode(), b'{"error": "ReadTimeout"}')),
        Target("settings", settings, (json.dumps(_ASKED).encode(),)),
    )
