"""Progress lines while a candidate waits for its result."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from asia.cli._output.words import duration

if TYPE_CHECKING:
    from asia.drive import Desk, ExperimentSummary, SearchProgress, Submission

_AGAIN_SECONDS = 60.0


class Waiting:
    """Print each change once: finished rungs and experiments, and the state of the submission.
    Repeat an unchanged state every minute."""

    def __init__(self, desk: Desk, say: Callable[[str], None]) -> None:
        self._desk, self._say = desk, say
        now = desk.progress()
        self._rungs = set(now.rungs if now.experiments else ())
        self._finished = now.experiments
        self._line = ""
        self._since = self._said = time.monotonic()

    def look(self, submission: Submission) -> None:
        """Print the changes since the last call."""
        now = self._desk.progress()
        for name, value in now.rungs.items():
            if name not in self._rungs:
                self._rungs.add(name)
                self._say(f"reference {name}: {now.v_name} {_value(value)}")
        if now.experiments > self._finished:
            for result in self._desk.results()[self._finished :]:
                if result.experiment != submission.experiment:
                    self._say(finished_line(result, now))
            self._finished = now.experiments
        self._say_where(_where(submission, now))

    def _say_where(self, line: str) -> None:
        clock = time.monotonic()
        if line != self._line:
            self._line, self._since, self._said = line, clock, clock
            if line:
                self._say(line)
        elif line and clock - self._said >= _AGAIN_SECONDS:
            self._said = clock
            self._say(f"{line}, for {duration(clock - self._since)}")


def finished_line(result: ExperimentSummary, now: SearchProgress) -> str:
    """`#01 keep    V = 0.7984 in 12s: baseline`"""
    head = f"#{result.experiment:02d} {result.status:<7} {now.v_name}"
    return f"{head} {_value(result.value)} in {duration(result.seconds)}: {result.title}"


def _value(value: float | None) -> str:
    from asia.ledger import error_value

    return "none" if value is None else f"= {error_value(value)}"


def _where(submission: Submission, now: SearchProgress) -> str:
    running = now.running if submission.state == "queued" else submission.experiment
    if submission.state not in ("queued", "running"):
        return ""
    if running is not None:
        what = ", the baseline," if running == 1 else ""
        return f"#{running:02d}{what} is being evaluated{_behind(submission)}"
    if now.experiments == 0:
        return "the search evaluates the rungs, which are simple references, then the baseline"
    return f"queued, {submission.ahead} before it" if submission.ahead else "queued, it is next"


def _behind(submission: Submission) -> str:
    if submission.state != "queued":
        return ""
    return f"; {submission.ahead} before yours" if submission.ahead else "; yours is next"
