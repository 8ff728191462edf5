"""Linear systems in series with static functions."""

from asia.agents.library.family import Family, Path, Timing
from asia.agents.library.methods import LM, noise_space, slow_noise
from asia.agents.library.move import LIKELY, Card, Move
from asia.agents.library.space import OneOf, Space, Span
from asia.agents.library.traits import traits
from asia.agents.view import Facts
from asia.recipe import Arguments, Recipe


def _searchable(facts: Facts) -> bool:
    """Return whether the two filters can be searched: one input, one output, whole records."""
    return facts.horizon is None and len(facts.inputs) == len(facts.outputs) == 1


def _start(facts: Facts) -> Recipe:
    size: Arguments = (("hidden", 8),)
    if _searchable(facts) and "long" in traits(facts):
        # The searched fit has samples to spare for a fine grid, and its noise floor lies far below
        # what a ridge for short records allows.
        size = (("hidden", 24), ("ridge", 1e-9), ("linear_ridge", 1e-9), ("searched", True))
    config = (("structure", "wiener_hammerstein"), ("delay", None), *size)
    return Recipe("block_oriented", config, LM, (("iterations", 60), ("starts", 2)))


def _space(facts: Facts) -> Space:
    structures = ("hammerstein", "wiener", "hammerstein_wiener", "wiener_hammerstein")
    searched = OneOf("searched", (False, True), needs="structure", being="wiener_hammerstein")
    return Space(
        config=(
            OneOf("structure", structures),
            OneOf("order", (None, 2, 3, 4)),
            OneOf("hidden", (4, 8, 12)),
            Span("ridge", 1e-6, 1e-2),
            OneOf("delay", (0, None)),
            *((searched,) if _searchable(facts) else ()),
        ),
        options=(OneOf("iterations", (40, 80)), OneOf("starts", (1, 2, 4)), *noise_space(facts)),
    )


def _to(structure: str, where: str, hypothesis: str) -> Move:
    return Move(
        name=f"static function {where} the system",
        evidence=lambda c: c.recipe.get("structure") != structure,
        change=lambda c: c.recipe.without("searched", "linear_ridge").configured(
            structure=structure
        ),
        hypothesis=hypothesis,
        expected="A lower V at the same training error, if the structure is right.",
    )


CARD = Card(
    (
        Family(
            name="block_oriented",
            label="block-oriented model",
            use="linear systems in series with static functions: nonlinear actuators and sensors",
            base=5,
            points=(("long", 1), ("windows", -3), ("several", -2)),
            # Its filters are stable; a static function next to an integrator is not identifiable.
            against=frozenset({"integrating"}),
            start=_start,
            space=_space,
            small=(("hidden", 3), ("iterations", 3), ("starts", 1)),
            path=Path("ridge", (1e-1, 1e-3, 1e-5)),
            timing=Timing(start=1.9, unit=4.1e-06),
        ),
    ),
    (
        Move(
            name="search for the two filters",
            evidence=lambda c: (
                LIKELY
                * (c.recipe.get("structure") == "wiener_hammerstein" and _searchable(c.facts))
                * (not c.recipe.get("searched"))
            ),
            change=lambda c: c.recipe.configured(searched=True, hidden=12),
            hypothesis="Two filters around a static function differ in order and in their shares "
            "of poles and zeros; the best linear model shows neither.",
            expected="A far lower V, if the structure is right.",
        ),
        Move(
            name="finer static function",
            evidence=lambda c: LIKELY * bool(c.recipe.get("searched")),
            change=lambda c: c.recipe.configured(
                hidden=round(1.6 * c.recipe.number("hidden", 8.0))
            ).trained(starts=3),
            hypothesis="The static function is strongly curved within a narrow range: its grid "
            "needs more units.",
            expected="A lower V at a lower training error, down to the noise floor.",
        ),
        _to(
            "hammerstein", "before", "The actuator is nonlinear, the rest is linear (Hammerstein)."
        ),
        _to("wiener", "after", "The sensor is nonlinear, the rest is linear (Wiener)."),
        slow_noise(),
    ),
)
