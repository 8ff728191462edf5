"""A recipe under the protocol of a search, and whether the search has tried it."""

from __future__ import annotations

from asia.agents.library.family import Family
from asia.agents.library.methods import GRADIENT
from asia.agents.library.recipe import Recipe, read_recipe
from asia.agents.view import AgentView, Facts


def under_protocol(recipe: Recipe, row: Family, facts: Facts) -> Recipe:
    """Adapt a recipe to the protocol: with `early_stopping = "validation"` a fit that can stops by
    the held-out part; otherwise the recipe is unchanged."""
    if facts.early_stopping != "validation":
        return recipe
    if recipe.method in row.stopped_by_score:
        return recipe.trained(stop="validation")
    if recipe.method not in GRADIENT:
        return recipe
    # The paper's early stopping: a check every 25 updates, 20 without improvement.
    return recipe.trained(stop="validation", every=25, patience=20)


def is_new(view: AgentView, row: Family, recipe: Recipe) -> bool:
    """Return whether no proposal has the configuration, regardless of the order of its settings."""
    recipe = under_protocol(recipe, row, view.facts)
    tried = (read_recipe(known.source) for known in view.proposed)
    if any(other is not None and other.key == recipe.key for other in tried):
        return False
    return not view.is_known(recipe.source(""))
