"""Linear models: state space and difference equations."""

from __future__ import annotations

from dataclasses import replace

from asia.agents._view import Facts
from asia.agents.library.card import Card
from asia.agents.library.cost import Timing
from asia.agents.library.family import Family
from asia.agents.library.methods import (
    LM,
    integrator_moves,
    integrator_setting,
    noise_space,
    slow_noise,
)
from asia.agents.library.recipe import Recipe
from asia.agents.library.space import OneOf, Space


def _linear(facts: Facts) -> Recipe:
    config = (("order", None), ("delay", None), *integrator_setting(facts))
    return Recipe("linear", config, LM, (("iterations", 30),))


def _linear_space(facts: Facts) -> Space:
    return Space(
        config=(
            OneOf("order", (None, 1, 2, 3, 4, 5, 6)),
            OneOf("delay", (0, None)),
            OneOf("integrators", (0, 1)),
        ),
        options=(OneOf("iterations", (15, 30, 60)), *noise_space(facts)),
    )


def _arx(_: Facts) -> Recipe:
    return Recipe("arx", (("structure", "oe"), ("delay", None)), LM, (("iterations", 30),))


def _arx_space(_: Facts) -> Space:
    return Space(
        config=(
            OneOf("na", (None, 1, 2, 3, 4)),
            OneOf("nb", (None, 1, 2, 3, 4)),
            OneOf("delay", (0, None)),
            OneOf("structure", ("arx", "oe")),
        ),
        options=(OneOf("iterations", (15, 30, 60)),),
    )


CARD = Card((
    Family(
        name="linear",
        label="linear state-space",
        use="how far a linear model goes, and the start of the nonlinear ones",
        base=7,
        points=(("windows", -3),),
        start=_linear,
        space=_linear_space,
        small=(("order", 1), ("iterations", 3)),
        timing=Timing(start=0.2, unit=2e-06),
    ),
    Family(
        name="arx",
        label="output-error model",
        use="a linear difference equation, where its coefficients are wanted",
        base=2,
        points=(("windows", -1),),
        start=_arx,
        space=_arx_space,
        small=(("iterations", 3),),
        timing=Timing(start=0.0, unit=1.4e-06),
    ),
), (
    replace(slow_noise(), families=("linear",)),
    *(replace(move, families=("linear",)) for move in integrator_moves()),
))  # fmt: skip
