"""Conformance suite for ledgers."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, Self

from asia.errors import Reason, UserError
from asia.judge.scoring.outcome import Failure, FoldRecord, Score
from asia.ledger.chain import Chain, Line
from asia.ledger.events import (
    Evaluated,
    Event,
    Extended,
    Fit,
    Proposed,
    ReferenceScored,
    RefitCheck,
    Refitted,
    Resumed,
    Stack,
    StackMember,
    Started,
    Steered,
    Stopped,
)
from asia.ledger.view import SearchView

if TYPE_CHECKING:
    from asia.search.sinks import OpenSink, Sink


class OpenLedger(Protocol):
    """A ledger open for writing; use it as a context manager."""

    @property
    def lines(self) -> Sequence[Line]:
        """All records."""
        ...

    @property
    def view(self) -> SearchView:
        """The records replayed."""
        ...

    def append(self, event: Event) -> None:
        """Write one event. Raises UserError where that is not possible."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *raised: object) -> None: ...


def check_ledger(open_ledger: Callable[[Path], OpenLedger]) -> None:
    """Write, reopen and damage ledgers.

    Checked: events come back as they were written, in order, after reopening too; the view is that
    of the events; a second writer is refused with a UserError; a last record cut anywhere is passed
    over, the others stay and the next one follows them; a byte changed anywhere before is a
    UserError, and so is a record taken out.

    Args:
        open_ledger: of the path of a file, which need not exist
    """
    events = made_up_events()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run", "ledger.jsonl")
        with open_ledger(path) as ledger:
            for event in events:
                ledger.append(event)
            assert [line.event for line in ledger.lines] == events, "events changed in writing"
        with open_ledger(path) as ledger:
            assert [line.event for line in ledger.lines] == events, "events changed in reading"
            numbers = [line.seq for line in ledger.lines]
            assert numbers == list(range(len(events))), "seq must count"
            best = ledger.view.best
            assert best is not None, "the view lost the incumbent"
            assert best.number == 1, "the view is not that of the events"
            assert _refused(open_ledger, path), "two writers at once"
        assert not _refused(open_ledger, path), "a ledger that was closed is still held"

        # A last record that was cut, at up to 40 places.
        whole = path.read_bytes()
        last = whole.rstrip(b"\n").rfind(b"\n") + 1
        for cut in range(last, len(whole), max((len(whole) - last) // 40, 1)):
            path.write_bytes(whole[:cut])
            with open_ledger(path) as ledger:
                kept = [line.event for line in ledger.lines]
                before_end = len(whole) - cut
                assert kept == events[:-1], f"cut {before_end} bytes before its end: not repaired"
                ledger.append(events[-1])
            with open_ledger(path) as ledger:
                assert len(ledger.lines) == len(events), "the record after a repair was lost"

        # A byte that was changed, and a record that was taken out.
        for place in range(0, last, max(last // 40, 1)):
            damaged = bytearray(whole)
            damaged[place] ^= 1
            path.write_bytes(damaged)
            assert _refused(open_ledger, path), f"byte {place} was changed and nobody noticed"
        first, _, rest = whole.partition(b"\n")
        path.write_bytes(first + b"\n" + rest.partition(b"\n")[2])
        assert _refused(open_ledger, path), "a record was taken out and nobody noticed"


def _refused(open_ledger: Callable[[Path], OpenLedger], path: Path) -> bool:
    try:
        with open_ledger(path):
            return False
    except UserError:
        return True


def made_up_events() -> list[Event]:
    """A search with an event of most kinds."""
    fold = FoldRecord(0.4, (0.4,), (0.1,), (50.0,), (0.75,))
    score, digest = Score(0.4, (fold, fold)), "0" * 64
    failure = Failure(Reason.CRASH, "Traceback\nValueError: \u03b1 \x07", 1)
    return [
        Started(
            run="made up",
            problem="made up",
            agent="nobody",
            seed=0,
            experiments=3,
            hours=None,
            outputs=("y",),
            lock_digest=digest,
            protocol_digest=digest,
            test_digest=None,
            isolation="process",
            isolation_notes=("a note",),
            environment={"python": "3"},
        ),
        ReferenceScored("linear model", score),
        Proposed(1, None, "explore", "linear", "first", "h", "e", digest, "1"),
        Evaluated(1, "keep", score, None, 1.0),
        Steered("look \u201chere\u201d\n"),
        Proposed(2, 1, "refine", "linear", "second", "h", "e", digest, "2"),
        Evaluated(2, "crash", failure, None, 1.0),
        Stopped("user"),
        Resumed(),
        Extended(5, None),
        Refitted(
            1,
            None,
            "it failed",
            Fit(0, "repetition", 1.04, fold=2),
            check=RefitCheck(
                (0.1, None), 0.1, None, (Fit(0, "refit", 1.2, failed="far off", disagreement=1.1),)
            ),
            stack=Stack((StackMember(1, 0.75), StackMember(2, 0.25)), 0.4, (0.3, 0.5)),
            use="stack",
            reason="Several models together are better.",
        ),
    ]


def check_sink(open_sink: OpenSink) -> None:
    """Give made-up searches to the sinks that `open_sink` opens.

    Checked: a sink takes every event of a search, from another thread, and its end; it opens on a
    search that is resumed; it may be closed right away; two searches at once have a sink each; the
    ledger stays as it was.

    Raises:
        AssertionError: that says what fails, and any exception of a sink
    """
    with tempfile.TemporaryDirectory() as folder:
        searches = [_MadeUpSearch(Path(folder, name)) for name in ("one", "two")]
        sinks = [open_sink(search.directory, search.views[0]) for search in searches]
        assert sinks[0] is not sinks[1], "two searches at once share a sink"
        for search, sink in zip(searches, sinks, strict=True):
            search.feed(sink)
        for sink in sinks:
            sink.close()
        resumed = searches[0]
        open_sink(resumed.directory, resumed.views[-1]).close()
        for search in searches:
            search.check_ledger()


class _MadeUpSearch:
    """Made-up search: its directory, and the view after each event."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.views: list[SearchView] = []
        with Chain(directory / "ledger.jsonl") as chain:
            for event in made_up_events():
                chain.append(event)
                self.views.append(chain.view)
        self._ledger = (directory / "ledger.jsonl").read_bytes()

    def feed(self, sink: Sink) -> None:
        """All events but the first, which came before the sink was opened."""
        with ThreadPoolExecutor(1) as other_thread:
            for event, view in list(zip(made_up_events(), self.views, strict=True))[1:]:
                other_thread.submit(sink.event, event, view).result()

    def check_ledger(self) -> None:
        same = (self.directory / "ledger.jsonl").read_bytes() == self._ledger
        assert same, "the ledger was changed"
