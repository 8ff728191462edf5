"""What ASIA's agents know of the family."""

from __future__ import annotations

from asia.agents import Facts
from asia.agents.library.family import Family
from asia.agents.library.move import Card, Move
from asia.agents.library.space import Space, Span
from asia.recipe import Recipe


def _start(_: Facts) -> Recipe:
    return Recipe("fir", (("taps", 40),), "LeastSquares", (("ridge", None),))


def _space(_: Facts) -> Space:
    return Space(config=(Span("taps", 5, 200, whole=True),), options=(Span("ridge", 1e-6, 1e-1),))


CARD = Card(
    families=(
        Family(
            name="fir",
            package="asia_example",
            label="finite impulse response",
            use="a stable system that forgets its past, with no choice of order",
            base=6.5,
            points=(("long", 1), ("windows", -4)),
            start=_start,
            space=_space,
            small=(("taps", 5),),
        ),
    ),
    moves=(
        Move(
            name="longer response",
            evidence=lambda case: case.recipe.number("taps", 0) < 150,
            change=lambda case: case.recipe.times("taps", 2.0, 40),
            hypothesis="The response is longer than the taps.",
            expected="Lower error on every fold.",
        ),
    ),
)
