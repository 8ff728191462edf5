"""Nonlinear models that predict one step ahead and are simulated on their own output."""

from asia.agents.library.family import Family, Path, Timing
from asia.agents.library.methods import LM
from asia.agents.library.move import LIKELY, POSSIBLE, Card, Move
from asia.agents.library.space import OneOf, Space, Span
from asia.data.statistics import plateau_share
from asia.recipe import Recipe

CARD = Card(
    (
        Family(
            name="narx",
            label="polynomial NARX",
            use="a few products of lagged signals, readable: smooth nonlinearities, low noise",
            base=4,
            points=(("short", 0.5), ("windows", -3), ("several", -1)),
            start=lambda _: Recipe(
                "narx",
                (("degree", 2), ("delay", 0), ("margin", 0.1)),
                LM,
                (("iterations", 40),),
            ),
            space=lambda _: Space(
                config=(
                    OneOf("na", (None, 1, 2, 3)),
                    OneOf("nb", (None, 1, 2, 3)),
                    OneOf("delay", (0, None)),
                    OneOf("degree", (2, 3)),
                    OneOf("terms", (None, 8, 15, 25)),
                    OneOf("margin", (0.0, 0.05, 0.1, 0.3)),
                    Span("coefficient_ridge", 1e-7, 1e-2),
                ),
                options=(OneOf("iterations", (15, 30, 60)),),
            ),
            small=(("iterations", 3),),
            path=Path("coefficient_ridge", (1e-1, 1e-3, 1e-5)),
            timing=Timing(start=0.4, unit=3.9e-06),
        ),
    ),
    (
        Move(
            name="output kept inside its range",
            evidence=lambda c: (
                (LIKELY if plateau_share(c.facts.records) > 0.02 else POSSIBLE)
                * (c.recipe.number("margin", 0.1) > 0)
            ),
            change=lambda c: c.recipe.configured(margin=0.0),
            hypothesis="The output reaches a limit in the records: the model must not exceed it.",
            expected="A lower V where the output is constant.",
        ),
        Move(
            name="terms up to the third degree",
            evidence=lambda c: c.recipe.number("degree", 2) < 3,
            change=lambda c: c.recipe.configured(degree=3),
            hypothesis="The nonlinearity is not even.",
            expected="A lower training error, V follows.",
        ),
    ),
)
