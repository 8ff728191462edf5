"""A linear system with a few static functions in feedback."""

from __future__ import annotations

from asia.agents.library.card import Card
from asia.agents.library.cost import Timing
from asia.agents.library.equation_moves import less_ridge, more_ridge, much_more_ridge
from asia.agents.library.family import Family
from asia.agents.library.methods import (
    LM,
    from_pieces,
    integrator_moves,
    integrator_setting,
    noise_space,
    slow_noise,
)
from asia.agents.library.move import Move, Situation
from asia.agents.library.recipe import Recipe
from asia.agents.library.records import coloured
from asia.agents.library.space import OneOf, Space, Span
from asia.agents.view import Facts

_MOST_CHANNELS, _MOST_UNITS = 4, 30


def _nl_lfr(facts: Facts) -> Recipe:
    outputs = len(facts.outputs)
    channels = 1 if outputs == 1 else min(outputs + 1, 3)
    config = (("channels", channels), ("hidden", 12), ("ridge", 1e-6), ("delay", None))
    settings = (*config, *integrator_setting(facts))
    return Recipe("nl_lfr", settings, LM, (("iterations", 60), ("starts", 2)))


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
        options=(
            OneOf("iterations", (40, 60)),
            OneOf("starts", (2, 4)),
            *noise_space(facts),
        ),
    )


def _channels(at: Situation) -> int:
    return round(at.recipe.number("channels", 1))


def _channel_weight(at: Situation) -> float:
    """Near certain while the residual is coloured: one function of one signal is seldom all."""
    if _channels(at) >= _MOST_CHANNELS:
        return 0.0
    return 0.92 if coloured(at.trial) else 0.6


def _one_more(at: Situation) -> Recipe:
    return at.recipe.configured(channels=_channels(at) + 1)


def _finer_weight(at: Situation) -> float:
    if at.recipe.number("hidden", 12) >= _MOST_UNITS:
        return 0.0
    return 0.75 if coloured(at.trial) else 0.45


def _pieces_weight(at: Situation) -> float:
    if at.facts.horizon is not None or at.recipe.get("pieces"):
        return 0.0
    return 0.8 if coloured(at.trial) else 0.3


CARD = Card(
    (
        Family(
            name="nl_lfr",
            label="nonlinear LFR",
            use=(
                "a linear system with a few static functions in feedback: nonlinear springs, "
                "friction, valves, sensors and actuators"
            ),
            base=6.5,
            points=(("short", 1), ("long", -2), ("windows", -4)),
            start=_nl_lfr,
            space=_space,
            small=(("hidden", 3), ("iterations", 3), ("starts", 1)),
            timing=Timing(start=6.2, unit=3.3e-05),
        ),
    ),
    (
        more_ridge(),
        much_more_ridge(),
        less_ridge(),
        slow_noise(),
        *integrator_moves(),
        Move(
            name="one channel more",
            weight=_channel_weight,
            change=_one_more,
            hypothesis=(
                "The functions depend on more signals than they receive: products of a state "
                "and an input, or several nonlinearities in the system."
            ),
            expected="A lower training error and a whiter residual, V follows.",
        ),
        Move(
            name="finer functions",
            weight=_finer_weight,
            change=lambda c: c.recipe.configured(hidden=round(1.6 * c.recipe.number("hidden", 12))),
            hypothesis=(
                "A function has a corner or is strongly curved within a narrow range: it needs "
                "more units."
            ),
            expected="A lower training error and V, down to the noise floor.",
        ),
        from_pieces(_pieces_weight),
        Move(
            name="more starts",
            weight=lambda c: 0.55 * (c.recipe.number("starts", 2) < 5),
            change=lambda c: c.recipe.trained(starts=5),
            hypothesis=(
                "The inputs of the functions are chosen from the linear model's residual, and "
                "the best choice may be wrong: more choices are fitted."
            ),
            expected="The same or a lower training error.",
        ),
    ),
)
