"""The default agent: an engineer's habits, deterministic, no language model.

Explore: one configuration of each family that suits the problem, the cheapest insight first.
Refine: of all moves on the best trials of the best families, the one with the most weight.
"""

from __future__ import annotations

from dataclasses import dataclass

from asia.agents._evidence import overfit
from asia.agents._library import Family, families, family
from asia.agents._moves import MOVES, Case, Move
from asia.agents._recipe import Recipe, read_recipe
from asia.agents._view import AgentView, Proposal, Trial

REPEAT = 0.4
BEHIND = 0.5
UNTRIED = 0.3
NEAR = 0.25
PROMISING = 0.75


@dataclass(frozen=True)
class _Option:
    weight: float
    proposal: Proposal


class ExpertAgent:
    """Ladder of families, then refinement by moves chosen from training-side evidence."""

    @property
    def name(self) -> str:
        """`expert`."""
        return "expert"

    def propose(self, view: AgentView) -> Proposal | None:
        """The next rung of the ladder, or the move with the most weight; None when all known."""
        if view.phase == "explore":
            rung = self._rung(view)
            if rung is not None:
                return rung
        options = [*_refinements(view), *_untried(view)]
        if not options:
            return None
        return max(options, key=lambda o: o.weight).proposal

    def _rung(self, view: AgentView) -> Proposal | None:
        return next((o.proposal for o in _untried(view)), None)


def _untried(view: AgentView) -> list[_Option]:
    """First configurations of families that no trial has used, in the library's order."""
    used = {t.family for t in view.trials}
    rows = [row for row in families(view.facts) if row.name not in used]
    options: list[_Option] = []
    for row in rows:
        proposal = _first(row, view)
        if not view.is_known(proposal.source):
            options.append(_Option(UNTRIED, proposal))
    return options


def _first(row: Family, view: AgentView) -> Proposal:
    recipe = row.start(view.facts)
    return Proposal(
        source=recipe.source(f"{_sentence(row.label)}: {row.use}."),
        family=row.name,
        title=row.label,
        hypothesis=f"{_sentence(row.label)}: {row.use}.",
        expected="A first value for this family, to compare with the others.",
    )


def _refinements(view: AgentView) -> list[_Option]:
    """Every applicable move on the best trial of each family."""
    options: list[_Option] = []
    seen: set[str] = set()
    best = view.best
    for trial in view.ranked:
        recipe = read_recipe(trial.source)
        if recipe is None or recipe.family in seen or best is None:
            continue
        seen.add(recipe.family)
        share = _share(trial, best, leader=len(seen) == 1)
        for move in MOVES:
            option = _option(view, Case(view.facts, trial, recipe), move, share)
            if option is not None:
                options.append(option)
    return options


def _share(trial: Trial, best: Trial, *, leader: bool) -> float:
    """1 for the leading family, less the further another is behind.

    A grey-box within a factor of four counts as leading: what its equations lack can still be
    added. A model that knows its own fold better than the leader knows the others' has only to be
    held back.
    """
    train = trial.train_error
    if leader or trial.value is None or best.value is None or train is None:
        return 1.0
    ratio = best.value / trial.value
    if trial.family == "greybox" and ratio > NEAR:
        return 1.0
    share = BEHIND * ratio**2
    return max(share, PROMISING) if train < best.value and overfit(trial) > 2.0 else share


def _option(view: AgentView, case: Case, move: Move, share: float) -> _Option | None:
    if case.recipe.family not in move.families:
        return None
    weight = share * move.weight(case)
    if weight <= 0:
        return None
    recipe = move.change(case)
    row = family(case.recipe.family)
    label = row.label if row else case.recipe.family
    source = recipe.source(_summary(label, recipe))
    if view.is_known(source):
        return None
    title = f"{label}: {move.title(case)}"
    before = [t for t in view.trials if t.title == title and t.status != "keep"]
    proposal = Proposal(
        source=source,
        family=case.recipe.family,
        title=title,
        hypothesis=move.hypothesis,
        expected=move.expected,
        parent=case.trial.number,
    )
    return _Option(weight * REPEAT ** len(before), proposal)


def _summary(label: str, recipe: Recipe) -> str:
    settings = ", ".join(f"{k} {v}" for k, v in recipe.config) or "plain"
    return f"{_sentence(label)}: {settings}."


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]
