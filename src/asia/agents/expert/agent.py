"""The default agent: an engineer's habits, deterministic, no language model.

Explore: a first, cheap configuration of each of the families most apt for the problem, interrupted
by a move that is near certain. Refine: of all moves on the best trial of each family, the one with
the most weight for the seconds it is expected to take.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from statistics import median

from asia.agents.control import propose_controller
from asia.agents.expert.allocation import CLOSE, Allocation
from asia.agents.expert.diagnosis import (
    DYNAMICS,
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
from asia.agents.expert.notes import Wish, avoided, read_notes, wished_moves, wished_start
from asia.agents.library.family import Family, is_new, under_protocol
from asia.agents.library.move import Move, Situation, plain_title, title_of
from asia.agents.library.recipe import Recipe, read_recipe
from asia.agents.library.registry import families, family
from asia.agents.library.traits import names_places, traits
from asia.agents.library.trial_evidence import overfit
from asia.agents.view import (
    LINEAR,
    AgentStoppedError,
    AgentView,
    Proposal,
    Running,
    Trial,
)

SURE = 0.9
BEHIND = 0.5
UNTRIED = 0.3
# The same while nothing beats the mean.
UNTRIED_LOST = 0.6
# Families of what the user gave, equations and a simulator; above the weight of any move.
GIVEN, GIVEN_WEIGHT = frozenset({"greybox", "physics_net", "simulator"}), 2.0
NEAR = 0.25
NEAR_EQUATIONS = 0.6
PROMISING = 0.75
PATIENCE = 0.85
# Weight of block-oriented models, over that of other untried families, where the residual depends
# on the amplitude.
STATIC = 1.5
# A first fit that takes so many times the median of the others, and seconds, waits for cheap ones.
SLOW, SLOW_SECONDS = 4.0, 30.0
# Functions of a sensor that lose the sign of the output.
_WITHOUT_SIGN = frozenset({"magnitude", "square"})
# Settings that need one sampling time.
_COUNTED_IN_SAMPLES = ("input_delay", "discover", "noise_model")
_CHOSEN_BY_FIT = frozenset({"order", "delay", "na", "nb"})


@dataclass(frozen=True)
class Option:
    """Something to try."""

    family: str
    weight: float
    make: Callable[[], Proposal | None]
    """The proposal; None when it was tried before."""
    seconds: float
    """Expected duration of its fit."""
    apt: bool = True
    """Whether it is worth a place in the ladder."""
    sure: bool = False
    """Whether it is near certain, so that it interrupts the ladder."""
    move: str = ""
    """The name of the move; "" for the first configuration of a family."""


class ExpertAgent:
    """Agent with a ladder of families, then refinement by moves chosen from training-side evidence.

    Running experiments count as tried, and their moves as unsuccessful so far.
    """

    name = "expert"
    proposes_ahead = True

    def propose(self, view: AgentView) -> Proposal | None:
        """Propose the candidate of a note, the next family of the ladder, or the move with the most
        weight; None when all are known.

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
            proposal = _wished(view, wish, unwanted)
            if proposal is None:
                remarks.append(
                    f"note {wish.note}: nothing new to try for {wish.text!r} on this problem"
                )
            else:
                proposal = replace(proposal, hypothesis=f"{proposal.hypothesis} {wish.mark}")
        if proposal is None:
            end = reason_to_end(view)
            if end is not None:
                raise AgentStoppedError("saturated", end)
            proposal = self._best_of(view, unwanted)
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
        new = [wish.mark for wish in wishes if wish.avoid and not wish.is_followed(view)]
        hypothesis = " ".join((proposal.hypothesis, *new))
        return replace(proposal, hypothesis=hypothesis, remark="; ".join(remarks), fair=True)

    def _best_of(self, view: AgentView, unwanted: set[str]) -> Proposal | None:
        moves, ladder = (
            [option for option in found if not {option.family, option.move} & unwanted]
            for found in (refinements(view), untried(view))
        )
        # Expected seconds of a fit, mean of the trials so far; not measured.
        recipes = (read_recipe(trial.source) for trial in view.trials)
        known = ((r, family(r.family)) for r in recipes if r is not None)
        seconds = [row.seconds(view.facts, recipe) for recipe, row in known if row is not None]
        usual = max(SLOW_SECONDS, sum(seconds) / len(seconds) if seconds else 0.0)

        def paced(options: list[Option]) -> list[Option]:
            """Reduce the weights by the square root of the excess over the usual fit time, where
            fits are slow; experiments are limited too."""
            return [
                replace(o, weight=o.weight * min(1.0, 2.0 * usual / (usual + o.seconds)) ** 0.5)
                for o in options
            ]

        proposal = None
        if view.phase == "explore":
            sure = [option for option in moves if option.sure]
            apt = [option for option in ladder if option.apt]
            proposal = _heaviest([*sure, *_cheap_first(apt)])
        proposal = proposal or _heaviest(paced([*moves, *ladder]))
        allocation = Allocation.of(view)
        objection = allocation.objection(proposal.family) if proposal is not None else ""
        if proposal is None or not objection:
            return proposal
        if allocation.waits(proposal.family):
            # New families in the order of their aptness, those that take far longer last.
            options, place = [*paced(moves), *_cheap_first(ladder)], allocation.chance
        else:
            options, place = paced([*moves, *ladder]), None
        other = _heaviest([o for o in options if not allocation.objection(o.family)], place)
        if other is None:
            return proposal
        return replace(other, hypothesis=f"{other.hypothesis} {objection}")


