"""The default agent: fair trials of model families, then forward selection of effects.

1. Families of what the user gave, equations or a simulator, come first, or else equations of at
   most two plants that the problem looks like, then the ladder of families in the order of their
   aptness, for the first part of the budget. An effect that explains more than a third of the
   residual of a nonlinear model, or that the records show, interrupts it.
2. Effects are added to the best candidate, by the share of the residual that they explain. One that
   did not help comes after all that were not tried.
3. The best candidate of another family is carried on as well while its error over the folds is
   within one standard error of the best. An effect that the records show is tried on any family.
4. Where nothing points at an effect, or two in a row did not help, the next family of the ladder
   gets its trial. Effects that nothing points at come last.

It is deterministic and needs no language model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import takewhile
from math import sqrt
from statistics import fmean, stdev

from asia.agents.control import propose_controller
from asia.agents.expert.diagnosis import (
    answers,
    beats_nothing,
    diagnoses,
    keeps_course,
    leading_maps,
    places,
    reason_to_end,
    why_nothing_helps,
)
from asia.agents.expert.moves import all_moves
from asia.agents.expert.notes import avoided, read_notes
from asia.agents.library.family import Family, is_new, under_protocol
from asia.agents.library.move import LIKELY, POSSIBLE, SHOWN, Move, Situation, plain_title, title_of
from asia.agents.library.plants import equations_of, likely_plants, usual_effects
from asia.agents.library.registry import families, family
from asia.agents.library.traits import traits
from asia.agents.view import (
    LINEAR,
    PARENT,
    AgentStoppedError,
    AgentView,
    Proposal,
    Running,
    Trial,
)
from asia.data.level_responses import describe_levels
from asia.plants.recognition import Likeness
from asia.recipe import Recipe, read_recipe, with_chosen_equations

GIVEN = frozenset({"greybox", "physics_net", "simulator"})
"""Families of what the user gave, equations and a simulator."""
SHARES = {SHOWN: 1.0, LIKELY: 0.2, POSSIBLE: 0.0}
"""Share of the residual that an effect counts for by its evidence alone, without a diagnosis."""
INTERRUPTS = 1 / 3
"""Share of the residual of a nonlinear model that an effect must explain to come before the next
family. Effects on the linear model wait: the families of the ladder have them."""
PATIENCE = 2
"""Effects in a row without a gain after which another family is tried."""
NEAR = 0.25
"""V of the best candidate over that of equations, down to which terms are added to them."""
# Functions of a sensor that lose the sign of the output.
_WITHOUT_SIGN = frozenset({"magnitude", "square"})
# Settings that need one sampling time.
_COUNTED_IN_SAMPLES = ("input_delay", "discover", "noise_model")
_CHOSEN_BY_FIT = frozenset({"order", "delay", "na", "nb"})


@dataclass(frozen=True)
class Option:
    """Something to try."""

    family: str
    make: Callable[[], Proposal | None]
    """The proposal; None when it was tried before."""
    seconds: float
    """Expected duration of its fit."""
    share: float = 0.0
    """Share of the residual of the best candidate that it is known to explain."""
    apt: bool = True
    """Whether it is worth a place in the ladder."""


class ExpertAgent:
    """Agent with a ladder of families and forward selection of effects.

    Running experiments count as tried, and their effects as without a gain so far.
    """

    name = "expert"
    proposes_ahead = True

    def propose(self, view: AgentView) -> Proposal | None:
        """Propose the candidate of a note, the next family of the ladder, or the next effect; None
        when all are known.

        Raises:
            AgentStoppedError: where the noise floor is reached
        """
        if view.facts.control is not None:
            return propose_controller(view)
        wishes, answers = read_notes(view.notes)
        unwanted = avoided(wishes)
        remarks, proposal = list(answers), None
        for wish in wishes:
            if wish.avoid or wish.is_followed(view) or proposal is not None:
                continue
            options = (*effects(view), *untried(view))
            proposal = _first_new(one for one in options if one.family == wish.name)
            if proposal is None:
                remarks.append(
                    f"note {wish.note}: nothing new to try for {wish.text!r} on this problem"
                )
            else:
                proposal = replace(proposal, hypothesis=f"{proposal.hypothesis} {wish.mark}")
        remarks += lost_plants(view)
        if proposal is None:
            end = reason_to_end(view)
            if end is not None:
                raise AgentStoppedError("saturated", end)
            proposal = _next(view, unwanted)
            if beats_nothing(view):
                remarks.append(why_nothing_helps(view))
                if proposal is None:
                    raise AgentStoppedError("exhausted", remarks[-1])
        if proposal is None:
            return None
        curved = any(name == "amplitude" for name, _ in diagnoses(view))
        if len(view.trials) == 1 and curved and places(view.facts):
            term, where, share = view.facts.terms()[0]
            remarks.append(
                f"{term} {where} explains {100 * share:.0f} % of a linear model's residual"
            )
        if len(view.trials) == 1:
            facts = view.facts
            remarks += describe_levels(facts.records, facts.inputs, facts.outputs)
        new = [wish.mark for wish in wishes if wish.avoid and not wish.is_followed(view)]
        hypothesis = " ".join((proposal.hypothesis, *new))
        remarks += [proposal.remark] if proposal.remark else []
        return replace(proposal, hypothesis=hypothesis, remark="; ".join(remarks), fair=True)


def _next(view: AgentView, unwanted: set[str]) -> Proposal | None:
    found, new = (
        [option for option in options if option.family not in unwanted]
        for options in (effects(view), untried(view))
    )
    given = [option for option in new if option.family in GIVEN]
    if "greybox" not in unwanted:
        given += recognised(view)
    shown = [
        option
        for option in found
        if option.share >= (SHARES[SHOWN] if option.family == "linear" else INTERRUPTS)
    ]
    likely = [option for option in found if option.share > 0.0]
    ladder = [option for option in new if option.apt]
    waiting = view.phase == "explore" or _idle(view) >= PATIENCE
    turns = *given, *shown, *(ladder if waiting else ()), *likely, *ladder, *found, *new
    return _first_new(turns)


def _first_new(options: Iterable[Option]) -> Proposal | None:
    """The first that was not tried before."""
    return next((p for option in options if (p := option.make()) is not None), None)


def untried(view: AgentView) -> Iterator[Option]:
    """First configurations of families that nothing proposed has used, the most apt first."""
    used, maps = {t.family for t in view.proposed}, dict(leading_maps(view))
    if view.linear is not None:
        used.add("linear")  # The best linear model is scored in every search.
    for row in families(view.facts):
        if row.name in used:
            continue
        kept = {k: kind for k, kind in maps.items() if not row.has_static or kind in _WITHOUT_SIGN}
        recipe = row.trial(view.facts).mapped(**kept)
        seconds, apt = row.seconds(view.facts, recipe), row.aptness(view.facts) > 0
        yield Option(row.name, partial(_first, view, row, recipe), seconds, apt=apt)


def recognised(view: AgentView) -> Iterator[Option]:
    """Equations of the plants that the problem looks like, where the user gave none."""
    facts, row = view.facts, family("greybox")
    if row is None or {"physics", "plant", "irregular"} & traits(facts):
        return
    for one in likely_plants(facts):
        texts = equations_of(facts, one)
        recipe = row.trial(facts).configured(physics=texts)
        if texts:
            make = partial(_of_plant, view, row, recipe, one)
            yield Option(row.name, make, row.seconds(facts, recipe))


def _of_plant(view: AgentView, row: Family, recipe: Recipe, one: Likeness) -> Proposal | None:
    if not is_new(view, row, recipe):
        return None
    return Proposal(
        source=under_protocol(recipe, row, view.facts).source(f"Grey-box: {one.plant.title}."),
        family=row.name,
        title=f"{row.label}: {one.plant.title}",
        hypothesis=f"{one.looks}.",
        expected="A V below that of the linear model, with parameters inside their ranges.",
        remark=one.looks,
    )


def lost_plants(view: AgentView) -> Iterator[str]:
    """Sentence on the last experiment, where its plant of the catalogue is given up."""
    for trial in view.trials[-1:]:
        recipe = read_recipe(trial.source)
        if recipe is not None and trial.parent is None and _is_lost(view, trial, recipe):
            yield f"#{trial.number:02d}, {trial.title}: no better than the linear model"


def _is_lost(view: AgentView, trial: Trial, recipe: Recipe) -> bool:
    """Whether a candidate with equations of the catalogue is no better than the linear model."""
    if not recipe.get("physics"):
        return False
    below = trial.value is not None and (view.linear is None or trial.value < view.linear)
    return trial.variant == LINEAR or not below


def _first(view: AgentView, row: Family, recipe: Recipe) -> Proposal | None:
    if not is_new(view, row, recipe):
        return None
    sentence = f"{_sentence(row.label)}: {row.use}."
    return Proposal(
        source=under_protocol(recipe, row, view.facts).source(sentence),
        family=row.name,
        title=row.label,
        hypothesis=sentence,
        expected="A first V of this family, to compare it with the others.",
    )


def effects(view: AgentView) -> Iterator[Option]:
    """Effects that may be added to the best candidate of each family, in the order in which they
    are tried: those that the records show, those on candidates that are carried on, the others.
    While nothing beats the mean, none that varies a model."""
    lost, answer = beats_nothing(view), answers(view)
    kept = {at.row.name for at in carried(view)}
    ranked: list[tuple[tuple[float, ...], Option]] = []
    for at in situations(view):
        for move in all_moves():
            evidence = int(move.evidence(at)) if move.applies(at) else 0
            if evidence == POSSIBLE and at.recipe.get("physics") and _is_usual(at, move):
                evidence = LIKELY
            behind = at.row.name not in kept and evidence < SHOWN
            if not evidence or (lost and not keeps_course(move)):
                continue
            if behind and at.row.doubtful(view.facts):
                continue
            title = move.title(at)
            tries = sum(_without_gain(t) for t in view.proposed if plain_title(t.title) == title)
            share = max(SHARES[evidence], answer.get(move.name, 0.0)) if not behind else 0.0
            order = list(answer).index(move.name) if move.name in answer else len(answer)
            option = Option(
                at.row.name,
                partial(moved, at, move),
                at.row.seconds(at.facts, move.change(at)),
                share / (1 + tries),
            )
            ranked.append(((behind, tries, -share, order, at.place), option))
    yield from (option for _, option in sorted(ranked, key=lambda one: one[0]))


def _is_usual(at: Situation, move: Move) -> bool:
    """Whether the plant that the problem looks like usually has the effect."""
    before, after = at.recipe.settings, move.change(at).settings
    return any(before.get(n) != v for n, v in after.items() if n in usual_effects(at.facts))


def moved(at: Situation, move: Move) -> Proposal | None:
    """The candidate of a move; None where it is known, or does not go with the records."""
    recipe = move.change(at)
    counted = recipe.maps or any(map(recipe.get, _COUNTED_IN_SAMPLES))
    if "irregular" in traits(at.facts) and counted:
        return None
    # Static functions are fitted in open loop, whatever the family's method.
    if "feedback" in traits(at.facts) and recipe.maps:
        return None
    if not is_new(at.view, at.row, recipe):
        return None
    # None leaves an order or a delay to the fit, and is the default of other settings.
    settings = [f"{k} {v}" for k, v in (*recipe.maps, *recipe.config) if v is not None]
    chosen = [k for k, v in recipe.config if v is None and k in _CHOSEN_BY_FIT]
    if chosen:
        settings.append(f"{' and '.join(chosen)} chosen by the fit")
    summary = f"{_sentence(at.row.label)}: {', '.join(settings) or 'plain'}."
    return Proposal(
        source=under_protocol(recipe, at.row, at.facts).source(summary),
        family=recipe.family,
        title=title_of(at, move, recipe),
        hypothesis=move.hypothesis,
        expected=move.expected,
        parent=at.trial.number,
    )


def situations(view: AgentView) -> Iterator[Situation]:
    """The best trial of each family, the best first, then those of families that only failed."""
    failed = [trial for trial in reversed(view.trials) if trial.value is None]
    chosen: dict[str, tuple[Trial, Recipe]] = {}
    for trial in (*view.ranked, *failed):
        # Where what it began with was as good, nothing else was scored.
        recipe = None if trial.variant in (LINEAR, PARENT) else read_recipe(trial.source)
        recipe = recipe and with_chosen_equations(recipe, trial.variant)
        if recipe is None or recipe.family in chosen or _is_lost(view, trial, recipe):
            continue
        chosen[recipe.family] = trial, recipe
    for place, (trial, recipe) in enumerate(chosen.values()):
        row = family(recipe.family)
        if row is not None:
            yield Situation(view, trial, recipe, row, place)


def carried(view: AgentView) -> Iterable[Situation]:
    """The best candidate, that of one other family within one standard error, that of equations to
    which terms can still be added, and families that only failed."""
    best, other = view.best, False
    for at in situations(view):
        if at.trial.value is None or best is None:
            yield at
            continue
        doubtful = at.place > 0 and at.row.doubtful(view.facts)
        close = not other and _within_error(best, at.trial)
        leader = family(best.family)
        black_box = leader is None or leader.kind != "equations"
        assert best.value is not None
        growing = at.row.extendable and black_box and best.value > NEAR * at.trial.value
        if at.place == 0 or beats_nothing(view) or ((close or growing) and not doubtful):
            other |= at.place > 0 and not growing
            yield at


def _within_error(best: Trial, trial: Trial) -> bool:
    """Whether V is above the best by no more than the standard error over the folds."""
    behind = [b - a for a, b in zip(best.folds, trial.folds, strict=False)]
    if len(behind) < 2:
        return False
    return fmean(behind) <= stdev(behind) / sqrt(len(behind))


def _without_gain(one: Trial | Running) -> bool:
    return isinstance(one, Running) or not one.improved


def _idle(view: AgentView) -> int:
    """Effects in a row, up to now, that did not help."""
    last = takewhile(lambda one: one.parent is not None and _without_gain(one), view.proposed[::-1])
    return sum(1 for _ in last)


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]
