"""Grey-box model of the problem's equations, its possible missing terms and their symptoms."""

from asia.agents.library.equation_moves import (
    EQUATION_MOVES,
    names_of,
    output_offsets,
)
from asia.agents.library.family import Family, Path, Timing
from asia.agents.library.methods import LM
from asia.agents.library.move import LIKELY, POSSIBLE, SHOWN, Card, Move, Situation
from asia.agents.library.plants import usual_effects
from asia.agents.library.space import OneOf, Space, Span
from asia.agents.library.trial_evidence import (
    biased,
    coloured,
    fails_on_top,
    input_left,
)
from asia.agents.view import Facts
from asia.data.statistics import plateau_share
from asia.recipe import Recipe


def _start(facts: Facts) -> Recipe:
    """Return the first recipe; with measured states in windows the equations need no search for an
    initial state."""
    iterations, starts = (60, 8) if facts.horizon is None else (15, 2)
    return Recipe("greybox", (), LM, (("iterations", iterations), ("starts", starts)))


def _space(facts: Facts) -> Space:
    physics = facts.physics
    states = physics.states if physics else ()
    each_state = tuple((name,) for name in states)
    each_input = tuple((signal.name,) for signal in facts.inputs)
    together = (states,) if len(states) > 1 else ()
    outputs = output_offsets(facts, states)
    offsets = tuple(dict.fromkeys(((), outputs, states, (*outputs, *states))))
    return Space(
        config=(
            OneOf("saturation", ((), *each_state, *together)),
            OneOf("spill", (False, True), needs="saturation"),
            OneOf("linear", (False, True)),
            OneOf("offset", offsets),
            OneOf("input_delay", (0.0, 3.0)),
            OneOf("robust", (None, 0.1)),
            OneOf("residual", (0, 4)),
            OneOf("sensor", (None, "power", "spline")),
            OneOf("lag", ((), *each_state, *each_input)),
            OneOf("smooth", ((), *each_state, *each_input)),
            OneOf("friction", ((), *each_state)),
            OneOf("presliding", (False, True), needs="friction"),
            OneOf("hysteresis", ((), *each_state)),
            OneOf("play", ((), *each_input)),
            OneOf("discover", ((), states), needs="residual", being=0),
            Span("smooth_width", 0.02, 0.3, needs="smooth"),
            *((Span("prior_width", 0.3, 3.0),) if physics and physics.priors else ()),
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


def _settle(_: Facts, recipe: Recipe) -> Recipe:
    """The noise model has a robust loss of its own; a signal has a lag or a play."""
    if recipe.get("lag") == recipe.get("play"):
        recipe = recipe.without("play")
    return recipe.without("robust") if recipe.get("noise_model") == "slow" else recipe


def _next_state(at: Situation) -> tuple[str, ...]:
    """The saturated states and one more, the physics' states taken in order."""
    names = names_of(at, "saturation")
    return (*names, *[s for s in at.states if s not in names][:1])


def _saturation(at: Situation) -> int:
    full = names_of(at, "saturation")
    if _next_state(at) == full:
        return 0
    shown = fails_on_top(at.trial) or plateau_share(at.facts.records) > 0.02
    return SHOWN if shown and not full else POSSIBLE


def _overflow(at: Situation) -> int:
    """That of saturation, while a next state exists to take the spill of a plant that can
    overflow."""
    chain = len(at.states) > len(_next_state(at)) and not names_of(at, "saturation")
    return _saturation(at) * ("spill" in usual_effects(at.facts) and chain)


def _lacks_offsets(at: Situation, names: tuple[str, ...]) -> bool:
    return bool(names) and not set(names) & set(names_of(at, "offset"))


def _with_offsets(at: Situation, names: tuple[str, ...]) -> Recipe:
    return at.recipe.configured(offset=(*names_of(at, "offset"), *names))


_MOVES: tuple[Move, ...] = (
    Move(
        name="{state} runs over",
        evidence=_overflow,
        change=lambda c: c.recipe.configured(saturation=_next_state(c), spill=True),
        state=lambda c: _next_state(c)[-1],
        hypothesis="A state has an upper limit that is missing in the equations, and part of its "
        "overflow enters the next state: the next state follows the input at once when the first "
        "is full.",
        expected="Lower error where the output is high, on every fold where the limit is reached.",
    ),
    Move(
        name="{state} saturates",
        evidence=_saturation,
        change=lambda c: c.recipe.configured(saturation=_next_state(c)),
        state=lambda c: _next_state(c)[-1],
        hypothesis="A state has an upper limit that is missing in the equations: errors are "
        "concentrated where the output is high or constant.",
        expected="Lower error near the top of the output; the limit settles inside the data.",
    ),
    Move(
        name="a full {state} spills over",
        evidence=lambda c: (
            SHOWN
            * (len(c.states) > 1 and bool(names_of(c, "saturation")) and not c.recipe.get("spill"))
        ),
        change=lambda c: c.recipe.configured(spill=True),
        state=lambda c: names_of(c, "saturation")[0],
        hypothesis="The overflow of a full state is not lost: part of it enters the next state.",
        expected="Lower error just after the limit is reached, on every fold.",
    ),
    Move(
        name="output offset",
        evidence=lambda c: (
            (LIKELY if biased(c.trial) else POSSIBLE)
            * _lacks_offsets(c, output_offsets(c.facts, c.states))
        ),
        change=lambda c: _with_offsets(c, output_offsets(c.facts, c.states)),
        hypothesis="The sensor has an offset from the equations.",
        expected="Less bias; the fit at low outputs improves most.",
    ),
    Move(
        name="constant in and outflow",
        evidence=lambda c: (
            (LIKELY if coloured(c.trial) else POSSIBLE) * _lacks_offsets(c, c.states)
        ),
        change=lambda c: _with_offsets(c, c.states),
        hypothesis="Each balance lacks a constant: a leak, a dead zone, or a level with an offset "
        "from the equations.",
        expected="Lower error away from the mean level, on every fold.",
    ),
    Move(
        name="linear term",
        evidence=lambda c: not c.recipe.get("linear"),
        change=lambda c: c.recipe.configured(linear=True),
        hypothesis="The residual is not white: a small linear term in states and inputs represents "
        "missing dynamics.",
        expected="Lower error and a whiter residual, with the physics still dominant.",
    ),
    Move(
        name="residual network",
        evidence=lambda c: not c.recipe.get("residual"),
        change=lambda c: c.recipe.without("discover").configured(residual=4),
        hypothesis="The residual depends on the state in a way that is missing in the equations: a "
        "small network in the dynamics, regularised by its prior, can learn it.",
        expected="Lower training error; lower V only if the effect is real.",
    ),
    Move(
        name="wider residual network",
        evidence=lambda c: 0 < c.recipe.number("residual", 0) < 12,
        change=lambda c: c.recipe.configured(residual=round(2 * c.recipe.number("residual", 4))),
        hypothesis="V is near the training error with the network: it may be larger.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="robust loss",
        evidence=lambda c: c.recipe.get("noise_model") != "slow" and not c.recipe.get("robust"),
        change=lambda c: c.recipe.configured(robust=0.1),
        hypothesis="A few outliers that no parameter can explain bias the fit.",
        expected="About the same training error, steadier parameters over the folds.",
    ),
    Move(
        name="input delay",
        evidence=lambda c: (
            (LIKELY if input_left(c.trial) else POSSIBLE) * (not c.recipe.get("input_delay"))
        ),
        change=lambda c: c.recipe.configured(input_delay=3.0),
        hypothesis="The input acts later than in the equations.",
        expected="The input no longer explains the residual.",
    ),
    *EQUATION_MOVES,
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
            irregular=True,
            intersample=True,
            start=_start,
            space=_space,
            small=(("iterations", 3), ("starts", 1)),
            timing=Timing(start=1.3, unit=1.7e-06),
            path=Path("residual_ridge", (1e-1, 1e-2, 1e-3), "residual"),
            settle=_settle,
            extendable=True,
        ),
    ),
    _MOVES,
)
