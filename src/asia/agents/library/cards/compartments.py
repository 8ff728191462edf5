"""Storages in series, for systems that fill and run off."""

from asia.agents.library.family import Family, Timing
from asia.agents.library.methods import LM, noise_space, slow_noise
from asia.agents.library.move import LIKELY, POSSIBLE, SHOWN, Card, Move, Situation
from asia.agents.library.plants import usual_effects
from asia.agents.library.space import OneOf, Space
from asia.agents.library.trial_evidence import fails_on_top
from asia.agents.view import Facts
from asia.data.statistics import plateau_share
from asia.recipe import Arguments, Recipe


def _saturates(facts: Facts) -> bool:
    return plateau_share(facts.records) > 0.02


def _start(facts: Facts) -> Recipe:
    limits: Arguments = (("full", True), ("spill", True)) if _saturates(facts) else ()
    config = (("count", 2), ("outflow", "power"), *limits)
    return Recipe("compartments", config, LM, (("iterations", 60), ("starts", 8)))


def _space(facts: Facts) -> Space:
    return Space(
        config=(
            OneOf("count", (1, 2, 3)),
            OneOf("outflow", ("linear", "root", "power")),
            OneOf("full", (False, True)),
            OneOf("spill", (False, True), needs="full"),
            OneOf("sensor", (None, "power", "spline")),
        ),
        options=(OneOf("iterations", (40, 80)), OneOf("starts", (4, 8, 16)), *noise_space(facts)),
    )


def _count(at: Situation) -> int:
    return round(at.recipe.number("count", 2))


CARD = Card(
    (
        Family(
            name="compartments",
            label="compartments",
            use="storages in series that fill, drain and overflow: levels, temperatures, contents",
            base=4.5,
            points=(("short", 0.5), ("several", -1)),
            against=frozenset({"integrating"}),
            # Contents cannot be negative, so that no change of sign is a symmetry.
            unfit=frozenset({"windows", "long", "symmetric"}),
            start=_start,
            space=_space,
            small=(("iterations", 3), ("starts", 1)),
            timing=Timing(start=1.3, unit=1.7e-06),
            intersample=True,
        ),
    ),
    (
        Move(
            name="storages run over",
            evidence=lambda c: (
                (SHOWN if fails_on_top(c.trial) or _saturates(c.facts) else POSSIBLE)
                * ("spill" in usual_effects(c.facts) and (not c.recipe.get("full")))
            ),
            change=lambda c: c.recipe.configured(full=True, spill=True),
            hypothesis="Each storage can be full, and part of its overflow enters the next.",
            expected="Lower error where the output is high, on every fold that reaches this range.",
        ),
        Move(
            name="bent sensor",
            evidence=lambda c: LIKELY * (c.recipe.get("sensor") is None),
            change=lambda c: c.recipe.configured(sensor="power"),
            hypothesis="The output need not be proportional to the content: an increasing curve "
            "relates them.",
            expected="A lower V; the curvature in the residual disappears.",
        ),
        Move(
            name="one storage more",
            evidence=lambda c: _count(c) < 4,
            change=lambda c: c.recipe.configured(count=_count(c) + 1),
            hypothesis="The output responds later than this number of storages does.",
            expected="A whiter residual just after steps of the input.",
        ),
        slow_noise(),
    ),
)
