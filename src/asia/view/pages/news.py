"""Messages to an open page when its run has changed."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any, Literal

from asia._text import one_line
from asia.ledger import Experiment, error_value
from asia.view._followed import RunFolder, Snapshot
from asia.view.pages.rows import experiment_row
from asia.view.pages.run import now_panel
from asia.view.pages.runs import runs_table


@dataclass(frozen=True)
class Changed:
    """One message of a stream."""

    kind: Literal["news", "trouble", "anew"]
    """News; the run cannot be read; or the page shows what is no more and has to load again."""
    mark: str
    """Mark from which the next message continues."""
    data: dict[str, Any]
    """JSON: names of elements with their HTML, or words."""


def run_news(snapshot: Snapshot, count: int, *, first: bool) -> Changed:
    """Return the changes of a run's page since `count` lines.

    Args:
        snapshot: the present state.
        count: number of ledger lines that the page shows.
        first: true for the first message of a stream, so that nothing is read aloud.
    """
    subject, view = snapshot.subject, snapshot.run.view
    changed = [view.experiment(number) for number in snapshot.changed_since(count)]
    rows = [{"number": e.number, "html": experiment_row(subject, e)} for e in changed]
    ended = [e for e in changed if e.result is not None]
    said = "" if first or not ended else _spoken(ended[0])
    data = {"rows": rows, "parts": {"now": now_panel(snapshot)}, "said": said}
    return Changed("news", snapshot.mark, {**data, "running": snapshot.run.state == "running"})


def list_news(folder: RunFolder, shown: str) -> Changed | None:
    """The list of runs, where it is another one than the one whose digest is `shown`."""
    table = runs_table(folder.listed())
    digest = digest_of(table)
    if digest == shown:
        return None
    return Changed("news", digest, {"rows": [], "parts": {"list": table}, "said": ""})


def digest_of(html: str) -> str:
    """Tells one HTML from another."""
    return hashlib.sha256(html.encode("utf-8", "replace")).hexdigest()[:20]


def _spoken(experiment: Experiment) -> str:
    result, score = experiment.result, experiment.score
    assert result is not None
    value = f"V {error_value(score.value)}" if score is not None else "no score"
    title = one_line(experiment.proposed.title, 100)
    return f"Experiment {experiment.number}, {result.status}, {value}: {title}"
