"""A linear state-space model with small static networks in it."""

from asia.agents.library.family import Family, Path, Timing
from asia.agents.library.methods import (
    LM,
    from_pieces,
    integrator_moves,
    integrator_setting,
    noise_space,
    slow_noise,
    symmetry_space,
)
from asia.agents.library.move import LIKELY, POSSIBLE, SHOWN, Card, Move, Situation
from asia.agents.library.space import OneOf, Parameter, Space, Span
from asia.agents.library.traits import traits
from asia.agents.library.trial_evidence import coloured, overfit
from asia.agents.view import Facts
from asia.data.level_responses import pacing_input
from asia.data.statistics import Cause, switching
from asia.recipe import Arguments, Recipe, Value


def _start(facts: Facts) -> Recipe:
    past: Arguments = (("past_fit", True),) if facts.horizon is None else ()
    functions: Arguments = (("nonlinearity", "state"), ("hidden", 8))
    if _scheduled(facts):
        functions = ("nonlinearity", "state"), ("basis", "scheduling"), ("degree", 2)
    elif "resonant" in traits(facts):
        functions = ("nonlinearity", "modal"), ("pieces", True)
    elif "integrating" in traits(facts):
        # Over a whole record every error of a rate adds up.
        functions = *functions, ("pieces", True)
    config: Arguments = (
        *functions,
        ("delay", None),
        *past,
        *integrator_setting(facts),
    )
    return Recipe("neural_ss", config, LM, (("iterations", 60), ("starts", 2)))


def _scheduled(facts: Facts) -> bool:
    return any(s.role == "scheduling" for s in facts.inputs)


def _space(facts: Facts) -> Space:
    pace = pacing_input(facts.records)
    places: tuple[Parameter, ...] = (
        OneOf("nonlinearity", ("state", "modal", "input", "output", "both", "none")),
        OneOf("channels", (None, 1, 2), needs="nonlinearity", being="state"),
        OneOf("basis", ("tanh", "polynomial")),
        OneOf("degree", (2, 3), needs="basis", being="polynomial"),
    )
    if _scheduled(facts):
        # Matrices that follow the signal act on all states.
        places = (
            OneOf("nonlinearity", ("state", "none")),
            OneOf("basis", ("scheduling", "tanh", "polynomial")),
            OneOf("degree", (2, 3)),
        )
    paces = () if pace is None else (OneOf("transport", (None, pace)),)
    return Space(
        config=(
            OneOf("order", (None, 2, 3, 4)),
            *places,
            OneOf("hidden", (4, 8, 12)),
            Span("ridge", 1e-6, 1e-2),
            OneOf("delay", (0, None)),
            OneOf("friction", (0, 1, 2)),
            OneOf("play", (0, 1)),
            OneOf("integrators", (0, 1)),
            OneOf("pieces", (False, True)),
            OneOf("past_fit", (False, True)),
            *symmetry_space(facts),
            *paces,
        ),
        options=(OneOf("iterations", (40, 80)), OneOf("starts", (1, 2, 4)), *noise_space(facts)),
    )


def _carried(at: Situation) -> Recipe:
    # It excludes a constant delay and the symmetries of plain inputs.
    pace = pacing_input(at.facts.records)
    return at.recipe.without("symmetry").configured(delay=0, transport=pace).trained(starts=4)


# Share of the one-step error from which on a switching term is more than what smooth systems show,
# and how much more it may be by chance in one sample.
_TRACE, _BY_CHANCE = 0.01, 8.0
# Inputs and outputs for which cubic polynomials, and for which quadratic ones, have few terms.
_CUBIC, _QUADRATIC = 2, 5


def _signals(facts: Facts) -> int:
    return len(facts.inputs) + len(facts.outputs)


def _polynomial(at: Situation) -> int:
    """Evidence for polynomials, fitted from segments: a whole-record fit from zero seldom
    converges."""
    facts, recipe = at.facts, at.recipe
    few = _signals(facts) <= _QUADRATIC and facts.horizon is None
    smooth = recipe.get("nonlinearity") == "state" and not _has_element(at)
    if not (few and smooth) or recipe.get("basis") == "polynomial":
        return 0
    return LIKELY if coloured(at.trial) else POSSIBLE


def _is_lpv(at: Situation) -> bool:
    return at.recipe.get("basis") == "scheduling"


