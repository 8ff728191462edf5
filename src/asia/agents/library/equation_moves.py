"""Moves on the equations of a grey-box."""

from collections.abc import Callable, Sequence

from asia.agents.library.methods import LM
from asia.agents.library.move import LIKELY, POSSIBLE, SHOWN, Move, Situation
from asia.agents.library.trial_evidence import (
    coloured,
    curved,
    fails_on_top,
    input_left,
)
from asia.agents.view import Facts
from asia.data.statistics import Cause, switching
from asia.problem.physics import parse_expression
from asia.recipe import Recipe, Value


def names_of(at: Situation, setting: str) -> tuple[str, ...]:
    """Return the names in a setting."""
    value = at.recipe.get(setting)
    return tuple(str(name) for name in value) if isinstance(value, tuple) else ()


def output_offsets(facts: Facts, states: Sequence[str]) -> tuple[str, ...]:
    """Outputs that are not states by name, whose offsets would be confused."""
    return tuple(s.name for s in facts.outputs if s.name not in states)


def _noise(at: Situation) -> int:
    """Shown where the equations explain nearly all: before that the residual contains missing
    dynamics."""
    if at.recipe.get("noise_model") == "slow" or at.recipe.method != LM:
        return 0
    # Of the output's deviation: an error below it is near what a disturbance may explain.
    near = (at.trial.train_error or 1.0) < 0.15
    return SHOWN if at.facts.horizon is None and coloured(at.trial) and near else POSSIBLE


def _with_power_sensor(at: Situation) -> Recipe:
    """Bend the sensor in place of the offsets of outputs, which represent its zero."""
    kept = tuple(
        name for name in names_of(at, "offset") if name not in output_offsets(at.facts, at.states)
    )
    offsets: dict[str, Value] = {"offset": kept} if kept else {}
    return at.recipe.without("offset").configured(sensor="power", **offsets)


def _sensor(at: Situation) -> int:
    if at.recipe.get("sensor") or at.facts.horizon is not None:
        return 0
    return SHOWN if curved(at.trial) or fails_on_top(at.trial) else POSSIBLE


def _read_by_others(at: Situation) -> tuple[str, ...]:
    """Return the states that occur in the equation of another state."""
    physics = at.physics
    if physics is None:
        return ()
    texts = {
        state: parse_expression(text, state, memory=True).names
        for state, text in physics.dynamics.items()
    }
    return tuple(
        name
        for name in physics.states
        if any(name in names for state, names in texts.items() if state != name)
    )


def _inputs(at: Situation) -> tuple[str, ...]:
    return tuple(signal.name for signal in at.facts.inputs)


def velocities(at: Situation) -> tuple[str, ...]:
    """States that are the rate of change of another or, where there are none, those that outputs
    show."""
    physics = at.physics
    if physics is None:
        return ()
    named = [text.strip() for text in physics.dynamics.values()]
    rates = tuple(state for state in physics.states if state in named)
    shown = [physics.observation.get(s.name, s.name).strip() for s in at.facts.outputs]
    return rates or tuple(state for state in physics.states if state in shown)


def _switching(at: Situation, setting: str, causes: tuple[Cause, ...]) -> int:
    found = switching(at.facts.records)
    if not found.found or found.cause not in causes or at.recipe.get(setting):
        return 0
    return SHOWN if coloured(at.trial) else POSSIBLE


def _turning_input(at: Situation) -> str:
    return at.facts.inputs[switching(at.facts.records).signal].name


def _terms(at: Situation) -> int:
    if at.recipe.get("discover") or at.recipe.get("residual") or at.recipe.method != LM:
        return 0
    return LIKELY if coloured(at.trial) else POSSIBLE


def _addition(
    name: str,
    setting: str,
    names: Callable[[Situation], tuple[str, ...]],
    evidence: Callable[[Situation], int],
    hypothesis: str,
    expected: str,
) -> Move:
    """Make the move that puts the next of the names into the setting, of whole records.

    Args:
        evidence: evidence while there is such a name
    """

    def following(at: Situation) -> str:
        return next((name for name in names(at) if name not in names_of(at, setting)), "")

    return Move(
        name=name,
        evidence=lambda c: evidence(c) * (c.facts.horizon is None and bool(following(c))),
        change=lambda c: c.recipe.configured(**{setting: (*names_of(c, setting), following(c))}),
        state=following,
        hypothesis=hypothesis,
        expected=expected,
    )


def _removal(what: str, *settings: str) -> Move:
    """An addition that the folds disagree about, or that the error does not miss, is taken away.

    Args:
        settings: the addition, then settings that mean nothing without it
    """

    return Move(
        name=f"without {what}",
        evidence=lambda c: bool(c.recipe.get(settings[0])),
        change=lambda c: c.recipe.without(*settings),
        hypothesis="The added term may overfit its fold: V does not rise without it if the effect "
        "is not real, or if a later addition is the true one.",
        expected="The same training error or a little more, and a lower V.",
    )


