"""Echo state networks."""

from asia.agents.library.family import Family, Timing
from asia.agents.library.move import Card, Move
from asia.agents.library.space import OneOf, Space, Span
from asia.recipe import Recipe

CARD = Card(
    (
        Family(
            name="esn",
            label="echo state network",
            use="a random reservoir with a linear readout, fitted in seconds",
            base=2.5,
            points=(("long", 1),),
            against=frozenset({"integrating"}),
            start=lambda _: Recipe(
                "esn",
                (("units", 300), ("radius", 0.9), ("input_scale", 0.5), ("longest", 50.0)),
                "LeastSquares",
                (("ridge", None),),
            ),
            space=lambda _: Space(
                config=(
                    OneOf("units", (100, 300, 600, 1200)),
                    Span("radius", 0.5, 1.2),
                    Span("input_scale", 0.05, 2.0),
                    Span("longest", 10.0, 300.0),
                ),
                options=(),
            ),
            small=(("units", 4),),
            timing=Timing(start=0.0, unit=0.00017),
        ),
    ),
    (
        Move(
            name="larger reservoir",
            evidence=lambda c: c.recipe.number("units", 0) < 1000,
            change=lambda c: c.recipe.configured(units=round(2 * c.recipe.number("units", 300))),
            hypothesis="A larger reservoir offers more functions of the past to the readout.",
            expected="Lower training error, V follows.",
        ),
    ),
)
