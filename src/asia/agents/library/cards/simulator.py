"""Simulator of the user's own, calibrated, and the model of its error."""

from __future__ import annotations

from asia.agents.library.family import Family, Timing
from asia.agents.library.methods import LM
from asia.agents.library.move import LIKELY, POSSIBLE, Card, Move
from asia.agents.library.space import OneOf, Space
from asia.agents.library.trial_evidence import coloured
from asia.recipe import Recipe

_MOVES = (
    Move(
        name="linear model of the residual",
        evidence=lambda c: (
            (LIKELY if coloured(c.trial) else POSSIBLE) * (not c.recipe.get("residual"))
        ),
        change=lambda c: c.recipe.configured(residual="linear"),
        hypothesis="The simulator lacks a lag or an offset: a linear model of inputs and simulated "
        "outputs explains part of its error.",
        expected="A whiter residual and a lower V on every fold.",
    ),
    Move(
        name="neural model of the residual",
        evidence=lambda c: (
            (c.recipe.get("residual") == "linear") * (LIKELY if coloured(c.trial) else POSSIBLE)
        ),
        change=lambda c: c.recipe.configured(residual="neural_ss"),
        hypothesis="The error of the simulator depends on its operating point.",
        expected="A lower V on every fold; a lower training error alone is overfitting.",
    ),
    Move(
        name="search without gradients",
        evidence=lambda c: c.recipe.get("search") != "global",
        change=lambda c: c.recipe.configured(search="global"),
        hypothesis="The calibration ended in a local minimum.",
        expected="Parameters that agree between folds, and a lower training error.",
    ),
)

CARD = Card(
    (
        Family(
            name="simulator",
            label="simulator",
            use="the simulator of the problem file, calibrated",
            base=10,
            needs=frozenset({"plant"}),
            irregular=True,
            intersample=True,
            start=lambda _: Recipe("simulator", (), LM, (("iterations", 30), ("starts", 3))),
            space=lambda _: Space(
                config=(
                    OneOf("search", ("auto", "global")),
                    OneOf("residual", (None, "linear", "neural_ss")),
                ),
                options=(OneOf("iterations", (20, 40)), OneOf("starts", (2, 4, 8))),
            ),
            small=(("iterations", 3), ("starts", 1)),
            timing=Timing(start=0.1, unit=1e-6),
            extendable=True,
        ),
    ),
    _MOVES,
)
