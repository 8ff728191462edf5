"""Counts of folds that were pruned because the candidate was far behind without them."""

from __future__ import annotations

from asia.errors import Reason
from asia.ledger._view import SearchView


def folds_passed_over(view: SearchView) -> tuple[int, ...]:
    """Return for each pruned experiment its number of pruned folds. An experiment with the outcome
    of a duplicate is not among them.
    """
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
    """Return the number of pruned folds that were cancelled while they ran."""
    return sum(e.result.ended_folds for e in view.finished if e.result is not None)
