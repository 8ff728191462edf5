"""A linear system with a few static functions in feedback."""

from asia.agents.library.family import Family, Path, Timing
from asia.agents.library.methods import (
    LM,
    from_pieces,
    integrator_moves,
    integrator_setting,
    noise_space,
    slow_noise,
)
from asia.agents.library.move import LIKELY, POSSIBLE, Card, Move, Situation
from asia.agents.library.space import OneOf, Space, Span
from asia.agents.library.traits import traits
from asia.agents.library.trial_evidence import coloured
from asia.agents.view import Facts
from asia.recipe import Arguments, Recipe


def _nl_lfr(facts: Facts) -> Recipe:
    outputs = len(facts.outputs)
    channels = 1 if outputs == 1 else min(outputs + 1, 3)
    # Over a whole record every error of a rate, or of the frequency of a mode, adds up.
    apart = {"integrating", "resonant"} & traits(facts)
    pieces: Arguments = (("pieces", True),) if apart else ()
    config: Arguments = (
        ("channels", channels),
        ("hidden", 12),
        ("delay", None),
        *pieces,
        *integrator_setting(facts),
    )
    return Recipe("nl_lfr", config, LM, (("iterations", 60), ("starts", 2)))


def _channels(at: Situation) -> int:
    return round(at.recipe.number("channels", 1))


def _space(facts: Facts) -> Space:
    return Space(
        config=(
            OneOf("order", (None, 1, 2, 3, 4)),
            OneOf("channels", (1, 2, 3)),
            OneOf("hidden", (8, 12, 16)),
            Span("ridge", 1e-7, 1e-3),
            OneOf("delay", (0, None)),
            OneOf("integrators", (0, 1)),
            OneOf("pieces", (False, True)),
        ),
        options=(OneOf("iterations", (40, 60)), OneOf("starts", (2, 4)), *noise_space(facts)),
    )


CARD = Card(
    (
        Family(
            name="nl_lfr",
            label="nonlinear LFR",
            use="a linear system with a few static functions in feedback: nonlinear springs, "
            "friction, valves, sensors and actuators",
            base=6.5,
            points=(("short", 1), ("long", -2), ("windows", -4)),
            start=_nl_lfr,
            space=_space,
            small=(("hidden", 3), ("iterations", 3), ("starts", 1)),
            path=Path("ridge", (1e-2, 1e-4, 1e-6)),
            timing=Timing(start=6.2, unit=3.3e-05),
            has_static=True,
        ),
    ),
    (
        *integrator_moves(),
        Move(
            name="one channel more",
            # One function of one signal is seldom all.
            evidence=lambda c: (LIKELY if coloured(c.trial) else POSSIBLE) * (_channels(c) < 4),
            change=lambda c: c.recipe.configured(channels=_channels(c) + 1),
            hypothesis="The functions depend on more signals than they receive: products of a "
            "state and an input, or several nonlinearities in the system.",
            expected="A lower training error and a whiter residual, V follows.",
        ),
        from_pieces(),
        Move(
            name="finer functions",
            evidence=lambda c: (
                (LIKELY if coloured(c.trial) else POSSIBLE) * (c.recipe.number("hidden", 12) < 30)
            ),
            change=lambda c: c.recipe.configured(hidden=round(1.6 * c.recipe.number("hidden", 12))),
            hypothesis="A function has a corner or is strongly curved within a narrow range: it "
            "needs more units.",
            expected="A lower training error and V, down to the noise floor.",
        ),
        slow_noise(),
    ),
)
