"""Hybrid model: the problem's equations with a learned residual."""

from asia.agents.library.family import Family, Path, Timing
from asia.agents.library.methods import LM
from asia.agents.library.move import Card
from asia.agents.library.space import OneOf, Space, Span
from asia.recipe import Recipe

CARD = Card(
    (
        Family(
            name="hybrid",
            label="hybrid",
            use="the problem's equations with a learned residual",
            base=3,
            points=(("windows", -2), ("measured", -2)),
            needs=frozenset({"physics"}),
            irregular=True,
            intersample=True,
            start=lambda _: Recipe(
                "hybrid", (("units", 4),), LM, (("iterations", 60), ("starts", 8))
            ),
            space=lambda _: Space(
                config=(OneOf("units", (2, 4, 8)), Span("ridge", 1e-4, 1e-1)),
                options=(OneOf("iterations", (40, 80)), OneOf("starts", (4, 8))),
            ),
            small=(("units", 4), ("iterations", 3), ("starts", 1)),
            path=Path("ridge", (1e-1, 1e-2, 1e-3)),
            timing=Timing(start=0.4, unit=4.7e-05),
        ),
    )
)
