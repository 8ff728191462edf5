"""The expert's moves: what to change, when, why, and what should come of it.

One row a move. To teach the expert something, add a row: the condition reads training-side
evidence, the change makes a new recipe, the words are recorded before the outcome is known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from asia.agents._evidence import (
    biased,
    coloured,
    curved,
    fails_on_top,
    input_left,
    overfit,
    plateau_share,
)
from asia.agents._recipe import Recipe
from asia.agents._view import Facts, Trial


@dataclass(frozen=True)
class Case:
    """What a move decides from: the problem, the trial it would start from, that trial's recipe."""

    facts: Facts
    trial: Trial
    recipe: Recipe


@dataclass(frozen=True)
class Move:
    """`weight` is how promising the move is on a case, 0 when it does not apply; `{state}` in the
    name is the state it acts on."""

    name: str
    families: tuple[str, ...]
    weight: Callable[[Case], float]
    change: Callable[[Case], Recipe]
    hypothesis: str
    expected: str

    def title(self, case: Case) -> str:
        """The name with its state filled in."""
        full = case.recipe.get("saturation")
        spilling = full[0] if isinstance(full, tuple) and full else ""
        state = spilling if "a full" in self.name else "".join(_next_state(case)[-1:])
        return self.name.format(state=state)


def _next_state(case: Case) -> tuple[str, ...]:
    """The saturated states and one more, the physics' states taken in order."""
    full = case.recipe.get("saturation") or ()
    names = full if isinstance(full, tuple) else ()
    states = case.facts.physics.states if case.facts.physics else ()
    return (*names, *[s for s in states if s not in names][:1])


def _saturation_left(case: Case) -> bool:
    states = case.facts.physics.states if case.facts.physics else ()
    return len(_next_state(case)) <= len(states) and _next_state(case) != (
        case.recipe.get("saturation") or ()
    )


def _saturation_weight(case: Case) -> float:
    if not _saturation_left(case):
        return 0.0
    first = not case.recipe.get("saturation")
    evidence = fails_on_top(case.trial) or plateau_share(case.facts) > 0.02
    return (0.95 if evidence else 0.6) if first else (0.35 if evidence else 0.15)


def _overflow_weight(case: Case) -> float:
    """A little above saturation alone while a next state exists to take the spill."""
    chain = len(_states(case)) > len(_next_state(case))
    fresh = not case.recipe.get("saturation")
    return 1.02 * _saturation_weight(case) if chain and fresh else 0.0


def _spill_weight(case: Case) -> float:
    several = case.facts.physics is not None and len(case.facts.physics.states) > 1
    return 0.9 if several and case.recipe.get("saturation") and not case.recipe.get("spill") else 0


def _outputs(case: Case) -> tuple[str, ...]:
    """Outputs that are not states by name, whose offsets would be confused."""
    return tuple(s.name for s in case.facts.outputs if s.name not in _states(case))


def _states(case: Case) -> tuple[str, ...]:
    return case.facts.physics.states if case.facts.physics else ()


def _offsets(case: Case) -> tuple[str, ...]:
    value = case.recipe.get("offset")
    return value if isinstance(value, tuple) else ()


def _lacks(case: Case, names: tuple[str, ...]) -> bool:
    return bool(names) and not set(names) & set(_offsets(case))


GREY = ("greybox",)

