"""What may be lacking in a person's equations, and how it shows."""

from __future__ import annotations

from asia.agents.expert.evidence import (
    biased,
    coloured,
    fails_on_top,
    input_left,
    overfit,
    plateau_share,
)
from asia.agents.expert.move import Case, Move
from asia.agents.library.cards.rows_physics import output_offsets
from asia.agents.library.recipe import Recipe

GREY = ("greybox",)


def _names(case: Case, setting: str) -> tuple[str, ...]:
    value = case.recipe.get(setting)
    return tuple(str(name) for name in value) if isinstance(value, tuple) else ()


def _next_state(case: Case) -> tuple[str, ...]:
    """The saturated states and one more, the physics' states taken in order."""
    names = _names(case, "saturation")
    return (*names, *[s for s in case.states if s not in names][:1])


def _saturation_weight(case: Case) -> float:
    full = _names(case, "saturation")
    if _next_state(case) == full:
        return 0.0
    evidence = fails_on_top(case.trial) or plateau_share(case.facts) > 0.02
    if not full:
        return 0.95 if evidence else 0.6
    return 0.35 if evidence else 0.15


def _overflow_weight(case: Case) -> float:
    """A little above saturation alone while a next state exists to take the spill."""
    chain = len(case.states) > len(_next_state(case))
    fresh = not _names(case, "saturation")
    return 1.02 * _saturation_weight(case) if chain and fresh else 0.0


def _spill_weight(case: Case) -> float:
    several = len(case.states) > 1
    return 0.9 if several and _names(case, "saturation") and not case.recipe.get("spill") else 0.0


def _outputs(case: Case) -> tuple[str, ...]:
    return output_offsets(case.facts)


def _lacks(case: Case, names: tuple[str, ...]) -> bool:
    return bool(names) and not set(names) & set(_names(case, "offset"))


def _with_offset(case: Case, names: tuple[str, ...]) -> Recipe:
    return case.recipe.configured(offset=(*_names(case, "offset"), *names))


def _ridge(case: Case, factor: float) -> Recipe:
    """The ridge that holds most of the weights: the network's, where there is one."""
    name, default = ("residual_ridge", 1e-2) if case.recipe.get("residual") else ("ridge", 1e-3)
    return case.recipe.times(name, factor, default)


GREYBOX_MOVES: tuple[Move, ...] = (
    Move(
        name="{state} saturates",
        families=GREY,
        weight=_saturation_weight,
        change=lambda c: c.recipe.configured(saturation=_next_state(c)),
        state=lambda c: _next_state(c)[-1],
        hypothesis="A state has an upper limit that the equations do not know: errors gather where "
        "the output is high or stands still.",
        expected="Lower error near the top of the output; the limit settles inside the data.",
    ),
    Move(
        name="{state} runs over",
        families=GREY,
        weight=_overflow_weight,
        change=lambda c: c.recipe.configured(saturation=_next_state(c), spill=True),
        state=lambda c: _next_state(c)[-1],
        hypothesis="A state has an upper limit that the equations do not know, and part of what it "
        "cannot hold enters the next state: the next state moves with the input at once when the "
        "first is full.",
        expected="Lower error where the output is high, on every fold where the limit is reached.",
    ),
    Move(
        name="a full {state} spills over",
        families=GREY,
        weight=_spill_weight,
        change=lambda c: c.recipe.configured(spill=True),
        state=lambda c: _names(c, "saturation")[0],
        hypothesis="What a full state cannot hold is not lost: part of it enters the next state.",
        expected="Lower error just after the limit is reached, on every fold.",
    ),
    Move(
        name="output offset",
        families=GREY,
        weight=lambda c: (0.8 if biased(c.trial) else 0.4) * _lacks(c, _outputs(c)),
        change=lambda c: _with_offset(c, _outputs(c)),
        hypothesis="The sensor's zero is not the equations' zero.",
        expected="Less bias; the fit at low outputs improves most.",
    ),
    Move(
        name="constant in and outflow",
        families=GREY,
        weight=lambda c: (0.75 if coloured(c.trial) else 0.5) * _lacks(c, c.states),
        change=lambda c: _with_offset(c, c.states),
        hypothesis="Each balance lacks a constant: a leak, a dead zone, a level whose zero is not "
        "where the equations put it.",
        expected="Lower error away from the mean level, on every fold.",
    ),
    Move(
        name="linear term",
        families=GREY,
        weight=lambda c: 0 if c.recipe.get("linear") else 0.5 if coloured(c.trial) else 0.3,
        change=lambda c: c.recipe.configured(linear=True),
        hypothesis="The residual is not white: a small linear term in states and inputs stands for "
        "dynamics the equations leave out.",
        expected="Lower error and a whiter residual, with the physics still dominant.",
    ),
    Move(
        name="residual network",
        families=GREY,
        weight=lambda c: 0 if c.recipe.get("residual") else 0.65 if coloured(c.trial) else 0.35,
        change=lambda c: c.recipe.configured(residual=4),
        hypothesis="What is left depends on the state in a way the equations do not have: a small "
        "network in the dynamics, held small by its prior, can learn it.",
        expected="Lower training error; lower V only if the effect is real.",
    ),
    Move(
        name="residual network, held tighter",
        families=GREY,
        weight=lambda c: 0 if c.recipe.get("residual") else 0.6 if coloured(c.trial) else 0.3,
        change=lambda c: c.recipe.configured(residual=4, residual_ridge=5e-2),
        hypothesis="The equations lack an effect of the state, and a small network finds it only "
        "if its prior keeps it from following its own fold.",
        expected="Less gain on the training side than a free network, and more on V.",
    ),
    Move(
        name="wider residual network",
        families=GREY,
        weight=lambda c: (
            (0.45 if overfit(c.trial) < 1.5 else 0.2) * (0 < c.recipe.number("residual", 0) < 12)
        ),
        change=lambda c: c.recipe.configured(residual=round(2 * c.recipe.number("residual", 4))),
        hypothesis="V is near the training error with the network in: it may carry more.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="more ridge",
        families=GREY,
        weight=lambda c: (
            0.75 if overfit(c.trial) > 2.0 else 0.45 if overfit(c.trial) > 1.3 else 0.1
        ),
        change=lambda c: _ridge(c, 10.0),
        hypothesis="V is well above the training error: the additions follow their own fold.",
        expected="A slightly higher training error and a lower V.",
    ),
    Move(
        name="less ridge",
        families=GREY,
        weight=lambda c: 0.5 if overfit(c.trial) < 1.3 else 0.15,
        change=lambda c: _ridge(c, 0.1),
        hypothesis="V is near the training error: the priors hold the model back.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="robust loss",
        families=GREY,
        weight=lambda c: 0 if c.recipe.get("robust") else 0.3,
        change=lambda c: c.recipe.configured(robust=0.1),
        hypothesis="A few samples that no parameter can explain pull the rest away.",
        expected="About the same training error, steadier parameters over the folds.",
    ),
    Move(
        name="input delay",
        families=GREY,
        weight=lambda c: 0 if c.recipe.get("input_delay") else 0.5 if input_left(c.trial) else 0.2,
        change=lambda c: c.recipe.configured(input_delay=3.0),
        hypothesis="The input acts later than the equations say.",
        expected="The input no longer explains the residual.",
    ),
)
