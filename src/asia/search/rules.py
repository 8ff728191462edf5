"""Phases, stop rules and the bound of early pruning."""

from __future__ import annotations

from statistics import fmean
from typing import Literal

from asia.ledger.events import HandedOver, Stopped, StopReason
from asia.ledger.view import SearchView
from asia.problem.budget import Budget

FAR_ABOVE = 1.5
"""V relative to the incumbent above which the remaining folds are pruned."""


def phase(view: SearchView) -> Literal["explore", "refine"]:
    """The first 40 % of the budget explores different families; the rest refines."""
    explore = max(2, round(0.4 * view.budget))
    return "explore" if len(view.experiments) < explore else "refine"


def stop_reason(view: SearchView, budget: Budget) -> StopReason | None:
    """Why the search, or the leg of a relay that proposes, should end now, or None.

    `saturated`: the last `budget.patience` experiments of the refine phase kept nothing; those
    before the budget was extended, or before the leg of a relay began, do not count.
    """
    if len(view.experiments) >= view.leg_end:
        return "budget"
    if view.hours is not None and view.seconds >= view.hours * 3600.0:
        return "hours"
    leg_after = view.handed_over[-1].after if view.handed_over else 0
    recent = view.finished[max(view.extended_after, leg_after) :]
    refined = [e for e in recent if e.proposed.phase == "refine"]
    last = refined[-budget.patience :]
    kept = any(e.kept for e in last)
    return "saturated" if len(last) >= budget.patience and not kept else None


def next_leg(view: SearchView, stopped: Stopped) -> HandedOver | None:
    """The leg of a relay that goes on where the one before has ended; None where the search has."""
    following = view.leg + 1
    if following > len(view.started.legs) or len(view.finished) >= view.budget + view.uncounted:
        return None
    reason = stopped.reason
    if reason == "hours" or reason == "user":
        return None
    return HandedOver(
        leg=following,
        agent=view.started.legs[following - 1].agent,
        reason="planned" if reason == "budget" else reason,
        after=len(view.finished),
        detail=stopped.detail,
    )


def bound_on_folds(view: SearchView) -> float | None:
    """V above which a candidate proposed now can be neither kept nor handed over; None where every
    fold counts. Later results only lower what it must beat."""
    held, best = view.incumbent, view.best
    if not view.started.stop_folds or held is None or best is None or best.score is None:
        return None
    return FAR_ABOVE * max(fmean(held.seed_values), best.score.value)
