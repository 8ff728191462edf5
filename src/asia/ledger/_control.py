"""Result of the expert at the same budget, for comparison with a search that costs money."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from asia.errors import UserError
from asia.ledger._chain import read_lines
from asia.ledger._events import Started
from asia.ledger._run import open_run

# Agents without a control: the control itself, and those that are controls too.
FREE = ("expert", "random", "random-paper", "bayes")
CONTROL = "expert"


@dataclass(frozen=True)
class Control:
    """`run` of the control agent and its best V within the first `experiments`; None while there is
    no such run, or no score in it."""

    run: str | None
    value: float | None
    experiments: int


def control(directory: Path, start: Started, spent: int) -> Control | None:
    """Return the control run of a search, or None for agents that need none.

    Of several control runs in the same folder, the one with the same seed counts, else the first.

    Args:
        directory: run directory of the search.
        start: first event of the search.
        spent: number of experiments that the search has spent.
    """
    if start.agent in FREE or spent == 0:
        return None
    found = sorted(
        ((other, place) for other, place in _siblings(directory) if _is_control(other, start)),
        key=lambda pair: (pair[0].seed != start.seed, pair[0].run),
    )
    for other, place in found:
        try:
            view = open_run(place).view
        except UserError:
            continue
        first = view.finished[:spent]
        if len(first) == spent or view.stopped is not None:
            values = [e.score.value for e in first if e.score]
            return Control(other.run, min(values, default=None), spent)
    return Control(None, None, spent)


def control_words(found: Control, start: Started) -> str:
    """Describe a control run in one line of text."""
    if found.run is None:
        return (
            "not run yet; to run the expert, which needs no language model, at the same budget: "
            f"asia run {start.problem} --experiments {found.experiments} --seed {start.seed}"
        )
    value = "no score" if found.value is None else f"V={found.value:.4f}"
    return f"expert, the same {found.experiments} experiments: {value} ({found.run})"


def _siblings(directory: Path) -> Iterator[tuple[Started, Path]]:
    for ledger in sorted(directory.resolve().parent.glob("*/ledger.jsonl")):
        if ledger.parent == directory.resolve():
            continue
        try:
            first = next(read_lines(ledger), None)
        except UserError:
            continue
        if first is not None and isinstance(first.event, Started):
            yield first.event, ledger.parent


def _is_control(other: Started, start: Started) -> bool:
    return (
        other.agent == CONTROL
        and other.problem == start.problem
        and other.protocol_digest == start.protocol_digest
        and other.early_stopping == start.early_stopping
    )
