"""Conformance suite for sinks."""

from __future__ import annotations

import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from asia.ledger.chain import Chain
from asia.ledger.view import SearchView
from asia.testing.ledger import made_up_events

if TYPE_CHECKING:
    from asia.search.sinks import OpenSink, Sink


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
