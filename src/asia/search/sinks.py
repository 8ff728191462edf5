"""Sinks: receivers of the events of a search while it runs, besides its ledger."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, Self, cast

from asia._plugins import load_target, parts_of
from asia._text import nearest, say
from asia.errors import UserError
from asia.ledger.events import Event
from asia.ledger.view import SearchView
from asia.search.loop import OnEvent


class Sink(Protocol):
    """Takes the events of one search. What it raises is reported and otherwise ignored."""

    def event(self, event: Event, view: SearchView) -> None:
        """The next event, which is in the ledger by now, and the search as of that event. Called
        from any thread, one call at a time; the search goes on when it returns."""
        ...

    def close(self) -> None:
        """The search returns, finished or interrupted."""
        ...


OpenSink = Callable[[Path, SearchView], Sink]
"""Opens a sink, given the run directory and the search so far: a search that is resumed has
events already. A class with these two arguments is one."""


@dataclass
class Sinks:
    """The sinks of one search, as a context manager that closes them.

    They are given what the ledger of a search holds, without the salt by which cases to check are
    drawn; the test is opened after a search, so no result of it is among the events.
    """

    directory: Path
    wanted: Mapping[str, OpenSink]
    """Function that opens each sink, by its name."""
    _open: dict[str, Sink] = field(default_factory=dict[str, Sink])
    _failed: set[str] = field(default_factory=set[str])

    def after_start(self, on_start: Callable[[SearchView], None]) -> Callable[[SearchView], None]:
        """`on_start`, then the sinks are opened."""

        def start(view: SearchView) -> None:
            on_start(view)
            for name, opener in self.wanted.items():
                with self._reported(name):
                    self._open[name] = opener(self.directory, _without_salt(view))

        return start

    def after_event(self, on_event: OnEvent) -> OnEvent:
        """`on_event`, then each sink is given the event."""

        def event(event: Event, view: SearchView) -> None:
            on_event(event, view)
            for name, sink in self._open.items():
                with self._reported(name):
                    sink.event(event, _without_salt(view))

        return event

    @contextmanager
    def _reported(self, name: str) -> Generator[None, None, None]:
        """Code of another package: its failure is never the search's, and is said once on
        stderr."""
        try:
            yield
        except Exception as error:  # noqa: BLE001 - the boundary itself
            if name not in self._failed:
                self._failed.add(name)
                what = f"{type(error).__name__}: {error}"
                say(f"sink {name} failed, the search continues: {what}", file=sys.stderr)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        for name, sink in self._open.items():
            with self._reported(name):
                sink.close()


def open_sinks(directory: Path, wanted: Sequence[str | OpenSink]) -> Sinks:
    """The sinks of a search in `directory`. wanted: names of installed sinks, `module:Name`, or
    what opens one. Raises UserError for a name that is not known."""
    found: dict[str, OpenSink] = {}
    for one in wanted:
        name = one if isinstance(one, str) else getattr(one, "__qualname__", repr(one))
        found[name] = find_sink(one) if isinstance(one, str) else one
    return Sinks(directory, found)


def find_sink(name: str) -> OpenSink:
    """The sink of this name or `module:Name`. Raises UserError where there is none."""
    known = {part.name: part for part in parts_of("asia.sinks")}
    if name in known:
        sink = known[name].load()
    elif ":" in name:
        sink = load_target(name, f"sink {name}")
    else:
        raise UserError(
            f"there is no sink '{name}'{nearest(name, known)}: install the package that brings it, "
            "or name it as module:Name"
        )
    if not callable(sink):
        raise UserError(f"sink '{name}' is {sink!r}, expected a class or a function that opens one")
    return cast(OpenSink, sink)


def _without_salt(view: SearchView) -> SearchView:
    return replace(view, started=replace(view.started, salt=""))