EQUATION_MOVES: tuple[Move, ...] = (
    Move(
        name="dry friction on {state}",
        evidence=lambda c: (
            _switching(c, "friction", ("velocity", "displacement")) * bool(velocities(c))
        ),
        change=lambda c: c.recipe.configured(friction=velocities(c)),
        state=lambda c: ", ".join(velocities(c)),
        hypothesis="The residual of a one-step model has the sign of a velocity: dry friction, "
        "with different levels in the two directions and more of it at rest (Stribeck).",
        expected="A far lower error where the system sticks or reverses, on every fold.",
    ),
    Move(
        name="friction with presliding on {state}",
        evidence=lambda c: (
            LIKELY
            * bool(c.recipe.get("friction") and (not c.recipe.get("presliding")))
            * (switching(c.facts.records).cause == "displacement")
        ),
        change=lambda c: c.recipe.configured(presliding=True),
        state=lambda c: ", ".join(velocities(c)),
        hypothesis="The records depend on the last reversal of the motion: friction yields a "
        "little before it slides (LuGre).",
        expected="Lower error after each reversal of the motion.",
    ),
    Move(
        name="hysteresis on {state}",
        evidence=lambda c: _switching(c, "hysteresis", ("displacement",)) * bool(velocities(c)),
        change=lambda c: c.recipe.without("friction", "presliding").configured(
            hysteresis=velocities(c)
        ),
        state=lambda c: ", ".join(velocities(c)),
        hypothesis="The residual of a one-step model depends on the last reversal of the motion: a "
        "restoring force with hysteresis (Bouc-Wen).",
        expected="A far lower error over whole loops, on every fold.",
    ),
    Move(
        name="play behind {state}",
        evidence=lambda c: _switching(c, "play", ("input",)),
        change=lambda c: c.recipe.configured(play=(_turning_input(c),)),
        state=lambda c: _turning_input(c),
        hypothesis="The residual of a one-step model depends on the last reversal of the input: "
        "backlash between the actuator and its load.",
        expected="Lower error after each reversal of the input, on every fold.",
    ),
    Move(
        name="shorter steps of the integrator",
        evidence=lambda c: (
            any(c.recipe.get(force) for force in ("friction", "hysteresis", "play"))
            * (c.recipe.number("substeps", 2) < 8)
        ),
        change=lambda c: c.recipe.configured(substeps=4 * round(c.recipe.number("substeps", 2))),
        hypothesis="A switching force is smoothed to the step of the integrator: shorter steps "
        "allow a sharper switch.",
        expected="Lower error where the system sticks; the fit takes longer.",
    ),
    Move(
        name="terms that the equations lack",
        evidence=_terms,
        change=lambda c: c.recipe.configured(discover=c.states),
        hypothesis="The equations lack a term: a product of states and inputs, found from the "
        "sensitivity of the simulation error.",
        expected="A far lower error on every fold, and the same terms in all folds.",
    ),
    Move(
        name="slow disturbance",
        evidence=_noise,
        # Priors need less weight under a noise model of the residual.
        change=lambda c: (
            c.recipe.without("robust")
            .trained(noise_model="slow", huber=3.0)
            .times("ridge", 0.1, 1e-3)
        ),
        hypothesis="The residual is slow: least squares treats it as many independent errors, "
        "which biases the parameters. A model of a slow disturbance plus white noise avoids this "
        "bias.",
        expected="A higher training error, similar parameters in all folds, and a lower V.",
    ),
    Move(
        name="bent sensor",
        evidence=_sensor,
        change=_with_power_sensor,
        hypothesis="The measured output is an increasing curve of the modelled one: errors at low "
        "and high outputs have the same sign.",
        expected="Parameters nearer to their priors, and a lower V on every fold.",
    ),
    Move(
        name="sensor of any shape",
        evidence=lambda c: LIKELY * (c.recipe.get("sensor") == "power"),
        change=lambda c: c.recipe.configured(sensor="spline"),
        hypothesis="A bent sensor helped; a power law may not be its curve.",
        expected="Lower error where the power law was off, on every fold.",
    ),
    _addition(
        "{state} acts late",
        "lag",
        _read_by_others,
        lambda c: LIKELY if input_left(c.trial) and not names_of(c, "lag") else POSSIBLE,
        "The effect of one state on the next is delayed: the record reverses later than the "
        "simulation.",
        "Lower error at turning points; the input explains less of the residual.",
    ),
    _addition(
        "{state} follows its command late",
        "lag",
        _inputs,
        lambda _: POSSIBLE,
        "An actuator follows its command with a lag of its own.",
        "The input no longer explains the residual.",
    ),
    _addition(
        "smooth correction of {state}",
        "smooth",
        lambda c: c.states[::-1],
        lambda _: POSSIBLE,
        "The law of a state is nearly right: a smooth factor, kept near 1 by its prior, corrects "
        "it.",
        "Lower error at the levels where the law is wrong.",
    ),
    _addition(
        "smooth correction of {state}, an input",
        "smooth",
        _inputs,
        lambda _: POSSIBLE,
        "An actuator is slightly nonlinear: a smooth factor models its curve.",
        "Lower error at the commands where the linear model is wrong.",
    ),
    Move(
        name="wider smooth corrections",
        evidence=lambda c: (
            bool(names_of(c, "smooth")) * (c.recipe.number("smooth_width", 0.05) < 0.3)
        ),
        change=lambda c: c.recipe.times("smooth_width", 3.0, 0.05),
        hypothesis="Smooth corrections helped, and their prior may be too strong.",
        expected="Lower training error, V follows.",
    ),
    _removal("the linear term", "linear"),
    _removal("the network", "residual"),
    _removal("offsets", "offset"),
    _removal("lags", "lag"),
    _removal("smooth corrections", "smooth"),
    _removal("the delay", "input_delay"),
    _removal("the bent sensor", "sensor"),
    _removal("dry friction", "friction", "presliding"),
    _removal("hysteresis", "hysteresis"),
    _removal("the play", "play"),
    _removal("the terms that were found", "discover"),
)
