"""The end of a search that waits for candidates, on request."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from asia.drive._detached import SearchRequest, attended, log_path, start_search
from asia.drive._queue import Queue
from asia.errors import UserError
from asia.ledger import SearchView, open_run
from asia.search._steering import Steering

_POLL = 0.1


def end_idle(directory: Path, say: Callable[[str], None]) -> None:
    """End the search of a workspace or a server that has nothing to evaluate, so that its test can
    be opened: its winner is fitted to all training data, and its process ends. Nothing is done to
    another search, or to one that has nothing to open. `say`: given one line where it takes time.

    Raises UserError when a candidate waits or is being evaluated, or the search fails."""
    if SearchRequest.find(directory) is None:
        return
    view = open_run(directory).view
    openable = view.best is not None and view.started.test_digest is not None
    if not openable or view.unsealing is not None:
        return
    if not view.complete and view.stopped is None:
        _check_idle(directory, view)
        Steering(directory).stop()
    try:
        if not open_run(directory).view.complete:
            say("the search ends after refitting the winner to all training data")
            start_search(directory)
        while attended(directory):
            time.sleep(_POLL)
    finally:
        Steering(directory).take_stop()
    if not open_run(directory).view.complete:
        raise UserError(
            f"the search of {directory.name} ended before its winner was fitted to all training "
            f"data: see {log_path(directory)}"
        )


def _check_idle(directory: Path, view: SearchView) -> None:
    waiting = len(Queue(directory).tickets())
    if view.pending is None and not waiting:
        return
    busy = f"{waiting} candidates wait to be evaluated"
    if view.pending is not None:
        busy = f"experiment {view.pending.number} is being evaluated"
    raise UserError(
        f"run '{directory.name}' is not idle ({busy}): wait for the results, or end it with asia "
        f"stop {directory.name}"
    )
