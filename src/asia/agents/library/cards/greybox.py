"""Grey-box model of the problem's equations, its possible missing terms and their symptoms."""

from __future__ import annotations

from asia.agents.library.card import Card
from asia.agents.library.cost import Timing
from asia.agents.library.equation_moves import (
    WRITTEN_IN,
    less_ridge,
    more_ridge,
    names_of,
    output_offsets,
)
from asia.agents.library.family import Family
from asia.agents.library.methods import LM
from asia.agents.library.move import Move, Situation
from asia.agents.library.recipe import Recipe
from asia.agents.library.records import (
    biased,
    coloured,
    fails_on_top,
    input_left,
    overfit,
    plateau_share,
)
from asia.agents.library.space import OneOf, Parameter, Space, Span
from asia.agents.view import Facts


def _state_sets(facts: Facts) -> tuple[tuple[str, ...], ...]:
    """Single states and all of them together, for settings that name states."""
    states = facts.physics.states if facts.physics else ()
    single = tuple((s,) for s in states)
    return (*single, states) if len(states) > 1 else single


def _offset_sets(facts: Facts) -> tuple[tuple[str, ...], ...]:
    """None, those of the outputs, those of the states, and both."""
    outputs = output_offsets(facts)
    states = facts.physics.states if facts.physics else ()
    return tuple(dict.fromkeys(((), outputs, states, (*outputs, *states))))


def _greybox(facts: Facts) -> Recipe:
    """Return the first recipe; with measured states in windows the equations need no search for an
    initial state."""
    config = (("ridge", 1e-3), ("residual_ridge", 1e-2))
    effort = (("iterations", 60), ("starts", 8))
    if facts.horizon is not None:
        effort = (("iterations", 15), ("starts", 2))
    return Recipe("greybox", config, LM, effort)


def _space(facts: Facts) -> Space:
    return Space(
        config=(
            OneOf("saturation", ((), *_state_sets(facts))),
            OneOf("spill", (False, True), needs="saturation"),
            OneOf("linear", (False, True)),
            OneOf("offset", _offset_sets(facts)),
            OneOf("input_delay", (0.0, 3.0)),
            OneOf("robust", (None, 0.1)),
            OneOf("residual", (0, 4)),
            OneOf("sensor", (None, "power", "spline")),
            OneOf("lag", ((), *_single(facts))),
            OneOf("smooth", ((), *_single(facts))),
            OneOf("friction", ((), *_states(facts))),
            OneOf("presliding", (False, True), needs="friction"),
            OneOf("hysteresis", ((), *_states(facts))),
            OneOf("play", ((), *_inputs(facts))),
            OneOf("discover", ((), _all_states(facts)), needs="residual", being=0),
            Span("smooth_width", 0.02, 0.3, needs="smooth"),
            *_widths(facts),
            Span("ridge", 1e-5, 1e-1),
            Span("residual_ridge", 1e-4, 1e-1, needs="residual"),
        ),
        options=(
            OneOf("iterations", (40, 80)),
            OneOf("starts", (4, 8, 16)),
            OneOf("noise_model", ("white", "slow")),
            OneOf("huber", (None, 3.0), needs="noise_model", being="slow"),
        ),
    )


def _single(facts: Facts) -> tuple[tuple[str, ...], ...]:
    """Each state and input by itself."""
    states = facts.physics.states if facts.physics else ()
    return tuple((name,) for name in (*states, *(s.name for s in facts.inputs)))


def _states(facts: Facts) -> tuple[tuple[str, ...], ...]:
    return tuple((name,) for name in (facts.physics.states if facts.physics else ()))


def _all_states(facts: Facts) -> tuple[str, ...]:
    return facts.physics.states if facts.physics else ()


def _inputs(facts: Facts) -> tuple[tuple[str, ...], ...]:
    return tuple((signal.name,) for signal in facts.inputs)


def _widths(facts: Facts) -> tuple[Parameter, ...]:
    known = facts.physics is not None and facts.physics.priors
    return (Span("prior_width", 0.3, 3.0),) if known else ()


def _settle(_: Facts, recipe: Recipe) -> Recipe:
    """The noise model has a robust loss of its own; a signal has a lag or a play."""
    if recipe.get("lag") == recipe.get("play"):
        recipe = recipe.without("play")
    return recipe.without("robust") if recipe.get("noise_model") == "slow" else recipe


def _next_state(at: Situation) -> tuple[str, ...]:
    """The saturated states and one more, the physics' states taken in order."""
    names = names_of(at, "saturation")
    return (*names, *[s for s in at.states if s not in names][:1])


def _saturation_weight(at: Situation) -> float:
    full = names_of(at, "saturation")
    if _next_state(at) == full:
        return 0.0
    evidence = fails_on_top(at.trial) or plateau_share(at.facts) > 0.02
    if not full:
        return 0.95 if evidence else 0.6
    return 0.35 if evidence else 0.15


def _overflow_weight(at: Situation) -> float:
    """A little above saturation alone while a next state exists to take the spill."""
    chain = len(at.states) > len(_next_state(at))
    fresh = not names_of(at, "saturation")
    return 1.02 * _saturation_weight(at) if chain and fresh else 0.0


def _spill_weight(at: Situation) -> float:
    several = len(at.states) > 1
    return 0.9 if several and names_of(at, "saturation") and not at.recipe.get("spill") else 0.0


def _outputs(at: Situation) -> tuple[str, ...]:
    return output_offsets(at.facts)


def _lacks(at: Situation, names: tuple[str, ...]) -> bool:
    return bool(names) and not set(names) & set(names_of(at, "offset"))


