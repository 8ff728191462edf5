"""Folds that were passed over, since the candidate was far behind without them."""

from __future__ import annotations

from asia.errors import Reason
from asia.ledger._view import SearchView


def folds_passed_over(view: SearchView) -> tuple[int, ...]:
    """Of each experiment that was stopped early, how many folds do not count for that reason. One
    that was given the outcome of a twin is not among them."""
    folds = len(view.started.folds)
    return tuple(
        folds - e.failure.fold
        for e in view.finished
        if e.failure is not None
        and e.failure.reason is Reason.BEHIND
        and e.failure.fold is not None
        and e.result is not None
        and e.result.duplicate_of is None
    )


def folds_ended(view: SearchView) -> int:
    """How many of the folds that were passed over ran already, and were ended."""
    return sum(e.result.ended_folds for e in view.finished if e.result is not None)
