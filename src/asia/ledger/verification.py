"""Check a run: the chain of records, and every artifact they name."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from asia.errors import UserError
from asia.ledger.artifacts import Artifacts
from asia.ledger.chain import BEGIN, decode, ledger_of, scan
from asia.ledger.events import (
    AblationFit,
    Evaluated,
    Event,
    Exchanged,
    Landed,
    Proposed,
    Refitted,
    Repeated,
    Started,
    Streamed,
    TestedModel,
    Unsealed,
    Validated,
)


@dataclass(frozen=True)
class Verified:
    """Result of a verification. `head` is the sha256 of the last record; `torn` counts the bytes of
    an incomplete record after it, cut off by a crash or still being written.
    """

    records: int
    artifacts: int
    head: str
    torn: int = 0


def verify(directory: Path, *, ledger_alone: bool = False) -> Verified:
    """Raises UserError that names the first record or artifact that does not hold. ledger_alone:
    for a run that was handed on without its artifacts, none of which is looked at."""
    ledger, check = ledger_of(directory), _Check()
    place = BEGIN
    with ledger.open("rb") as stream, Artifacts(directory / "artifacts") as artifacts:
        try:
            for place, raw in scan(stream, str(ledger)):
                record = place.seq - 1
                event = decode(raw, record, str(ledger)).event
                check.add(event, f"event {record} of {directory}")
                for digest in () if ledger_alone else _artifacts(event):
                    artifacts.add(digest, record)
        except UserError:
            # An error in an earlier record is reported first.
            artifacts.check()
            raise
        artifacts.check()
        count = len(artifacts)
    if check.started is None:
        raise UserError(f"{directory}: the ledger is empty: the search was stopped before it began")
    check_lock(directory, check.started)
    torn = ledger.stat().st_size - place.offset
    return Verified(place.seq, count, place.head, torn)


class _Check:
    """Check of each record against those before it. `replay` checks the same, but takes longer
    because it keeps all records.
    """

    def __init__(self) -> None:
        self.started: Started | None = None
        self._proposed: set[int] = set()
        self._pending: set[int] = set()
        self._repeats: set[tuple[int, int]] = set()

    def add(self, event: Event, where: str) -> None:
        """Raises UserError."""
        match event:
            case Proposed():
                self._once(event.experiment, event.experiment not in self._proposed, where)
                self._proposed.add(event.experiment)
                self._pending.add(event.experiment)
            case Evaluated():
                self._once(event.experiment, event.experiment in self._pending, where)
                self._pending.discard(event.experiment)
            case Repeated():
                place = event.experiment, event.repeat
                judged = event.experiment in self._proposed - self._pending
                if not judged or place in self._repeats:
                    raise UserError(
                        f"{where}: repeat {event.repeat} of experiment {event.experiment} occurs "
                        "twice, or the experiment has no result"
                    )
                self._repeats.add(place)
            case Started() if self.started is None:
                self.started = event
            case _:
                if isinstance(event, Started) or self.started is None:
                    raise UserError(
                        f"{where}: expected the start of a search as the first event, and "
                        "only there"
                    )

    def _once(self, experiment: int, sound: bool, where: str) -> None:
        if not sound or self.started is None:
            raise UserError(f"{where}: experiment {experiment} occurs twice, or has no proposal")


def check_lock(directory: Path, started: Started) -> None:
    """Raises UserError when the resolved problem is not the one the search began with."""
    path = directory / "problem.lock.toml"
    if not path.is_file():
        raise UserError(
            f"{path} is missing: restore it, since without it the problem of the search "
            "cannot be checked"
        )
    if hashlib.sha256(path.read_bytes()).hexdigest() != started.lock_digest:
        raise UserError(f"{path} was changed after the search began")


def _artifacts(event: Event) -> Iterator[str]:
    match event:
        case Started(lessons=str(lessons)):
            yield lessons
        case Proposed() | AblationFit():
            yield event.source
        case Validated():
            yield event.curves
        case Evaluated() | Landed():
            for fold in event.folds:
                yield from (fold.model, fold.y_hat, fold.curve)
                if fold.findings:
                    yield fold.findings
            if event.output:
                yield event.output
        case Exchanged():
            yield from (event.request, event.response)
        case Streamed():
            yield event.lines
        case Refitted():
            yield from (one for one in (event.model, event.estimates) if one)
        case Unsealed():
            yield event.measured
            for record in (event.ensemble, event.refit, event.stack):
                if isinstance(record, TestedModel):
                    yield record.y_hat
        case _:
            return
