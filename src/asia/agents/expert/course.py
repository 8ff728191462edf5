"""Strategy while no candidate beats the mean of the output: a likely cause with advice, and moves
to other model classes."""

from __future__ import annotations

from math import ceil, log

from asia.agents._view import AgentView, Facts
from asia.agents.library.methods import by_multiple_shooting
from asia.agents.library.move import Move, Situation
from asia.agents.library.recipe import Recipe
from asia.agents.library.records.integrators import integrating
from asia.agents.library.records.relation import Relation, relation

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
