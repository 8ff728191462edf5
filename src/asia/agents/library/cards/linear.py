"""Linear models: state space and difference equations."""

from __future__ import annotations

from dataclasses import replace

from asia.agents.library.family import Family, Timing
from asia.agents.library.methods import (
    LM,
    integrator_moves,
    integrator_setting,
    noise_space,
    slow_noise,
)
from asia.agents.library.move import LIKELY, POSSIBLE, SHOWN, Card, Move, Situation
from asia.agents.library.space import OneOf, Space
from asia.agents.library.traits import periodic
from asia.agents.view import Facts
from asia.data.statistics import several_levels
from asia.data.trajectory import MOST_DELAY
from asia.problem.obstacles import least_delay
from asia.recipe import Arguments, Recipe

# Share of the error for which another state is taken.
_FINER = 0.005
# Share by which V of the best linear model is below that of the baseline, to be tried at once.
_CLEAR = 0.03


def _linear(facts: Facts) -> Recipe:
    if _loop_methods(facts):
        # A reference that treats the records as open loop is no start: another order may fit.
        config = (("order", None), ("delay", None), ("loop", _loop_methods(facts)[0]))
        if facts.linear and "loop" in dict(facts.linear):
            config = facts.linear
        return Recipe("linear", config, LM, (("iterations", 30),))
    # Each fold chooses for itself, unless another choice gave the better reference.
    known: Arguments = facts.linear or (("order", None), ("delay", None), ("periodic", True))
    recipe = Recipe("linear", known, LM, (("iterations", 30),))
    late = _shared_delay(facts)
    if late > MOST_DELAY:
        recipe = recipe.configured(delay=late)
    if not _is_special(recipe):
        recipe = recipe.configured(**dict(integrator_setting(facts)))
    return recipe


def _shared_delay(facts: Facts) -> int:
    """Samples by which every input acts later than in the next sample, by the records."""
    if any(signal.role == "time_step" for signal in facts.inputs):
        return 0
    return max(least_delay(facts.records) - 1, 0)


def _is_special(recipe: Recipe) -> bool:
    """Return whether the fit takes no integrators, levels or noise model."""
    return bool(recipe.get("regularised") or recipe.get("loop"))


def _scheduled(facts: Facts) -> Arguments:
    """Affine coefficients where there is a scheduling signal."""
    return (("scheduling", 1),) if any(s.role == "scheduling" for s in facts.inputs) else ()


def _levels(at: Situation) -> int:
    """Shown where a fit takes seconds; the gain differs from level to level of most."""
    if at.facts.horizon is not None or at.recipe.get("levels") or _is_special(at.recipe):
        return 0
    return (SHOWN if _by_lines(at) else POSSIBLE) * several_levels(at.facts.records)


def _reference(at: Situation) -> int:
    """Shown for the baseline where another linear model is clearly better."""
    best, value = at.view.linear, at.trial.value
    if at.recipe.maps or not at.facts.linear or best is None or value is None:
        return 0
    return SHOWN * (best < (1.0 - _CLEAR) * value)


def _by_lines(at: Situation) -> bool:
    return bool(at.recipe.get("periodic")) and periodic(at.facts)


def _loop_methods(facts: Facts) -> tuple[str, ...]:
    """Return the closed-loop methods that the problem allows, a known controller first."""
    return () if facts.loop is None else facts.loop.methods


def _next_loop_method(at: Situation) -> Recipe:
    methods, now = _loop_methods(at.facts), at.recipe.get("loop")
    if now is None:
        return replace(_linear(at.facts), family=at.recipe.family, package=at.recipe.package)
    return at.recipe.configured(loop=methods[(methods.index(str(now)) + 1) % len(methods)])


def _loop(at: Situation) -> int:
    """Shown where a linear fit is biased by feedback, or a method failed. V does not choose among
    methods that work: bias may lower it."""
    if not _loop_methods(at.facts):
        return 0
    return SHOWN * (not at.recipe.get("loop") or at.trial.value is None)


