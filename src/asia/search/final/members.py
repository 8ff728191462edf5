"""Stored models that make up a final model."""

from __future__ import annotations

from dataclasses import dataclass

from asia.errors import UserError
from asia.ledger import Experiment, SearchView, Use


@dataclass(frozen=True)
class FinalMember:
    """Stored models of one candidate; the mean of their simulations counts with a weight."""

    source: str
    """Artifact of the candidate."""
    models: tuple[str, ...]
    """Artifacts of the models."""
    weight: float = 1.0
    """Its share; those of all members add up to 1."""


def final_members(view: SearchView, use: Use) -> tuple[FinalMember, ...]:
    """Return the members of a final model.

    Raises:
        UserError: the search has no such model.
    """
    run, best, refitted = view.started.run, view.best, view.refitted
    if best is None:
        raise UserError(f"run '{run}' has no scored model")
    if use == "ensemble":
        return (fold_models(best),)
    if use == "refit":
        if refitted is None or refitted.model is None:
            why = f": {refitted.detail}" if refitted and refitted.detail else ""
            raise UserError(f"run '{run}' has no refitted model{why}")
        return (FinalMember(best.proposed.source, (refitted.model,)),)
    if refitted is None or refitted.stack is None:
        raise UserError(
            f"run '{run}' has no stack: it is made at the end of a search, where several "
            "candidates together have a lower V than one"
        )
    members = refitted.stack.members
    return tuple(fold_models(view.experiment(m.experiment), m.weight) for m in members)


def has_model(view: SearchView, use: Use) -> bool:
    """Return whether the search has this final model."""
    try:
        return bool(final_members(view, use))
    except UserError:
        return False


def fold_models(experiment: Experiment, weight: float = 1.0) -> FinalMember:
    """The fold models of a scored experiment."""
    assert experiment.result is not None
    models = tuple(fold.model for fold in experiment.result.folds)
    return FinalMember(experiment.proposed.source, models, weight)
