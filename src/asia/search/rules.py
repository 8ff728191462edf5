"""Phases and stop rules."""

from __future__ import annotations

from typing import Literal

from asia.ledger.events import StopReason
from asia.ledger.view import SearchView
from asia.problem.budget import Budget


def phase(view: SearchView) -> Literal["explore", "refine"]:
    """The first 40 % of the budget explores different families; the rest refines."""
    explore = max(2, round(0.4 * view.budget))
    return "explore" if len(view.experiments) < explore else "refine"


def stop_reason(view: SearchView, budget: Budget) -> StopReason | None:
    """Why the search should end now, or None.

    `saturated`: the last `budget.patience` experiments of the refine phase kept nothing; those
    before the budget was extended do not count.
    """
    if len(view.experiments) >= view.most_experiments:
        return "budget"
    if view.hours is not None and view.seconds >= view.hours * 3600.0:
        return "hours"
    refined = [e for e in view.finished[view.extended_after :] if e.proposed.phase == "refine"]
    last = refined[-budget.patience :]
    kept = any(e.kept for e in last)
    return "saturated" if len(last) >= budget.patience and not kept else None
