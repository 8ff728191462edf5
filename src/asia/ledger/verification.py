"""Check a run: the chain of records, and every artifact they name."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from asia.errors import UserError
from asia.ledger.artifacts import Artifacts
from asia.ledger.chain import BEGIN, decode, ledger_of, open_ledger, scan
from asia.ledger.events import (
    Evaluated,
    Event,
    Exchanged,
    Fit,
    Landed,
    Proposed,
    Refitted,
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


def verify(
    directory: Path,
    *,
    ledger_alone: bool = False,
    check: Callable[[str, Event], None] | None = None,
) -> Verified:
    """Check the chain, the order of the events, the artifacts and the lock of a run.

    Args:
        ledger_alone: for a run that was handed on without its artifacts, none of which is read
        check: further check of each event, called with its place; see
            `asia.search.scores.ScoreCheck`

    Raises:
        UserError: that names the first record or artifact that does not hold
    """
    ledger, place = ledger_of(directory), BEGIN
    # `Replay` checks the same, but takes longer because it keeps all records.
    started: Started | None = None
    proposed, pending, repeats = set[int](), set[int](), set[tuple[int, int]]()
    with open_ledger(ledger) as stream, Artifacts(directory / "artifacts") as artifacts:
        try:
            for place, raw in scan(stream, str(ledger)):
                record = place.seq - 1
                event = decode(raw, record, str(ledger)).event
                where = f"event {record} of {directory}"
                match event:
                    case Started() if started is None:
                        started = event
                    case Proposed(experiment=number) if started and number not in proposed:
                        proposed.add(number)
                        pending.add(number)
                    case Evaluated(experiment=number) if number in pending:
                        pending.discard(number)
                    case Proposed(experiment=number) | Evaluated(experiment=number):
                        raise UserError(
                            f"{where}: experiment {number} occurs twice, or has no proposal"
                        )
                    case Fit(purpose="confirmation", experiment=number, seed=repeat):
                        has_result = number in proposed and number not in pending
                        if not has_result or (number, repeat) in repeats:
                            raise UserError(
                                f"{where}: repeat {repeat} of experiment {number} occurs twice, "
                                "or the experiment has no result"
                            )
                        repeats.add((number, repeat))
                    case _ if started is None or isinstance(event, Started):
                        raise UserError(
                            f"{where}: expected the start of a search as the first event, and "
                            "only there"
                        )
                    case _:
                        pass
                for digest in () if ledger_alone else _artifacts(event):
                    artifacts.add(digest, record)
                if check is not None:
                    check(where, event)
        except UserError:
            # An error in an earlier record is reported first.
            artifacts.check()
            raise
        artifacts.check()
        count = len(artifacts)
    if started is None:
        raise UserError(f"{directory}: the ledger is empty: the search was stopped before it began")
    check_lock(directory, started)
    return Verified(place.seq, count, place.head, ledger.stat().st_size - place.offset)


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
        case Proposed():
            yield event.source
        case Fit(source=source) if source:
            yield source
        case Validated():
            yield event.curves
        case Evaluated() | Landed():
            for fold in event.folds:
                names = fold.model, fold.y_hat, fold.curve, fold.findings
                yield from (name for name in names if name)
            yield from (one for one in (event.output, event.source) if one)
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
            if event.bands:
                yield from (event.bands.lower, event.bands.upper)
        case _:
            return