def _heaviest(options: list[Option], place: Callable[[str], int] | None = None) -> Proposal | None:
    """The first in order of weight that was not tried before.

    Args:
        place: of a family, which comes before the weight
    """
    ordered = sorted(options, key=lambda o: (place(o.family) if place else 0, -o.weight))
    return next((p for option in ordered if (p := option.make()) is not None), None)


def _cheap_first(ladder: list[Option]) -> list[Option]:
    """Reduce the weights of families whose first fits take far longer than those of the others."""
    usual = median([option.seconds for option in ladder]) if ladder else 0.0
    limit = max(SLOW_SECONDS, SLOW * usual)
    return [replace(o, weight=0.5 * o.weight) if o.seconds > limit else o for o in ladder]


def untried(view: AgentView) -> Iterator[Option]:
    """First configurations of families that nothing proposed has used, the most apt first."""
    used, lost = {t.family for t in view.proposed}, beats_nothing(view)
    static = any(name == "amplitude" for name, _ in diagnoses(view))
    static = static and set(places(view.facts)) != {DYNAMICS} and not names_places(view.facts)
    maps = dict(leading_maps(view))
    for row in families(view.facts):
        if row.name in used:
            continue
        weight = UNTRIED_LOST if lost else UNTRIED
        if row.name in GIVEN:
            weight = GIVEN_WEIGHT
        if static and row.name == "block_oriented" and not maps:
            weight *= STATIC
        apt = row.aptness(view.facts) > 0
        kept = {k: kind for k, kind in maps.items() if not row.has_static or kind in _WITHOUT_SIGN}
        recipe = row.trial(view.facts).mapped(**kept)
        seconds = row.seconds(view.facts, recipe)
        yield Option(row.name, weight, partial(_first, view, row, recipe), seconds, apt)


def _first(
    view: AgentView, row: Family, recipe: Recipe | None = None, title: str = ""
) -> Proposal | None:
    recipe = recipe or row.trial(view.facts)
    if not is_new(view, row, recipe):
        return None
    sentence = f"{_sentence(row.label)}: {row.use}."
    return Proposal(
        source=under_protocol(recipe, row, view.facts).source(sentence),
        family=row.name,
        title=title or row.label,
        hypothesis=sentence,
        expected="A first V of this family, to compare it with the others.",
    )


