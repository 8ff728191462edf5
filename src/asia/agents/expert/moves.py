"""Moves of the expert, and their titles."""

from __future__ import annotations

from functools import cache

from asia.agents.expert.diagnosis import COURSE_MOVES
from asia.agents.expert.network_moves import NETWORK_MOVES
from asia.agents.expert.tune import TUNED, may_tune, tuned
from asia.agents.library.move import Move, Situation
from asia.agents.library.recipe import Recipe
from asia.agents.library.records import coloured
from asia.agents.library.registry import card_moves


def _full_weight(at: Situation) -> float:
    """Return the weight of a long fit, which may halve the error of a short one, hardly more."""
    full = at.row.full(at.facts).number("steps", 0)
    if not at.in_best_third or at.behind >= 2.0 or at.recipe.number("steps", 0) >= full:
        return 0.0
    return 0.85 if at.place == 0 else 0.7


def _in_full(at: Situation) -> Recipe:
    """Apply the additional settings of the family's long fit to the present recipe."""
    trial, full = at.row.trial(at.facts), at.row.full(at.facts)
    config = {name: value for name, value in full.config if trial.get(name) != value}
    options = {name: value for name, value in full.options if trial.get(name) != value}
    return at.recipe.configured(**config).trained(**options)


def _tuning_weight(at: Situation) -> float:
    """Return a weight above that of repeated small moves; near the end of the budget, above medium
    ones."""
    if at.place > 0 or not may_tune(at):
        return 0.0
    return 0.5 if at.view.remaining <= 0.25 * at.view.experiments else 0.3


def _fewer(at: Situation) -> Recipe:
    recipe = at.recipe
    for name, share, least in (("steps", 0.25, 50), ("iterations", 0.5, 5), ("starts", 0.5, 1)):
        if recipe.has(name):
            recipe = recipe.trained(**{name: max(least, round(share * recipe.number(name, 1)))})
    return recipe


def _calmer(at: Situation) -> Recipe:
    recipe = at.recipe
    if recipe.number("learning_rate", 0) > 0:
        return recipe.times("learning_rate", 0.3, 1e-3)
    return recipe.times("ridge", 30.0, 1e-4)


def _order(at: Situation) -> int:
    return round(at.recipe.number("order", 2))


GENERAL_MOVES: tuple[Move, ...] = (
    Move(
        name="fitted in full",
        weight=_full_weight,
        change=_in_full,
        hypothesis="The short trial is among the best third, which justifies a long fit.",
        expected="Lower training error, V follows.",
        behind_counts=False,
    ),
    Move(
        name=TUNED,
        weight=_tuning_weight,
        change=tuned,
        hypothesis="The remaining gain lies in the hyperparameters: within a factor of three of "
        "the best ones, where the outcomes so far make it most likely (tree-structured Parzen "
        "estimator).",
        expected="A small gain in V.",
        same_effort=True,
        fade=0.9,
    ),
    Move(
        name="a shorter fit",
        weight=lambda c: 0.5 * (c.trial.status == "timeout"),
        change=_fewer,
        hypothesis="The fit exceeded its time limit: fewer steps still give a value for the "
        "family.",
        expected="A value for this family, to compare with the others.",
        after="failure",
        behind_counts=False,
    ),
    Move(
        name="a calmer fit",
        weight=lambda c: (
            0.4
            * (c.trial.status == "invalid")
            * any(c.recipe.number(name, 0) > 0 for name in ("learning_rate", "ridge"))
        ),
        change=_calmer,
        hypothesis="The simulation diverged: smaller steps or a stronger prior keep it bounded.",
        expected="A value for this family, to compare with the others.",
        after="failure",
        behind_counts=False,
    ),
)

SETTING_MOVES: tuple[Move, ...] = (
    Move(
        name="more starts",
        weight=lambda c: 0.25 * (0 < c.recipe.number("starts", 0) <= 16),
        change=lambda c: c.recipe.trained(starts=round(2 * c.recipe.number("starts", 1))),
        hypothesis="The best of the starting points may not lead to the global minimum.",
        expected="The same or a lower training error.",
    ),
    Move(
        name="one state more",
        weight=lambda c: (0.6 if coloured(c.trial) else 0.3) * c.varies("order") * (_order(c) < 6),
        change=lambda c: c.recipe.configured(order=_order(c) + 1),
        hypothesis="The residual is not white: a mode is missing.",
        expected="A whiter residual and a lower V.",
    ),
)


@cache
def all_moves() -> tuple[Move, ...]:
    """The moves on any family, those of the cards, and those that a family's settings allow. Of
    two with the same weight the first is made."""
    return (*GENERAL_MOVES, *card_moves(), *SETTING_MOVES, *NETWORK_MOVES, *COURSE_MOVES)