def _as_polynomials(at: Situation) -> Recipe:
    degree = 3 if _signals(at.facts) <= _CUBIC else 2
    recipe = at.recipe.configured(basis="polynomial", degree=degree, pieces=True, past_fit=True)
    return recipe.without("hidden")


def _has_lfr(at: Situation) -> bool:
    """Return whether a nonlinear LFR model was tried: it has these structures as special cases."""
    return any(trial.family == "nl_lfr" for trial in at.view.trials)


def _static(at: Situation, place: str) -> int:
    """Evidence for a static function at the place; none around a free integrator, whose output
    visits each level once."""
    drifts = place != "input" and bool(at.recipe.number("integrators", 0))
    if at.recipe.get("nonlinearity") == place or drifts:
        return 0
    return POSSIBLE if _has_lfr(at) else LIKELY


def _moved_to(at: Situation, place: str) -> Recipe:
    """Move the static function to another place; channels belong to one in the state equation."""
    recipe = at.recipe.configured(nonlinearity=place)
    recipe = recipe.without("basis", "degree") if _is_lpv(at) else recipe
    return recipe.configured(channels=None) if recipe.has("channels") else recipe


def _element(at: Situation, element: str, *causes: Cause) -> int:
    found = switching(at.facts.records)
    return SHOWN * (found.found and found.cause in causes and not at.recipe.get(element))


def _trace(at: Situation) -> int:
    """Evidence where the residual is coloured: the records show only a trace of the effect, or a
    smooth model overfits its own fold."""
    smooth = at.facts.horizon is None and not _has_element(at)
    if not smooth or not coloured(at.trial) or switching(at.facts.records).found:
        return 0
    least = _TRACE + _BY_CHANCE / at.facts.samples
    likely = switching(at.facts.records).share > least or overfit(at.trial) > 4.0
    return LIKELY if likely else POSSIBLE


def _with_element(at: Situation, element: str, **config: Value) -> Recipe:
    """Put friction or play beside a linear model, fitted from several starts."""
    recipe = at.recipe.without("channels")
    config = {"nonlinearity": "none", element: 1, **config}
    return recipe.configured(**config).trained(starts=4)


def _one_element_more(at: Situation) -> Recipe:
    element = "friction" if at.recipe.get("friction") else "play"
    return at.recipe.configured(**{element: round(at.recipe.number(element, 1)) + 1})


def _has_element(at: Situation) -> bool:
    return bool(at.recipe.get("friction") or at.recipe.get("play"))


_ELEMENTS: tuple[Move, ...] = (
    Move(
        name="dry friction",
        evidence=lambda c: _element(c, "friction", "velocity"),
        # Few states, so that none of them takes the place of friction.
        change=lambda c: _with_element(c, "friction", order=1),
        hypothesis="The residual of a one-step model has the sign of an output: a mass with "
        "measured velocity that sticks. A friction element can hold it at rest.",
        expected="A far lower V; the simulation is at rest where the system is.",
    ),
    Move(
        name="friction or hysteresis",
        evidence=lambda c: _element(c, "friction", "displacement"),
        change=lambda c: _with_element(c, "friction", order=2),
        hypothesis="The residual of a one-step model depends on the direction of the output, or on "
        "its last reversal: a friction element with its own memory.",
        expected="A far lower V; lower error after each turn.",
    ),
    Move(
        name="play",
        evidence=lambda c: _element(c, "play", "input"),
        change=lambda c: _with_element(c, "play"),
        hypothesis="The residual of a one-step model depends on the last reversal of an input: "
        "backlash between actuator and process.",
        expected="A far lower V; lower error after each turn of the input.",
    ),
    Move(
        name="a trace of friction",
        evidence=lambda c: _trace(c),
        change=lambda c: _with_element(c, "friction"),
        hypothesis="The residual is coloured, and a nonsmooth effect may be missing: a friction "
        "element switches at reversals of the motion, and can hold the system at rest.",
        expected="A far lower V if something sticks; a higher one if nothing does.",
    ),
    Move(
        name="a trace of play",
        evidence=lambda c: _trace(c),
        change=lambda c: _with_element(c, "play"),
        hypothesis="The residual is coloured, and a nonsmooth effect may be missing: with backlash "
        "the output does not move after each reversal.",
        expected="A far lower V if there is play; a higher one if there is none.",
    ),
    Move(
        name="static functions beside the element",
        evidence=lambda c: LIKELY * _has_element(c) * (c.recipe.get("nonlinearity") == "none"),
        change=lambda c: c.recipe.configured(nonlinearity="state", hidden=4),
        hypothesis="The residual next to friction or backlash may be smooth.",
        expected="Lower training error; lower V if the effect is real.",
    ),
    Move(
        name="another element",
        evidence=_has_element,
        change=_one_element_more,
        hypothesis="One element has corners; several together make a loop of any shape.",
        expected="Lower error in the turns.",
    ),
)

