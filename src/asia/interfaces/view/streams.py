"""Server-sent events, and what users do from the live view: steering and starting searches."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol

from anyio.to_thread import run_sync

from asia.agents.registry import reads_notes
from asia.errors import UserError
from asia.interfaces.view.followed import FollowedRun, RunFolder, Snapshot
from asia.interfaces.view.pages import FIRST, Changed, list_news, run_news
from asia.ledger.run import Run
from asia.search.steering import Steering, note_for_people

# Server-sent events: what is new on a page, from the line of the ledger on that it shows.


_LOOK_SECONDS = 0.1
_LIST_SECONDS = 0.5
_BEAT_SECONDS = 10.0
_RETRY = "retry: 500\n\n"


class Streams:
    """Open event streams of the pages."""

    def __init__(self) -> None:
        self._over = False

    def end(self) -> None:
        """Each of them within a moment."""
        self._over = True

    def of_run(self, followed: FollowedRun, mark: str) -> AsyncIterator[str]:
        """Stream the changes of a run since a mark of its ledger."""
        # Snapshot and error of the last message; None and "" before the first one.
        last: Snapshot | None = None
        trouble = ""

        def look(mark: str) -> Changed | None:
            nonlocal last, trouble
            try:
                snapshot = followed.snapshot()
            except UserError as error:
                if str(error) == trouble:
                    return None
                trouble = str(error)
                return Changed("trouble", mark, {"words": trouble})
            if snapshot is last and not trouble:
                return None
            count = followed.count_of(mark)
            if count is None or len(snapshot.changed_since(count)) > FIRST:
                return Changed("anew", snapshot.mark, {})
            first, last, trouble = last is None, snapshot, ""
            return run_news(snapshot, count, first=first)

        return self._messages(look, _LOOK_SECONDS, mark)

    def of_list(self, folder: RunFolder, shown: str) -> AsyncIterator[str]:
        """The list of runs whenever it changes. shown: the digest of the one that is shown."""
        return self._messages(partial(list_news, folder), _LIST_SECONDS, shown)

    async def _messages(
        self, look: Callable[[str], Changed | None], pause: float, mark: str
    ) -> AsyncIterator[str]:
        yield _RETRY
        beaten = time.monotonic()
        while not self._over:
            found = await run_sync(look, mark)
            if found is not None:
                mark, beaten = found.mark, time.monotonic()
                yield f"event: {found.kind}\nid: {mark}\ndata: {json.dumps(found.data)}\n\n"
            elif time.monotonic() - beaten > _BEAT_SECONDS:
                beaten = time.monotonic()
                yield ": still here\n\n"
            await asyncio.sleep(pause)


# Start of a search. What starts it is given to the pages: they import nothing that opens a test.


class Starter(Protocol):
    """Starts searches for the pages."""

    @property
    def problems(self) -> Sequence[str]:
        """Names of the problems to choose from."""
        ...

    @property
    def agents(self) -> Sequence[str]:
        """Names of the agents to choose from."""
        ...

    def start(self, runs: Path, text: str) -> tuple[str, str]:
        """Start a search in a process of its own.

        Args:
            runs: the folder of runs
            text: the fields problem, agent, experiments, seed and name in JSON

        Returns:
            its effect as a sentence, and the name of the run

        Raises:
            UserError: if it cannot be started
        """
        ...


# Notes and orders to a search, as `asia steer` gives them.


def tell(run: Run, what: str, text: str) -> str:
    """Execute the command `what` (steer, note, pause, continue or stop). Return its effect as a
    sentence.

    Args:
        text: the note of steer; of note the fields in JSON

    Raises:
        UserError: if it cannot be executed
    """
    steering, running = Steering(run.directory), run.state == "running"
    if what == "steer":
        steering.steer(text)
        agent = run.view.started.agent
        noted = f"noted: recorded {'at its next step' if running else 'when the search continues'}"
        if reads_notes(run.view.started):
            return noted
        return f"{noted}; the agent '{agent}' does not read notes, so the note is only recorded"
    if what == "note":
        try:
            fields = {key: str(value) for key, value in dict(json.loads(text)).items()}
            author, reason, number = fields["author"], fields["text"], int(fields["experiment"])
        except (ValueError, TypeError, KeyError):
            raise UserError("expected the fields author, text and experiment of a note") from None
        tags, removed = (fields.get(key, "").split() for key in ("tags", "removed"))
        if note_for_people(run, author, reason, number, tags, removed):
            return "recorded in the ledger"
        return "the running command records it at its next step"
    if what == "continue":
        words = "the search continues" if steering.paused else "the search was not paused"
        steering.go_on()
        return words
    if what not in ("pause", "stop"):
        raise UserError(f"no '{what}'; there is: steer, note, pause, continue, stop")
    if not running:
        raise UserError(f"run '{run.name}' is {run.state}: there is nothing to {what}")
    if what == "pause":
        steering.pause()
        return "the search pauses after its current experiment"
    steering.stop()
    return "the search stops after its present experiment; repeat its command to resume it"