def _space(facts: Facts) -> Space:
    if _loop_methods(facts):
        return Space(
            config=(
                OneOf("order", (None, 1, 2, 3, 4, 5, 6)),
                OneOf("delay", (0, None)),
                OneOf("loop", _loop_methods(facts)),
            ),
            options=(OneOf("iterations", (15, 30, 60)),),
        )
    known = (("periodic", periodic(facts)), ("levels", several_levels(facts.records)))
    switches = [name for name, holds in known if holds and facts.horizon is None]
    return Space(
        config=(
            OneOf("order", (None, 1, 2, 3, 4, 5, 6)),
            OneOf("delay", (0, None)),
            OneOf("integrators", (0, 1), needs="periodic"),
            *(OneOf(name, (False, True), needs="periodic") for name in switches),
        ),
        options=(OneOf("iterations", (15, 30, 60)), *noise_space(facts)),
    )


CARD = Card((
    Family(
        name="linear",
        label="linear state-space",
        use="the best linear model, and the starting point of nonlinear ones",
        base=7,
        points=(("windows", -3),),
        start=_linear,
        space=_space,
        small=(("order", 1), ("iterations", 3)),
        timing=Timing(start=0.2, unit=2e-06),
        feedback=True,
    ),
    Family(
        name="arx",
        label="output-error model",
        use="a linear difference equation with readable coefficients",
        base=2,
        points=(("windows", -1), ("scheduling", 6)),
        start=lambda facts: Recipe(
            "arx",
            (("structure", "oe"), ("delay", None), *_scheduled(facts)),
            LM,
            (("iterations", 30),),
        ),
        space=lambda facts: Space(
            config=(
                OneOf("na", (None, 1, 2, 3, 4)),
                OneOf("nb", (None, 1, 2, 3, 4)),
                OneOf("delay", (0, None)),
                OneOf("structure", ("arx", "oe")),
                *((OneOf("scheduling", (0, 1, 2)),) if _scheduled(facts) else ()),
            ),
            options=(OneOf("iterations", (15, 30, 60)),),
        ),
        small=(("iterations", 3),),
        timing=Timing(start=0.0, unit=1.4e-06),
    ),
), (
    Move(
        name="closed-loop method",
        families=("linear",),
        evidence=_loop,
        change=_next_loop_method,
        hypothesis="The controller carries noise into the input. The methods for closed loops "
        "differ in what they need: a noise model, the reference, or the controller.",
        expected="Gains without bias; V may rise, because it is computed from the same inputs.",
    ),
    Move(
        name="coefficients of a higher degree in the scheduling signal",
        families=("arx",),
        evidence=lambda c: LIKELY * (0 < c.recipe.number("scheduling", 0) < 3),
        change=lambda c: c.recipe.configured(
            scheduling=round(c.recipe.number("scheduling", 0)) + 1
        ),
        hypothesis="Gain or poles are no straight line of the scheduling signal.",
        expected="A lower V on every fold.",
    ),
    Move(
        name="settings of the best linear model",
        families=("linear",),
        evidence=_reference,
        change=lambda c: _linear(c.facts),
        hypothesis="Of the linear models that every search scores, another kind of fit has the "
        "least V: by prediction errors, or with regularised coefficients.",
        expected="V of the best linear model.",
    ),
    *(replace(move, families=("linear",)) for move in integrator_moves()),
    Move(
        name="systems by level of excitation",
        families=("linear",),
        evidence=_levels,
        change=lambda c: c.recipe.configured(levels=True),
        hypothesis="The records are of several levels of excitation. Gain, damping and frequencies "
        "of a nonlinear system differ from level to level: a linear system for each.",
        expected="A far lower V if the system is nonlinear; the same V if it is not.",
    ),
    Move(
        name="more states",
        families=("linear",),
        evidence=lambda c: _by_lines(c) and c.recipe.number("tolerance", 1.0) > _FINER,
        change=lambda c: c.recipe.configured(tolerance=_FINER, periodic_order=90),
        hypothesis="The lines of periodic records resolve many modes: each small gain in error "
        "justifies a state.",
        expected="A slightly lower V.",
    ),
    replace(
        slow_noise(),
        families=("linear",),
        evidence=lambda c: 0 if _is_special(c.recipe) else slow_noise().evidence(c),
    ),
))  # fmt: skip
