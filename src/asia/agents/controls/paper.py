"""The random control of Piga and Forgione: an LSTM that runs freely on its own output, alone or as
the residual of the equations, with width, depth, learning rate, dropout and weight decay drawn.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from asia.agents._view import Facts
from asia.agents.library.cost import FEWEST_STEPS
from asia.agents.library.family import Family
from asia.agents.library.methods import adam
from asia.agents.library.recipe import Recipe
from asia.agents.library.space import OneOf, Space, Span
from asia.agents.library.table import family

_UNITS = 32
_PAPER = ("autoregressive", "physics_net")


def paper_families(facts: Facts) -> tuple[Family, ...]:
    """The paper's two model classes, the second where the problem has equations for it; fits are
    long ones, by Adam alone."""
    rows = [row for row in map(family, _PAPER) if row is not None and row.suits(facts)]
    return tuple(
        replace(row, start=partial(_lstm, row), space=_space, methods=(), settle=_affordable)
        for row in rows
    )


def _lstm(row: Family, facts: Facts) -> Recipe:
    if row.name == "physics_net":
        config = (("network", "lstm"), ("hidden", 32), ("layers", 1))
        return Recipe("physics_net", config, "Adam", adam(facts, "heavy", "full", 1e-3))
    return row.full(facts).configured(cell="lstm")


def _affordable(_: Facts, recipe: Recipe) -> Recipe:
    """Fewer steps for networks larger than the one that the number was reckoned for: an update
    costs about the square of the width, times the layers."""
    larger = recipe.number("layers", 1) * (recipe.number("hidden", _UNITS) / _UNITS) ** 2
    steps = recipe.number("steps", FEWEST_STEPS) / max(1.0, larger)
    return recipe.trained(steps=max(FEWEST_STEPS, round(steps)))


def _space(_: Facts) -> Space:
    return Space(
        config=(Span("hidden", 16, 128, whole=True), OneOf("layers", (1, 2, 3))),
        options=(
            Span("learning_rate", 1e-4, 1e-2),
            Span("dropout", 0.0, 0.3, log=False),
            Span("weight_decay", 1e-6, 1e-2),
        ),
    )