def _wished(view: AgentView, wish: Wish, unwanted: set[str]) -> Proposal | None:
    """A candidate that a note asks for: a family's first or its best move, or the effect on the
    best trial that can have it, then in a new family."""
    if wish.effect == "family":
        found = [*refinements(view), *untried(view)]
        return _heaviest([option for option in found if option.family == wish.name])
    for at in situations(view):
        if at.row.name not in unwanted:
            made = (moved(at, move) for move in wished_moves(wish, at, all_moves()))
            proposal = next((p for p in made if p is not None), None)
            if proposal is not None:
                return proposal
    for row in families(view.facts):
        recipe = wished_start(wish, row, row.trial(view.facts))
        if row.name not in unwanted and recipe is not None:
            proposal = _first(view, row, recipe, f"{row.label}: {wish.effect}")
            if proposal is not None:
                return proposal
    return None


def refinements(view: AgentView) -> Iterator[Option]:
    """Every applicable move on the best trial of each family, on the last one of a family that
    only failed. A move that was made before and did not help counts less. A family that the
    records speak against is refined only while it leads; while nothing beats the mean, moves that
    vary a model are not made."""
    lost, answer = beats_nothing(view), answers(view)
    for at in situations(view):
        if at.place > 0 and at.row.doubtful(view.facts):
            continue
        share = _share(at)
        for move in all_moves():
            if not move.applies(at) or (lost and not keeps_course(move)):
                continue
            weight = move.weight(at) * (share if move.behind_counts else 1.0)
            if weight > 0 and _is_close(at):
                weight = max(weight, answer.get(move.name, 0.0) * (1.0 if at.place == 0 else share))
            if weight > 0:
                title = move.title(at)
                made = [t for t in view.proposed if plain_title(t.title) == title]
                weight *= move.fade ** sum(isinstance(t, Running) or not t.improved for t in made)
                sure = weight >= SURE
                recipe = at.recipe if move.same_effort else move.change(at)
                seconds = at.row.seconds(at.facts, recipe)
                make = partial(moved, at, move)
                yield Option(at.row.name, weight, make, seconds, sure=sure, move=move.name)


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
        # Where the linear model was as good, nothing is known of the family.
        recipe = None if trial.variant == LINEAR else read_recipe(trial.source)
        if recipe is not None and recipe.family not in chosen:
            chosen[recipe.family] = trial, recipe
    for place, (trial, recipe) in enumerate(chosen.values()):
        row = family(recipe.family)
        if row is not None:
            yield Situation(view, trial, recipe, row, place, len(chosen))


def _share(at: Situation) -> float:
    """Return the share of a family in the search: 1 for the leading family, less for one that is
    behind.

    A grey-box within a factor of four of a leader without equations counts as leading: its missing
    terms can still be added. A model that overfits its own fold only needs regularisation, and
    keeps most of its weight while it is not too far behind; against a leader with equations that is
    seldom enough. In both cases each unsuccessful move reduces the share.
    """
    trial, best, train = at.trial, at.view.best, at.trial.train_error
    if at.place == 0 or best is None or best.value is None:
        return 1.0
    if trial.value is None or train is None:
        return BEHIND
    ratio = best.value / trial.value
    leader = family(best.family)
    black_box = leader is None or "physics" not in leader.needs
    if at.row.extendable and ratio > NEAR and black_box:
        return 1.0
    own = (t for t in at.view.trials if t.family == at.recipe.family)
    patience = PATIENCE ** sum(t.parent is not None and not t.improved for t in own)
    share = BEHIND * ratio**2
    near = NEAR if black_box else NEAR_EQUATIONS
    held_back = ratio > near and train < best.value and overfit(trial) > 2.0
    return patience * (max(share, PROMISING) if held_back else share)


def _is_close(at: Situation) -> bool:
    """Return whether V of the family is within 1.5 times the best one."""
    best, value = at.view.best, at.trial.value
    if best is None or best.value is None or value is None:
        return False
    return value <= CLOSE * best.value


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]
