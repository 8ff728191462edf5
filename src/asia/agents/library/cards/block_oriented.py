"""Linear systems in series with static functions."""

from __future__ import annotations

from asia.agents._view import Facts
from asia.agents.library.card import Card
from asia.agents.library.cost import Timing
from asia.agents.library.family import Family
from asia.agents.library.methods import LM, noise_space, slow_noise
from asia.agents.library.move import Move
from asia.agents.library.recipe import Recipe
from asia.agents.library.ridge import less_ridge, more_ridge, much_more_ridge
from asia.agents.library.space import OneOf, Space, Span

_STRUCTURES = ("hammerstein", "wiener", "hammerstein_wiener", "wiener_hammerstein")


def _block_oriented(_: Facts) -> Recipe:
    config = (("structure", "wiener_hammerstein"), ("hidden", 8), ("ridge", 1e-5), ("delay", None))
    return Recipe("block_oriented", config, LM, (("iterations", 60), ("starts", 2)))


def _space(facts: Facts) -> Space:
    return Space(
        config=(
            OneOf("structure", _STRUCTURES),
            OneOf("order", (None, 2, 3, 4)),
            OneOf("hidden", (4, 8, 12)),
            Span("ridge", 1e-6, 1e-2),
            OneOf("delay", (0, None)),
        ),
        options=(
            OneOf("iterations", (40, 80)),
            OneOf("starts", (1, 2, 4)),
            *noise_space(facts),
        ),
    )


def _to(structure: str, where: str, hypothesis: str) -> Move:
    return Move(
        name=f"static function {where} the system",
        weight=lambda c: 0.0 if c.recipe.get("structure") == structure else 0.45,
        change=lambda c: c.recipe.configured(structure=structure),
        hypothesis=hypothesis,
        expected="A lower V at the same training error, if the structure is right.",
    )


CARD = Card(
    (
        Family(
            name="block_oriented",
            label="block-oriented model",
            use="linear systems in series with static functions: actuators and sensors that bend",
            base=5,
            points=(("long", -1), ("windows", -3), ("several", -1)),
            start=_block_oriented,
            space=_space,
            small=(("hidden", 3), ("iterations", 3), ("starts", 1)),
            timing=Timing(start=1.9, unit=4.1e-06),
        ),
    ),
    (
        slow_noise(),
        more_ridge(),
        much_more_ridge(),
        less_ridge(),
        _to("hammerstein", "before", "The actuator bends, all else is linear (Hammerstein)."),
        _to("wiener", "after", "The sensor bends, all else is linear (Wiener)."),
    ),
)
