"""The expert's moves: what to change, when, why, and what should come of it.

One row a move, in a table for each kind of model. To teach the expert something, add a row: the
condition reads training-side evidence, the change makes a new recipe, the words are recorded
before the outcome is known.
"""

from __future__ import annotations

from asia.agents.expert.move import Case, Move
from asia.agents.expert.tune import TUNED, may_tune, tuned
from asia.agents.library.cards.moves_classical import CLASSICAL_MOVES
from asia.agents.library.cards.moves_greybox import GREYBOX_MOVES
from asia.agents.library.cards.moves_networks import NETWORK_MOVES
from asia.agents.library.cards.moves_physics_net import PHYSICS_NET_MOVES
from asia.agents.library.recipe import Recipe

_LATE = 0.25
# A long fit may halve the error of a short one, hardly more.
_REACH = 2.0


def _is_short(case: Case) -> bool:
    return case.recipe.number("steps", 0) < case.row.full(case.facts).number("steps", 0)


def _full_weight(case: Case) -> float:
    earned = case.in_best_third and case.behind < _REACH and _is_short(case)
    return (0.85 if case.place == 0 else 0.7) if earned else 0.0


def _in_full(case: Case) -> Recipe:
    """What the row's long fit has beyond its trial, on the recipe as it is now."""
    trial, full = case.row.trial(case.facts), case.row.full(case.facts)
    recipe = case.recipe
    for name, value in full.config:
        if trial.get(name) != value:
            recipe = recipe.configured(**{name: value})
    for name, value in full.options:
        if trial.get(name) != value:
            recipe = recipe.trained(**{name: value})
    return recipe


def _tuning_weight(case: Case) -> float:
    """Above what is left of small moves; once the budget runs out, above medium ones."""
    if case.place > 0 or not may_tune(case):
        return 0.0
    return 0.5 if case.view.remaining <= _LATE * case.view.experiments else 0.3


def _fewer(case: Case) -> Recipe:
    recipe = case.recipe
    for name, share, least in (("steps", 0.25, 50), ("iterations", 0.5, 5), ("starts", 0.5, 1)):
        if recipe.has(name):
            recipe = recipe.trained(**{name: max(least, round(share * recipe.number(name, 1)))})
    return recipe


def _calmer(case: Case) -> Recipe:
    recipe = case.recipe
    if recipe.number("learning_rate", 0) > 0:
        return recipe.times("learning_rate", 0.3, 1e-3)
    return recipe.times("ridge", 30.0, 1e-4)


def _can_calm(case: Case) -> bool:
    return case.recipe.number("learning_rate", 0) > 0 or case.recipe.number("ridge", 0) > 0


GENERAL_MOVES: tuple[Move, ...] = (
    Move(
        name="fitted in full",
        families=(),
        weight=_full_weight,
        change=_in_full,
        hypothesis="The short trial is among the best third: it has earned a long fit.",
        expected="Lower training error, V follows.",
        behind_counts=False,
    ),
    Move(
        name=TUNED,
        families=(),
        weight=_tuning_weight,
        change=tuned,
        hypothesis="What is left to gain lies in the numbers: within a factor of three of the best "
        "ones known, where the outcomes so far say it is likeliest (tree-structured Parzen).",
        expected="A small gain in V.",
        fade=0.9,
    ),
    Move(
        name="a shorter fit",
        families=(),
        weight=lambda c: 0.5 * (c.trial.status == "timeout"),
        change=_fewer,
        hypothesis="The fit did not end in time: with fewer steps it says at least how far the "
        "family goes.",
        expected="A value for this family, to compare with the others.",
        after="failure",
        behind_counts=False,
    ),
    Move(
        name="a calmer fit",
        families=(),
        weight=lambda c: 0.4 * (c.trial.status == "invalid") * _can_calm(c),
        change=_calmer,
        hypothesis="The simulation ran away: smaller steps or a firmer prior keep it bounded.",
        expected="A value for this family, to compare with the others.",
        after="failure",
        behind_counts=False,
    ),
)

MOVES: tuple[Move, ...] = (
    *GENERAL_MOVES,
    *GREYBOX_MOVES,
    *PHYSICS_NET_MOVES,
    *CLASSICAL_MOVES,
    *NETWORK_MOVES,
)