def _with_offset(at: Situation, names: tuple[str, ...]) -> Recipe:
    return at.recipe.configured(offset=(*names_of(at, "offset"), *names))


def _ridge(at: Situation, factor: float) -> Recipe:
    """The ridge that holds most of the weights: the network's, where there is one."""
    name, default = ("residual_ridge", 1e-2) if at.recipe.get("residual") else ("ridge", 1e-3)
    return at.recipe.times(name, factor, default)


_MOVES: tuple[Move, ...] = (
    Move(
        name="{state} saturates",
        weight=_saturation_weight,
        change=lambda c: c.recipe.configured(saturation=_next_state(c)),
        state=lambda c: _next_state(c)[-1],
        hypothesis=(
            "A state has an upper limit that is missing in the equations: errors are "
            "concentrated where the output is high or constant."
        ),
        expected="Lower error near the top of the output; the limit settles inside the data.",
    ),
    Move(
        name="{state} runs over",
        weight=_overflow_weight,
        change=lambda c: c.recipe.configured(saturation=_next_state(c), spill=True),
        state=lambda c: _next_state(c)[-1],
        hypothesis=(
            "A state has an upper limit that is missing in the equations, and part of its "
            "overflow enters the next state: the next state follows the input at once when the "
            "first is full."
        ),
        expected="Lower error where the output is high, on every fold where the limit is reached.",
    ),
    Move(
        name="a full {state} spills over",
        weight=_spill_weight,
        change=lambda c: c.recipe.configured(spill=True),
        state=lambda c: names_of(c, "saturation")[0],
        hypothesis="The overflow of a full state is not lost: part of it enters the next state.",
        expected="Lower error just after the limit is reached, on every fold.",
    ),
    Move(
        name="output offset",
        weight=lambda c: (0.8 if biased(c.trial) else 0.4) * _lacks(c, _outputs(c)),
        change=lambda c: _with_offset(c, _outputs(c)),
        hypothesis="The sensor has an offset from the equations.",
        expected="Less bias; the fit at low outputs improves most.",
    ),
    Move(
        name="constant in and outflow",
        weight=lambda c: (0.75 if coloured(c.trial) else 0.5) * _lacks(c, c.states),
        change=lambda c: _with_offset(c, c.states),
        hypothesis=(
            "Each balance lacks a constant: a leak, a dead zone, or a level with an offset from"
            " the equations."
        ),
        expected="Lower error away from the mean level, on every fold.",
    ),
    Move(
        name="linear term",
        weight=lambda c: 0 if c.recipe.get("linear") else 0.5 if coloured(c.trial) else 0.3,
        change=lambda c: c.recipe.configured(linear=True),
        hypothesis=(
            "The residual is not white: a small linear term in states and inputs represents "
            "missing dynamics."
        ),
        expected="Lower error and a whiter residual, with the physics still dominant.",
    ),
    Move(
        name="residual network",
        weight=lambda c: 0 if c.recipe.get("residual") else 0.65 if coloured(c.trial) else 0.35,
        change=lambda c: c.recipe.without("discover").configured(residual=4),
        hypothesis=(
            "The residual depends on the state in a way that is missing in the equations: a "
            "small network in the dynamics, regularised by its prior, can learn it."
        ),
        expected="Lower training error; lower V only if the effect is real.",
    ),
    Move(
        name="residual network, held tighter",
        weight=lambda c: 0 if c.recipe.get("residual") else 0.6 if coloured(c.trial) else 0.3,
        change=lambda c: c.recipe.without("discover").configured(residual=4, residual_ridge=5e-2),
        hypothesis=(
            "The equations lack an effect of the state, and a small network finds it only if "
            "its prior prevents overfitting."
        ),
        expected="Less gain on the training side than a free network, and more on V.",
    ),
    Move(
        name="wider residual network",
        weight=lambda c: (
            (0.45 if overfit(c.trial) < 1.5 else 0.2) * (0 < c.recipe.number("residual", 0) < 12)
        ),
        change=lambda c: c.recipe.configured(residual=round(2 * c.recipe.number("residual", 4))),
        hypothesis="V is near the training error with the network: it may be larger.",
        expected="Lower training error, V follows.",
    ),
    more_ridge("additions", _ridge),
    less_ridge(_ridge),
    Move(
        name="robust loss",
        weight=lambda c: (
            0.3 * (c.recipe.get("noise_model") != "slow" and not c.recipe.get("robust"))
        ),
        change=lambda c: c.recipe.configured(robust=0.1),
        hypothesis="A few outliers that no parameter can explain bias the fit.",
        expected="About the same training error, steadier parameters over the folds.",
    ),
    Move(
        name="input delay",
        weight=lambda c: 0 if c.recipe.get("input_delay") else 0.5 if input_left(c.trial) else 0.2,
        change=lambda c: c.recipe.configured(input_delay=3.0),
        hypothesis="The input acts later than in the equations.",
        expected="The input no longer explains the residual.",
    ),
    *WRITTEN_IN,
)

CARD = Card(
    (
        Family(
            name="greybox",
            label="grey-box",
            use="the problem's equations, fitted in physical units",
            base=10,
            points=(("windows", -4), ("measured", -2)),
            needs=frozenset({"physics"}),
            start=_greybox,
            space=_space,
            small=(("iterations", 3), ("starts", 1)),
            timing=Timing(start=1.3, unit=1.7e-06),
            settle=_settle,
            extendable=True,
        ),
    ),
    _MOVES,
)
