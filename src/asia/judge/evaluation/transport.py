"""Messages to and from the machine that fits a fold.

A request is made by the search and may be unpickled there. An answer holds data made by a
candidate: it is JSON and raw numbers, which the search checks against its request.
"""

import hashlib
import json
import math
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from asia._timer import Activity, Seconds
from asia.candidate import Context
from asia.data.segment import Segment
from asia.data.trajectory import Array, Trajectory
from asia.errors import CandidateError, Reason, SandboxError, UserError
from asia.judge.evaluation.findings import FoldFit
from asia.judge.evaluation.requests import secret_of, sessions
from asia.judge.sandbox.types import Isolation, Limits, WorkerKilledError
from asia.problem.folds import Fold
from asia.problem.protocol import ProtocolRule

_HEAD_BYTES = 8

Blob: TypeAlias = bytes | memoryview
"""Raw bytes of a message."""
FoldAttempt: TypeAlias = FoldFit[bytes] | CandidateError
"""A fitted fold, or why there is none."""


@dataclass(frozen=True)
class FoldData:
    """Data for the fit of a fold, the same for all candidates.

    Of the held-out outputs it has the past windows, which candidates receive, and a digest.
    """

    train: tuple[Trajectory, ...]
    held_out: tuple[Segment, ...]
    """The segments without their outputs."""
    sessions: tuple[tuple[int, ...], ...]
    """Cases of each worker, in order: see `requests.sessions`."""
    secret: bytes | None
    """A digest of the held-out outputs, see `requests.simulate_each`."""
    rule: ProtocolRule


@dataclass(frozen=True)
class FoldWork:
    """Work on a fold: everything that its outcome depends on, besides the data that it names."""

    problem: str
    """sha256 of the run's lock file; "" for an evaluation outside a run."""
    data: str
    """sha256 of the `FoldData` as bytes."""
    fold: int
    """1-based."""
    source: str = field(repr=False)
    context: Context = field(repr=False)
    """Context of the candidate, with its seed. The deadline is set on the machine that fits."""
    limits: Limits
    isolation: Isolation
    """The level that must keep the candidate in."""
    layers: tuple[str, ...]
    """The layers of this level that must be in force."""
    alone: bool = False
    """Whether no worker may be started while it runs, since it could tell that one something."""


def fold_data(fold: Fold, rule: ProtocolRule) -> FoldData:
    """Collect the data of a fold: everything but the outputs that it holds out."""
    blocks = fold.held_out
    return FoldData(
        train=fold.train,
        held_out=tuple(block.unmeasured for block in blocks),
        sessions=tuple(map(tuple, sessions(blocks))),
        secret=secret_of(blocks),
        rule=rule,
    )


def encode_data(data: FoldData) -> tuple[str, bytes]:
    """Digest and bytes."""
    raw = pickle.dumps(data, protocol=5)
    return hashlib.sha256(raw).hexdigest(), raw


def decode_data(raw: bytes, digest: str) -> FoldData:
    """The data of a search of our own. Raises SandboxError where they are not those."""
    if hashlib.sha256(raw).hexdigest() != digest:
        raise SandboxError("the data of a fold came as other bytes than the search sent")
    return pickle.loads(raw)


def encode_work(work: FoldWork, installation: Mapping[str, str]) -> bytes:
    """installation: of the search's own machine, compared before anything else is read."""
    body = pickle.dumps(work, protocol=5)
    return _packed({"installation": dict(installation)}, [body])


def installation_of(request: bytes) -> dict[str, str]:
    """That of the machine that sent the request."""
    return _unpacked(request)[0]["installation"]


def decode_work(request: bytes) -> FoldWork:
    """The work in a request of our own search."""
    return pickle.loads(_unpacked(request)[1][0])


def encode_answer(result: FoldAttempt, spent: Seconds) -> bytes:
    """Encode the texts of a candidate as JSON strings, its arrays as raw float64."""
    head: dict[str, Any] = {
        "printed": result.printed,
        "spent": {activity.value: seconds for activity, seconds in spent.items()},
    }
    if isinstance(result, CandidateError):
        return _packed({**head, "reason": result.reason.value, "detail": result.detail}, [])
    head |= {
        "machine": result.machine,
        "isolation": result.isolation,
        "seconds": result.seconds,
        "parameters": result.parameters,
        "memory_mb": result.memory_mb,
        "compile_seconds": result.compile_seconds,
        "numbers": result.numbers,
        "simulate_seconds": result.simulate_seconds,
        "train": len(result.train_y_hat),
    }
    raw = (
        np.ascontiguousarray(array, "<f8").reshape(-1).view(np.uint8).data
        for array in (result.curve, *result.y_hat, *result.train_y_hat)
    )
    return _packed(head, [result.model, *raw])


