"""Diagnosis of a search that does not progress, and its stop at the noise floor."""

from __future__ import annotations

from math import ceil, log
from statistics import NormalDist

from asia.agents.library.methods import by_multiple_shooting
from asia.agents.library.move import Move, Situation
from asia.agents.library.recipe import Recipe
from asia.agents.library.records import (
    Relation,
    integrating,
    noise_of_periods,
    overfit,
    relation,
    worst,
)
from asia.agents.view import AgentView, Facts, Trial

# Strategy while no candidate beats the mean of the output: a likely cause with advice, and moves
# to other model classes.


# Share of V of the mean from which on a model says next to nothing, and how many fits, and kinds of
# model, have to agree on that.
_NEXT_TO_NOTHING, _FITS, _KINDS = 0.95, 3, 2
# A mode that hardly comes back.
_SLOW = 0.97
# The greatest delay that families look for by themselves.
_DELAY_TRIED = 10
_MOST_STARTS = 8


def beats_nothing(view: AgentView) -> bool:
    """Return whether the first kinds of model were tried and none of them beats the mean."""
    mean = min(1.0, view.mean) if view.mean is not None else 1.0
    best = view.best
    if best is not None and best.value is not None and best.value < _NEXT_TO_NOTHING * mean:
        return False
    # A fit that did not end in time says nothing of the system.
    said = ("invalid", "discard")
    tried = [t.family for t in view.trials if t.value is not None or t.status in said]
    return len(tried) >= _FITS and len(set(tried)) >= _KINDS


def why_nothing_helps(view: AgentView) -> str:
    """Describe the likely cause in the training records, and the remedy."""
    best = view.best
    lowest = "" if best is None else f" (best V {best.value:.3g} of #{best.number:02d})"
    cause = _cause(view.facts, relation(view.facts))
    return f"no candidate beats the mean of the output{lowest}: {cause}"


def _cause(facts: Facts, found: Relation) -> str:
    if found.unstable:
        loop = (
            " and the inputs follow the past outputs: a control loop stabilises it"
            if found.feedback
            else ""
        )
        return (
            f"the plant is unstable (a pole of modulus {found.pole:.4g}){loop}. "
            f"{_windows(facts, found)}"
        )
    if found.feedback:
        return (
            "the inputs follow the past outputs (correlation "
            f"{found.feedback:.2f}): the records come from a closed loop, and the outputs follow "
            "unmeasured disturbances. "
            f"{_windows(facts, found)} Or excite the set point and record it as an input."
        )
    if not found.acts:
        return (
            f"no input and no squared input has a significant effect on an output within "
            f"{found.reach} "
            "samples. Check that inputs and outputs are synchronised, that the inputs vary "
            "enough, and that the input that drives the plant is recorded. "
            f"{_windows(facts, found)}"
        )
    if found.delay > _DELAY_TRIED:
        return f"the dead time is {found.delay} samples. Models with this delay follow."
    if integrating(facts):
        return (
            "an output drifts with the sum of the inputs, so that small input errors "
            f"accumulate. Models with free integrators follow. {_windows(facts, found)}"
        )
    return (
        "the inputs have an effect, but no model so far predicts it over a whole simulation. "
        f"Other initial values and model classes follow. {_windows(facts, found)}"
    )


def _windows(facts: Facts, found: Relation) -> str:
    """Advice on windows: as long as an error needs to grow tenfold."""
    if facts.horizon is not None:
        return (
            f"Shorter windows than {facts.horizon} samples, or a longer past window than "
            f"{facts.past} samples, make the task easier."
        )
    long = ceil(log(10.0) / log(found.pole)) if found.unstable else 50
    return (
        'Use kind = "windows" in [protocol]: each simulation then starts from measured outputs '
        f"(horizon = {min(long, 200)} or less)."
    )


def _stuck(at: Situation) -> bool:
    return beats_nothing(at.view)


def _late_weight(at: Situation) -> float:
    """Near certain: without the delay a model sees only inputs that do not act yet."""
    late = relation(at.facts).delay
    there = at.recipe.number("delay", 0) >= late - 1
    return 0.93 * (at.recipe.has("delay") and late > _DELAY_TRIED and not there)


def _late(at: Situation) -> Recipe:
    return at.recipe.configured(delay=relation(at.facts).delay - 1)


def _integrator_weight(at: Situation) -> float:
    free = at.varies("integrators") and not at.recipe.number("integrators", 0)
    if not (_stuck(at) and free) or at.facts.horizon is not None:
        return 0.0
    found = relation(at.facts)
    return 0.85 if found.pole > _SLOW and not found.unstable else 0.3


def _starts_weight(at: Situation) -> float:
    return 0.45 * (_stuck(at) and 0 < at.recipe.number("starts", 0) < _MOST_STARTS)


def _drawn_weight(at: Situation) -> float:
    return 0.4 * (_stuck(at) and at.varies("start") and at.recipe.get("start") != "random")


def _pieces_weight(at: Situation) -> float:
    whole = at.facts.horizon is None and not at.recipe.get("pieces")
    return 0.8 * (_stuck(at) and at.varies("pieces") and whole)