CARD = Card(
    (
        Family(
            name="neural_ss",
            label="neural state-space",
            use="a linear model with small static nonlinearities, for short records",
            base=6,
            points=(
                ("short", 1),
                ("long", -2),
                ("windows", -2),
                ("scheduling", 3),
                ("resonant", 1),
            ),
            start=_start,
            space=_space,
            small=(("hidden", 3), ("iterations", 3), ("starts", 1)),
            path=Path("ridge", (1e-1, 1e-3, 1e-5)),
            timing=Timing(start=1.6, unit=2.1e-06),
        ),
    ),
    (
        *integrator_moves(),
        Move(
            name="delays set by an input",
            evidence=lambda c: (
                SHOWN
                * (not c.recipe.has("transport") and pacing_input(c.facts.records) is not None)
            ),
            change=_carried,
            hypothesis="The delay grows as one of the inputs decreases: a flow or a speed that "
            "transports the effect of the others.",
            expected="A far lower V; the error is no longer concentrated after each step of an "
            "input.",
        ),
        from_pieces(past_fit=True),
        *_ELEMENTS,
        Move(
            name="matrices quadratic in the scheduling signal",
            evidence=lambda c: LIKELY * (_is_lpv(c) and c.recipe.number("degree", 2) < 3),
            change=lambda c: c.recipe.configured(degree=3),
            hypothesis="Gain or poles are no straight line of the scheduling signal.",
            expected="A lower V on every fold.",
        ),
        Move(
            name="functions of states and inputs beside the scheduling signal",
            evidence=lambda c: LIKELY * _is_lpv(c),
            change=lambda c: c.recipe.without("basis", "degree").configured(hidden=8),
            hypothesis="The system is nonlinear for a constant scheduling signal too.",
            expected="A lower V on every fold.",
        ),
        Move(
            name="polynomials",
            evidence=_polynomial,
            change=_as_polynomials,
            hypothesis="A polynomial of the states is linear in its weights: given the states, its "
            "fit has one minimum, where a layer of units has many.",
            expected="Lower training error and V, if the nonlinearity is smooth.",
        ),
        Move(
            name="functions of all states",
            evidence=lambda c: LIKELY * (c.recipe.get("nonlinearity") == "modal"),
            change=lambda c: c.recipe.configured(nonlinearity="state", hidden=8),
            hypothesis="The modes act on each other, or the nonlinearity lies elsewhere: a layer "
            "of units reads all states and inputs.",
            expected="A lower training error and V, if frequency and damping of each mode depend "
            "on more than its own amplitude.",
        ),
        Move(
            name="symmetries of the signals",
            evidence=lambda c: LIKELY * c.varies("symmetry") * (not c.recipe.get("symmetry")),
            change=lambda c: c.recipe.configured(symmetry=True),
            hypothesis="The problem says under which changes of its signals the system stays the "
            "same: a model averaged over them has no even terms to learn where it is odd.",
            expected="A lower V; the training error may rise.",
        ),
        Move(
            name="static function at the output",
            evidence=lambda c: _static(c, "output"),
            change=lambda c: _moved_to(c, "output"),
            hypothesis="The system may be linear with a static function after it (Wiener): fewer "
            "weights suffice.",
            expected="A lower V at the same training error, if the structure is right.",
        ),
        Move(
            name="static function at the input",
            evidence=lambda c: _static(c, "input"),
            change=lambda c: _moved_to(c, "input"),
            hypothesis="The system may be linear with a static function before it (Hammerstein).",
            expected="A lower V at the same training error, if the structure is right.",
        ),
        slow_noise(),
    ),
)
