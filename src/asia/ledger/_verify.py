"""Check a run: the chain of records, and every artifact they name."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from asia.errors import UserError
from asia.ledger._events import (
    Evaluated,
    Event,
    Exchanged,
    Proposed,
    Refitted,
    Started,
    Streamed,
    TestRecord,
    Unsealed,
)
from asia.ledger._view import Run, open_run


@dataclass(frozen=True)
class Verified:
    """What was checked. `head` is the sha256 of the last record."""

    records: int
    artifacts: int
    head: str


def verify(directory: Path) -> Verified:
    """Raises UserError that names the first record or artifact that does not hold."""
    run: Run = open_run(directory)
    named: set[str] = set()
    for line in run.lines:
        for digest in _artifacts(line.event):
            try:
                run.store.get(digest)
            except UserError as error:
                raise UserError(f"record {line.seq} of {directory}: {error}") from None
            named.add(digest)
    check_lock(directory, run.view.started)
    raw = (directory / "ledger.jsonl").read_bytes().splitlines()[len(run.lines) - 1]
    return Verified(len(run.lines), len(named), hashlib.sha256(raw).hexdigest())


def check_lock(directory: Path, started: Started) -> None:
    """Raises UserError when the resolved problem is not the one the search began with."""
    path = directory / "problem.lock.toml"
    if not path.is_file():
        raise UserError(f"{path} is missing: the search cannot be told from another")
    if hashlib.sha256(path.read_bytes()).hexdigest() != started.lock_digest:
        raise UserError(f"{path} was changed after the search began")


def _artifacts(event: Event) -> Iterator[str]:
    match event:
        case Proposed():
            yield event.source
        case Evaluated():
            for fold in event.folds:
                yield from (fold.model, fold.y_hat, fold.curve)
            if event.output:
                yield event.output
        case Exchanged():
            yield from (event.request, event.response)
        case Streamed():
            yield event.lines
        case Refitted():
            if event.model:
                yield event.model
        case Unsealed():
            yield event.measured
            for record in (event.ensemble, event.refit):
                if isinstance(record, TestRecord):
                    yield record.y_hat
        case Started() | _:
            return
