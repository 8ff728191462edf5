"""A static function between two linear systems."""

from asia.agents.library.family import Family, Path, Timing
from asia.agents.library.methods import LM, noise_space, slow_noise
from asia.agents.library.move import LIKELY, Card, Move
from asia.agents.library.space import OneOf, Space, Span
from asia.agents.library.traits import traits
from asia.agents.view import Facts
from asia.recipe import Arguments, Recipe


def _start(facts: Facts) -> Recipe:
    size: Arguments = (("hidden", 8),)
    if "long" in traits(facts):
        # There are samples to spare for a fine grid, and the noise floor lies far below what a
        # ridge for short records allows.
        size = (("hidden", 24), ("ridge", 1e-9), ("linear_ridge", 1e-9))
    return Recipe(
        "block_oriented", (("delay", None), *size), LM, (("iterations", 60), ("starts", 2))
    )


CARD = Card(
    (
        Family(
            name="block_oriented",
            label="Wiener-Hammerstein model",
            use="a static function between two linear systems, with one input and one output",
            base=5,
            points=(("long", 1),),
            needs=frozenset({"single"}),
            unfit=frozenset({"windows"}),
            # Its filters are stable; a static function next to an integrator is not identifiable.
            against=frozenset({"integrating"}),
            start=_start,
            space=lambda facts: Space(
                config=(
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
            ),
            small=(("hidden", 3), ("iterations", 3), ("starts", 1)),
            path=Path("ridge", (1e-1, 1e-3, 1e-5)),
            timing=Timing(start=1.9, unit=4.1e-06),
        ),
    ),
    (
        Move(
            name="finer static function",
            evidence=lambda _: LIKELY,
            change=lambda c: c.recipe.configured(
                hidden=round(1.6 * c.recipe.number("hidden", 8.0))
            ).trained(starts=3),
            hypothesis="The static function is strongly curved within a narrow range: its grid "
            "needs more units.",
            expected="A lower V at a lower training error, down to the noise floor.",
        ),
        slow_noise(),
    ),
)
