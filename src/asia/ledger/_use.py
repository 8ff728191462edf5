"""The model to use of a search, as its ledger names it."""

from __future__ import annotations

from dataclasses import dataclass

from asia.ledger._events import Stack, TestedModel, Unsealed, Use
from asia.ledger._view import SearchView
from asia.scoring import Failure


@dataclass(frozen=True)
class ModelToUse:
    """The model to use and why."""

    model: Use
    """Name of the model."""
    reason: str
    """Why, in a sentence."""


def model_to_use(view: SearchView) -> ModelToUse | None:
    """The model that the search names. The ensemble while it goes on, and in a ledger of an older
    version, which names none. None where no candidate has a score."""
    if view.best is None:
        return None
    refitted = view.refitted
    if refitted is None:
        return ModelToUse("ensemble", "The search is not finished: there is no other model yet.")
    if refitted.use is None:
        reason = "The search is of an older version, which did not check the refit."
        return ModelToUse("ensemble", reason)
    return ModelToUse(refitted.use, refitted.reason)


def tested_model(record: Unsealed, use: Use) -> TestedModel | Failure:
    """Return the result of the sealed test for this model, or that of the ensemble if it has
    none.
    """
    found = {"ensemble": record.ensemble, "refit": record.refit, "stack": record.stack}[use]
    return record.ensemble if found is None else found


def stack_words(stack: Stack) -> str:
    """`#07 0.62, #03 0.38`: the members and their weights."""
    return ", ".join(f"#{m.experiment:02d} {m.weight:.2f}" for m in stack.members)