MOVES: tuple[Move, ...] = (
    Move(
        name="{state} saturates",
        families=GREY,
        weight=_saturation_weight,
        change=lambda c: c.recipe.configured(saturation=_next_state(c)),
        hypothesis="A state has an upper limit that the equations do not know: errors gather where "
        "the output is high or stands still.",
        expected="Lower error near the top of the output; the limit settles inside the data.",
    ),
    Move(
        name="{state} runs over",
        families=GREY,
        weight=_overflow_weight,
        change=lambda c: c.recipe.configured(saturation=_next_state(c), spill=True),
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
        hypothesis="What a full state cannot hold is not lost: part of it enters the next state.",
        expected="Lower error just after the limit is reached, on every fold.",
    ),
    Move(
        name="output offset",
        families=GREY,
        weight=lambda c: (0.8 if biased(c.trial) else 0.4) * _lacks(c, _outputs(c)),
        change=lambda c: c.recipe.configured(offset=(*_offsets(c), *_outputs(c))),
        hypothesis="The sensor's zero is not the equations' zero.",
        expected="Less bias; the fit at low outputs improves most.",
    ),
    Move(
        name="constant in and outflow",
        families=GREY,
        weight=lambda c: (0.75 if coloured(c.trial) else 0.5) * _lacks(c, _states(c)),
        change=lambda c: c.recipe.configured(offset=(*_offsets(c), *_states(c))),
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
        families=("greybox",),
        weight=lambda c: 0 if c.recipe.get("residual") else 0.65 if coloured(c.trial) else 0.35,
        change=lambda c: c.recipe.configured(residual=4),
        hypothesis="What is left depends on the state in a way the equations do not have: a small "
        "network in the dynamics, held small by its prior, can learn it.",
        expected="Lower training error; lower V only if the effect is real.",
    ),
    Move(
        name="more ridge",
        families=(*GREY, "neural_ss"),
        weight=lambda c: (
            0.75 if overfit(c.trial) > 2.0 else 0.45 if overfit(c.trial) > 1.3 else 0.1
        ),
        change=lambda c: _with_ridge(c, 10.0),
        hypothesis="V is well above the training error: the additions follow their own fold.",
        expected="A slightly higher training error and a lower V.",
    ),
    Move(
        name="much more ridge",
        families=("neural_ss",),
        weight=lambda c: 0.85 if overfit(c.trial) > 2.0 else 0.5 if overfit(c.trial) > 1.3 else 0.1,
        change=lambda c: _with_ridge(c, 30.0),
        hypothesis="V is well above the training error: the nonlinear weights follow their own "
        "fold, or run away outside it.",
        expected="A higher training error and a lower V.",
    ),
    Move(
        name="median of several fits",
        families=("neural_ss",),
        weight=lambda c: 0 if c.recipe.get("members") else 0.55,
        change=lambda c: c.recipe.configured(members=3).trained(starts=4),
        hypothesis="Fits from different starts err differently; their median errs less.",
        expected="A lower and steadier V at the same training error.",
    ),
    Move(
        name="less ridge",
        families=(*GREY, "neural_ss"),
        weight=lambda c: 0.5 if overfit(c.trial) < 1.3 else 0.15,
        change=lambda c: _with_ridge(c, 0.1),
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
    Move(
        name="more starts",
        families=(*GREY, "neural_ss"),
        weight=lambda c: 0.25,
        change=lambda c: c.recipe.trained(starts=round(2 * c.recipe.number("starts", 1))),
        hypothesis="The best of the starting points may not be the best there is.",
        expected="The same or a lower training error.",
    ),
    Move(
        name="static function at the output",
        families=("neural_ss",),
        weight=lambda c: _nonlinearity(c, "output", 0.8 if curved(c.trial) else 0.7),
        change=lambda c: c.recipe.configured(nonlinearity="output"),
        hypothesis="The system may be linear with a static function after it (Wiener): fewer "
        "weights say the same.",
        expected="A lower V at the same training error, if the structure is right.",
    ),
    Move(
        name="static function at the input",
        families=("neural_ss",),
        weight=lambda c: _nonlinearity(c, "input", 0.7),
        change=lambda c: c.recipe.configured(nonlinearity="input"),
        hypothesis="The system may be linear with a static function before it (Hammerstein).",
        expected="A lower V at the same training error, if the structure is right.",
    ),
    Move(
        name="static functions on both sides",
        families=("neural_ss",),
        weight=lambda c: _nonlinearity(c, "both", 0.6),
        change=lambda c: c.recipe.configured(nonlinearity="both"),
        hypothesis="Static functions before and after a linear system (Hammerstein-Wiener).",
        expected="A lower V than either alone, if the structure is right.",
    ),
    Move(
        name="one state more",
        families=("neural_ss", "linear"),
        weight=lambda c: (0.6 if coloured(c.trial) else 0.3) * (_order(c) < 6),
        change=lambda c: c.recipe.configured(order=_order(c) + 1),
        hypothesis="The residual is not white: a mode is missing.",
        expected="A whiter residual and a lower V.",
    ),
    Move(
        name="wider network",
        families=("neural_ss", "ltc", "recurrent"),
        weight=lambda c: 0.45 if overfit(c.trial) < 1.5 else 0.15,
        change=lambda c: c.recipe.configured(hidden=round(2 * c.recipe.number("hidden", 8))),
        hypothesis="The training error is not much below V: the model is too small.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="narrower network",
        families=("ltc", "recurrent", "neural_ss"),
        weight=lambda c: (0.5 if overfit(c.trial) > 2.0 else 0.2) * (_hidden(c) >= 8),
        change=lambda c: c.recipe.configured(hidden=_hidden(c) // 2),
        hypothesis="V is well above the training error: there are too many weights.",
        expected="Higher training error, lower V.",
    ),
    Move(
        name="noise on the inputs in training",
        families=("ltc", "recurrent"),
        weight=lambda c: 0 if c.recipe.get("noise") else 0.5 if overfit(c.trial) > 1.5 else 0.25,
        change=lambda c: c.recipe.trained(noise=0.1),
        hypothesis="The network has learned the input record by heart: noise on it teaches the "
        "neighbourhood as well.",
        expected="A higher training error and a lower V.",
    ),
    Move(
        name="longer training",
        families=("ltc", "recurrent"),
        weight=lambda c: 0.4 if overfit(c.trial) < 1.5 else 0.1,
        change=lambda c: c.recipe.trained(steps=round(2 * c.recipe.number("steps", 1000))),
        hypothesis="The training curve still falls at the end.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="more weight decay",
        families=("ltc", "recurrent"),
        weight=lambda c: 0.45 if overfit(c.trial) > 2.0 else 0.15,
        change=lambda c: c.recipe.trained(weight_decay=10 * c.recipe.number("weight_decay", 1e-3)),
        hypothesis="V is well above the training error: the weights follow their own fold.",
        expected="Higher training error, lower V.",
    ),
)


def _with_ridge(case: Case, factor: float) -> Recipe:
    """The ridge that holds most of the weights: the network's, where a grey-box has one."""
    recipe = case.recipe
    if recipe.family == "neural_ss":
        return recipe.configured(ridge=factor * recipe.number("ridge", 1e-5))
    name, default = ("residual_ridge", 1e-2) if recipe.get("residual") else ("ridge", 1e-3)
    return recipe.configured(**{name: factor * recipe.number(name, default)})


def _order(case: Case) -> int:
    return round(case.recipe.number("order", 2))


def _hidden(case: Case) -> int:
    return round(case.recipe.number("hidden", 8))


def _nonlinearity(case: Case, wanted: str, weight: float) -> float:
    return 0.0 if case.recipe.get("nonlinearity") == wanted else weight
