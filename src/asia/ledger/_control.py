"""The expert's result at the same budget, beside a search that costs money."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from asia.errors import UserError
from asia.ledger._events import Started
from asia.ledger._view import Run, SearchView, open_run

# Agents that need nothing and no one, and so are no controlled ones.
FREE = ("expert", "random", "random-paper", "bayes")
CONTROL = "expert"


@dataclass(frozen=True)
class Control:
    """`run` of the control agent and its best V within the first `experiments`; None while there is
    no such run, or no score in it."""

    run: str | None
    value: float | None
    experiments: int


def control(run: Run) -> Control | None:
    """The control arm of a search beside it in the same directory; None for the agents that need
    none. Of several runs of the control the one with the same seed counts, else the first."""
    start, spent = run.view.started, len(run.view.finished)
    if start.agent in FREE or spent == 0:
        return None
    found = sorted(
        (view for view in _siblings(run.directory) if _is_control(view.started, start)),
        key=lambda view: (view.started.seed != start.seed, view.started.run),
    )
    for view in found:
        if len(view.finished) >= spent or view.stopped is not None:
            values = [e.score.value for e in view.finished[:spent] if e.score]
            return Control(view.started.run, min(values, default=None), spent)
    return Control(None, None, spent)


def control_words(found: Control, start: Started) -> str:
    """One line for people."""
    if found.run is None:
        return (
            "none yet; what the expert finds without a language model: asia run "
            f"{start.problem} --experiments {found.experiments} --seed {start.seed}"
        )
    value = "no score" if found.value is None else f"V={found.value:.4f}"
    return f"expert, the same {found.experiments} experiments: {value} ({found.run})"


def _siblings(directory: Path) -> list[SearchView]:
    views: list[SearchView] = []
    for ledger in sorted(directory.resolve().parent.glob("*/ledger.jsonl")):
        if ledger.parent != directory.resolve():
            try:
                views.append(open_run(ledger.parent).view)
            except UserError:
                continue
    return views


def _is_control(other: Started, start: Started) -> bool:
    return (
        other.agent == CONTROL
        and other.problem == start.problem
        and other.protocol_digest == start.protocol_digest
        and other.early_stopping == start.early_stopping
    )
