"""Diagnosis of a search that does not progress, and its stop at the noise floor."""

from __future__ import annotations

from statistics import NormalDist

from asia.agents.library.move import (
    LIKELY,
    POSSIBLE,
    SHOWN,
    Move,
    Situation,
    is_titled,
    plain_title,
)
from asia.agents.library.registry import family
from asia.agents.library.traits import periodic, sign_lost
from asia.agents.library.trial_evidence import coloured, overfit, worst
from asia.agents.view import AgentView, Facts, Trial
from asia.data.level_responses import level_responses
from asia.data.statistics import feedback_size, largest_pole, noise_of_periods, unstable
from asia.data.trajectory import MOST_DELAY
from asia.problem.obstacles import least_delay, obstacle
from asia.problem.physics_text import read_physics
from asia.recipe import Arguments, Recipe, read_recipe, with_chosen_equations

# Strategy while no candidate beats the mean of the output: moves to other model classes.


def beats_nothing(view: AgentView) -> bool:
    """Return whether three fits, of at least two kinds of model, are no better than 95 % of V of
    the mean."""
    mean = min(1.0, view.mean) if view.mean is not None else 1.0
    best = view.best
    if best is not None and best.value is not None and best.value < 0.95 * mean:
        return False
    # A fit that did not end in time says nothing of the system.
    tried = [t.family for t in view.trials if t.value is not None or t.status == "invalid"]
    return len(tried) >= 3 and len(set(tried)) >= 2


def why_nothing_helps(view: AgentView) -> str:
    """Describe the likely cause in the training records, and the remedy."""
    best, facts = view.best, view.facts
    lowest = "" if best is None else f" (best V {best.value:.3g} of #{best.number:02d})"
    return obstacle(facts.records, facts.horizon, facts.past, lowest)


def _late(at: Situation) -> int:
    """Shown: without the delay a model sees only inputs that do not act yet."""
    late = least_delay(at.facts.records)
    there = at.recipe.number("delay", 0) >= late - 1
    return SHOWN * (at.recipe.has("delay") and late > MOST_DELAY and not there)


def _stuck(at: Situation) -> bool:
    return beats_nothing(at.view)


def _in_pieces(at: Situation) -> Recipe:
    recipe = at.recipe.configured(pieces=True)
    return recipe.configured(past_fit=True) if at.varies("past_fit") else recipe


def _integrator(at: Situation) -> int:
    free = at.varies("integrators") and not at.recipe.number("integrators", 0)
    free = free and not (at.recipe.get("regularised") or at.recipe.get("loop"))
    if not (_stuck(at) and free) or at.facts.horizon is not None:
        return 0
    records = at.facts.records
    # A mode that hardly comes back.
    return LIKELY if largest_pole(records) > 0.97 and not unstable(records) else POSSIBLE


COURSE_MOVES: tuple[Move, ...] = (
    Move(
        name="inputs that act after {state} samples",
        state=lambda c: str(least_delay(c.facts.records)),
        evidence=_late,
        change=lambda c: c.recipe.configured(delay=least_delay(c.facts.records) - 1),
        hypothesis="The innovations of the outputs correlate with those of the inputs at this "
        "delay, which is longer than a model detects automatically.",
        expected="A far lower V.",
    ),
    Move(
        name="a free integrator",
        evidence=_integrator,
        change=lambda c: c.recipe.configured(integrators=1),
        hypothesis="No model beats the mean: the output may integrate its inputs, which stable "
        "modes cannot follow.",
        expected="A V below that of the mean, if the output drifts with the sum of the inputs.",
    ),
    Move(
        name="from short pieces",
        evidence=lambda c: (
            LIKELY
            * (_stuck(c) and c.varies("pieces"))
            * (c.facts.horizon is None and not c.recipe.get("pieces"))
        ),
        change=_in_pieces,
        hypothesis="No model beats the mean: whole records may be too long for training. Short "
        "segments, each with its own initial state, are easier to fit.",
        expected="A lower training error, V follows.",
    ),
)


def keeps_course(move: Move) -> bool:
    """Return whether the move is worth making while nothing beats the mean: it looks for another
    kind of model, or mends a fit that failed."""
    return move in COURSE_MOVES or move.after == "failure"


# Diagnoses: what a check of the evidence says, and the moves that answer it, the likeliest first.


ANSWERS: dict[str, tuple[str, ...]] = {
    "sign": ("sensor without sign", "sensor of squares"),
    "amplitude": (
        "saturated inputs",
        "rising function of the inputs",
        "dead zone of the inputs",
        "static function at the input",
        "rising function of the outputs",
        "bent sensor",
        "smooth correction of {state}, an input",
    ),
    "motion": (
        "dry friction",
        "friction or hysteresis",
        "dry friction on {state}",
        "hysteresis on {state}",
        "a trace of friction",
        "a trace of play",
    ),
    "inputs": (
        "inputs that act after {state} samples",
        "one state more",
        "{state} acts late",
        "{state} follows its command late",
        "one storage more",
    ),
    "level": ("functions of all states", "polynomials", "terms that the equations lack"),
    "time": ("slow disturbance", "slow disturbance in the noise", "a free integrator"),
    "closed loop": ("slow disturbance", "slow disturbance in the noise"),
}
"""Names of the moves that answer a diagnosis."""
DYNAMICS = "in the dynamics"
# Places of a nonlinearity whose answers are left out where a score test finds it elsewhere.
_PLACES: dict[str, str] = {
    "saturated inputs": "at the input",
    "rising function of the inputs": "at the input",
    "dead zone of the inputs": "at the input",
    "static function at the input": "at the input",
    "rising function of the outputs": "at the output",
    "bent sensor": "at the output",
}
# Share of a linear model's residual from which a term counts, and its share of the largest one.
_LEAST_TERM, _LIKELY = 0.15, 0.7
# Share of the residual from which a diagnosis counts.
_LEAST_SHARE = 0.1
# V with static functions, over the least V without any, up to which other families start with them.
_LEADING = 0.6