def _shooting_weight(at: Situation) -> float:
    can = at.recipe.method == "Adam" and by_multiple_shooting in at.row.methods
    return 0.35 * (_stuck(at) and can)


COURSE_MOVES: tuple[Move, ...] = (
    Move(
        name="inputs that act after {state} samples",
        state=lambda c: str(relation(c.facts).delay),
        weight=_late_weight,
        change=_late,
        hypothesis=(
            "The innovations of the outputs correlate with those of the inputs at this delay, "
            "which is longer than a model detects automatically."
        ),
        expected="A far lower V.",
        behind_counts=False,
    ),
    Move(
        name="a free integrator",
        weight=_integrator_weight,
        change=lambda c: c.recipe.configured(integrators=1),
        hypothesis=(
            "No model beats the mean: the output may integrate its inputs, which stable modes "
            "cannot follow."
        ),
        expected="A V below that of the mean, if the output drifts with the sum of the inputs.",
        behind_counts=False,
    ),
    Move(
        name="from short pieces",
        weight=_pieces_weight,
        change=lambda c: c.recipe.configured(pieces=True, past_fit=True),
        hypothesis=(
            "No model beats the mean: whole records may be too long for training. Short "
            "segments, each with its own initial state, are easier to fit."
        ),
        expected="A lower training error, V follows.",
        behind_counts=False,
    ),
    Move(
        name="many other starts",
        weight=_starts_weight,
        change=lambda c: c.recipe.trained(starts=_MOST_STARTS),
        hypothesis="No model beats the mean: all fits so far may be in poor local minima.",
        expected="A far lower training error, or evidence that local minima are not the cause.",
        behind_counts=False,
    ),
    Move(
        name="from a random start",
        weight=_drawn_weight,
        change=lambda c: c.recipe.configured(start="random"),
        hypothesis="No model beats the mean, and the linear model is a poor starting point.",
        expected="A different minimum.",
        behind_counts=False,
    ),
    Move(
        name="by multiple shooting from measured states",
        weight=_shooting_weight,
        change=lambda c: by_multiple_shooting(c.facts, c.recipe),
        hypothesis="No model beats the mean: gradients through long simulations may be the cause.",
        expected="Lower training error where whole simulations are hard to fit.",
        behind_counts=False,
    ),
)
_NAMES = frozenset(move.name for move in COURSE_MOVES)


def keeps_course(move: Move) -> bool:
    """Return whether the move is worth making while nothing beats the mean: it looks for another
    kind of model, or mends a fit that failed."""
    return move.name in _NAMES or move.after == "failure"


# Stop criterion: the noise floor is reached.


# Further tries that all must fail, and the share of V by which one of them counts as a gain.
_TRIES, _GAIN = 3, 0.01
# V over the training error up to which nothing is left.
_AT_TRAINING = 1.03
# V over the noise that repeated periods show, likewise.
_AT_FLOOR = 1.03
_LAGS = 20
_LEVEL = 0.01


def reason_to_end(view: AgentView) -> str | None:
    """Return the reason to end the search now, in a sentence; None to continue."""
    best = view.best
    if best is None or _tries_since_gain(view) < _TRIES:
        return None
    floor = noise_of_periods(view.facts) if view.facts.metric == "rmse" else None
    if floor is not None and best.value is not None and best.value <= _AT_FLOOR * floor:
        return (
            f"V of #{best.number:02d} is {best.value:.3g}, the variation between the periods of "
            f"the "
            f"records is {floor:.3g} of the output, and {_TRIES} further experiments gained less "
            "than 1 %: the noise floor is reached"
        )
    if not nothing_left(view, best):
        return None
    return (
        f"the residuals of #{best.number:02d} are white and independent of the inputs within 99 % "
        "bands, its V equals its training error, and "
        f"{_TRIES} further experiments gained less than 1 %: the noise floor is reached"
    )


def nothing_left(view: AgentView, trial: Trial) -> bool:
    """Return whether residuals of the training side look like noise alone, and V agrees with them.

    Bands hold for all lags, signals and folds together. Windows overlap, so that residuals in them
    tell no bands.
    """
    facts = view.facts
    train = trial.train_error
    if facts.horizon is not None or trial.value is None or not train:
        return False
    if not 1 / _AT_TRAINING**2 < overfit(trial) <= _AT_TRAINING:
        return False
    outputs, inputs = len(facts.outputs), len(facts.inputs)
    band = _band(facts.fit_samples, _LAGS * outputs * (1 + inputs) * max(1, len(trial.folds)))
    return (
        worst(trial, lambda d: d.whiteness) < band
        and worst(trial, lambda d: d.input_correlation) < band
        and worst(trial, lambda d: d.curvature) < band
    )


def _band(samples: int, tests: int) -> float:
    """Return the 99 % quantile of the largest of `tests` correlations of white noise."""
    return NormalDist().inv_cdf(1.0 - _LEVEL / (2 * tests)) / max(samples, 1) ** 0.5


def _tries_since_gain(view: AgentView) -> int:
    """Trials since the last one that was better than all before it by more than the least gain."""
    best, last = float("inf"), 0
    for place, trial in enumerate(view.trials, 1):
        if trial.value is not None and trial.value < (1.0 - _GAIN) * best:
            best, last = trial.value, place
    return len(view.trials) - last