_TROUBLES: dict[str, type[SandboxError | UserError]] = {
    "user": UserError,
    "killed": WorkerKilledError,
    "sandbox": SandboxError,
}


def encode_trouble(error: SandboxError | UserError) -> bytes:
    """Encode an error in place of an answer: a worker that was killed, or a machine that cannot do
    the work."""
    kind = next(kind for kind, error_type in _TROUBLES.items() if isinstance(error, error_type))
    return _packed({"trouble": kind, "words": str(error)}, [])


def decode_answer(
    reply: bytes, data: FoldData, train: Sequence[tuple[int, int]]
) -> tuple[FoldAttempt, Seconds]:
    """Decode the answer to work on `data`: the fitted fold, and the time that it took.

    Args:
        train: (H, ny) of the blocks of its training records

    Raises:
        SandboxError: for an invalid answer
        UserError: as given to `encode_trouble`
    """
    try:
        head, blobs = _unpacked(reply)
        if "trouble" in head:
            raise _TROUBLES.get(head["trouble"], SandboxError)(str(head["words"]))
        return _answer(head, blobs, data, train)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise SandboxError(f"a worker machine answered what is no answer: {error}") from None


def _answer(
    head: dict[str, Any], blobs: Sequence[bytes], data: FoldData, train: Sequence[tuple[int, int]]
) -> tuple[FoldAttempt, Seconds]:
    result: FoldAttempt
    printed = str(head["printed"])
    if "reason" in head:
        result = CandidateError(Reason(head["reason"]), str(head["detail"]), printed)
    else:
        held_out = [one.y.shape for one in data.held_out]
        shapes = [*held_out, *train]
        if head["train"] != len(train) or len(blobs) != 2 + len(shapes):
            raise ValueError("another number of simulations")
        y_hat = [_floats(raw, shape) for raw, shape in zip(blobs[2:], shapes, strict=True)]
        curve = _floats(blobs[1], (len(blobs[1]) // 16, 2))
        memory = head["memory_mb"]
        result = FoldFit(
            model=bytes(blobs[0]),
            curve=curve,
            printed=printed,
            seconds=float(head["seconds"]),
            parameters=tuple((str(name), float(value)) for name, value in head["parameters"]),
            y_hat=tuple(y_hat[: len(held_out)]),
            train_y_hat=tuple(y_hat[len(held_out) :]),
            memory_mb=None if memory is None else float(memory),
            compile_seconds=float(head["compile_seconds"]),
            numbers=None if head["numbers"] is None else int(head["numbers"]),
            simulate_seconds=float(head["simulate_seconds"]),
            machine=str(head["machine"]),
            isolation=str(head["isolation"]),
        )
    spent = {Activity(k): (float(a), float(b)) for k, (a, b) in head["spent"].items()}
    return result, spent


def _floats(raw: bytes, shape: tuple[int, int]) -> Array:
    if len(raw) != 8 * math.prod(shape):
        raise ValueError(f"{len(raw)} bytes for an array {shape}")
    return np.frombuffer(raw, "<f8").astype(np.float64).reshape(shape)


def _packed(head: dict[str, Any], blobs: Sequence[Blob]) -> bytes:
    text = json.dumps({**head, "lengths": [len(blob) for blob in blobs]}).encode()
    return b"".join((len(text).to_bytes(_HEAD_BYTES, "little"), text, *blobs))


def _unpacked(raw: bytes) -> tuple[dict[str, Any], list[bytes]]:
    end = _HEAD_BYTES + int.from_bytes(raw[:_HEAD_BYTES], "little")
    head: dict[str, Any] = json.loads(raw[_HEAD_BYTES:end])
    blobs: list[bytes] = []
    for length in head["lengths"]:
        blobs.append(raw[end : end + length])
        end += length
    if end != len(raw):
        raise ValueError("its parts have other lengths")
    return head, blobs