def diagnoses(view: AgentView) -> tuple[tuple[str, float], ...]:
    """Diagnoses of the best trial with the share of its residual that each explains, the largest
    first."""
    best = view.best
    if best is None:
        return ()
    found = dict(best.diagnoses)
    found["sign"] = 0.0 if _is_unsigned(view, best) else sign_lost(view.facts)
    if coloured(best) and view.facts.horizon is None:
        found["closed loop"] = 0.5 * feedback_size(view.facts.records)
    if best.family == "linear":
        # What it explains of another model's residual is not known.
        found["level"] = max((r.share for r in level_responses(view.facts.records)), default=0.0)
    large = [(k, v) for k, v in found.items() if v >= _LEAST_SHARE and k in ANSWERS]
    return tuple(sorted(large, key=lambda item: -item[1]))


def _is_unsigned(view: AgentView, trial: Trial) -> bool:
    """Return whether a trial has outputs without sign: by a static function, or by its
    equations."""
    recipe, row = read_recipe(trial.source), family(trial.family)
    if recipe is None or recipe.get("output_map") or row is None or row.kind != "equations":
        return "output_map" in trial.source
    own = with_chosen_equations(recipe, trial.variant).get("physics")
    known = read_physics(str(own[0])) if isinstance(own, tuple) and own else view.facts.physics
    return known is not None and any("abs(" in text for text in known.observation.values())


def places(facts: Facts) -> dict[str, float]:
    """Likely places of what a linear model lacks, by a score test of many terms, with the largest
    share of its residual that one explains; empty where no term explains much."""
    best = dict[str, float]()
    for _, place, share in facts.terms():
        best[place] = max(share, best.get(place, 0.0))
    limit = max(_LEAST_TERM, _LIKELY * max(best.values(), default=0.0))
    return {place: share for place, share in best.items() if share >= limit}


def answers(view: AgentView) -> dict[str, float]:
    """Moves that answer a diagnosis, with the share of the residual that it explains: those of the
    strongest diagnosis first, the likeliest first. Moves made on the best trial, or a trial like
    it, count as answers that did not help."""
    best, found = view.best, dict[str, float]()
    made = [
        plain_title(t.title).partition(": ")[2]
        for t in view.proposed
        if best is not None and t.number > best.number
    ]
    for name, share in diagnoses(view):
        left = [move for move in ANSWERS[name] if not any(is_titled(move, t) for t in made)]
        if name == "amplitude":
            likely = places(view.facts)
            # Without a likely place one answer that did not help is enough.
            if not likely and len(left) < len(ANSWERS[name]):
                continue
            left = [m for m in left if not likely or _PLACES.get(m, DYNAMICS) in likely]
            left.sort(key=lambda m: -likely.get(_PLACES.get(m, DYNAMICS), 0.0))
        for move in left:
            found.setdefault(move, min(1.0, share))
    return found


def leading_maps(view: AgentView) -> Arguments:
    """Static functions of the best trial, where its V is at most 0.6 times every V without any:
    those that gain less may make up for what a richer family has."""
    best = view.best
    recipe = read_recipe(best.source) if best is not None else None
    if best is None or best.value is None or recipe is None or not recipe.maps:
        return ()
    known = ((t.value, read_recipe(t.source)) for t in view.ranked)
    plain = [value for value, r in known if value is not None and (r is None or not r.maps)]
    return recipe.maps if best.value <= _LEADING * min(plain, default=1e300) else ()


# Stop criterion: the noise floor is reached.


# V over the training error, or over the noise that repeated periods show, up to which nothing is
# left.
_AT_FLOOR = 1.03


def reason_to_end(view: AgentView) -> str | None:
    """Return the reason to end the search now, in a sentence; None to continue."""
    best, lowest, last_gain = view.best, float("inf"), 0
    for place, trial in enumerate(view.trials, 1):
        if trial.value is not None and trial.value < 0.99 * lowest:
            lowest, last_gain = trial.value, place
    if best is None or last_gain == len(view.trials):
        return None
    facts = view.facts
    by_periods = facts.metric == "rmse" and periodic(facts)
    floor = noise_of_periods(facts.records) if by_periods else None
    if floor is not None and best.value is not None and best.value <= _AT_FLOOR * floor:
        return (
            f"V of #{best.number:02d} is {best.value:.3g}, the variation between the periods of "
            f"the records is {floor:.3g} of the output, and the last experiment gained less than "
            "1 %: the noise floor is reached"
        )
    if not nothing_left(view, best):
        return None
    return (
        f"the residuals of #{best.number:02d} are white and independent of the inputs within 99 % "
        "bands, its V equals its training error, and the last experiment gained less than 1 %: the "
        "noise floor is reached"
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
    if not 1 / _AT_FLOOR**2 < overfit(trial) <= _AT_FLOOR:
        return False
    outputs, inputs = len(facts.outputs), len(facts.inputs)
    # The 99 % quantile of the largest of so many correlations of white noise, of 20 lags each.
    tests = 20 * outputs * (1 + inputs) * max(1, len(trial.folds))
    band = NormalDist().inv_cdf(1.0 - 0.01 / (2 * tests)) / max(facts.fit_samples, 1) ** 0.5
    return (
        worst(trial, lambda d: d.whiteness) < band
        and worst(trial, lambda d: d.input_correlation) < band
        and worst(trial, lambda d: d.curvature) < band
    )
