"""A move: a change to a trial's recipe, when it is worth making, and why."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from asia.agents.library.family import Family
from asia.agents.view import AgentView, Facts, Trial
from asia.problem.physics import Physics
from asia.problem.physics_text import read_physics
from asia.recipe import Recipe

POSSIBLE, LIKELY, SHOWN = 1, 2, 3
"""Evidence for an effect. POSSIBLE: the model can have it. LIKELY: the residual or the form of the
model points at it. SHOWN: the records show it."""


@dataclass(frozen=True)
class Situation:
    """Situation that a move decides from."""

    view: AgentView
    trial: Trial
    """The trial that the move would start from."""
    recipe: Recipe
    """The configuration of that trial."""
    row: Family
    """The family of that trial."""
    place: int
    """The place of the family among those tried; 0 leads."""

    @property
    def facts(self) -> Facts:
        """The problem."""
        return self.view.facts

    @property
    def physics(self) -> Physics | None:
        """Equations of the candidate: its own, or the problem's."""
        own = self.recipe.get("physics")
        return read_physics(str(own[0])) if isinstance(own, tuple) and own else self.facts.physics

    @property
    def states(self) -> tuple[str, ...]:
        """States of these equations."""
        return self.physics.states if self.physics else ()

    def varies(self, name: str) -> bool:
        """Return whether the library lets the setting be varied in this family."""
        return self.row.space(self.facts).find(name) is not None


@dataclass(frozen=True)
class Move:
    """A change of one kind: the effect that it adds, and why."""

    name: str
    """Title of the change. `{state}` in it is the state that the move acts on."""
    evidence: Callable[[Situation], int]
    """POSSIBLE, LIKELY, SHOWN, or 0 where it does not apply."""
    change: Callable[[Situation], Recipe]
    hypothesis: str
    """Reason why it should help."""
    expected: str
    """Expected observation if it does."""
    families: tuple[str, ...] = ()
    """Families of the move. () is all families of the card, or all families when it is on none."""
    state: Callable[[Situation], str] = lambda _: ""
    """The state for the name."""
    after: Literal["score", "failure"] = "score"
    """Made on the best trial of a family, or on one of a family that only failed."""

    def applies(self, at: Situation) -> bool:
        """Return whether the family and the outcome are of the move's kind."""
        known = not self.families or at.recipe.family in self.families
        return known and (at.trial.value is None) == (self.after == "failure")

    def title(self, at: Situation) -> str:
        """Family and name, with the state filled in."""
        return f"{at.row.label}: {self.name.format(state=self.state(at))}"


def title_of(at: Situation, move: Move, recipe: Recipe) -> str:
    """Return the move's own title; if it was used already, add the changed settings: `neural
    state-space: one state more (order 3 to 4)`."""
    plain = move.title(at)
    used = {known.title for known in at.view.proposed}
    if plain not in used:
        return plain
    before, after = at.recipe, recipe
    both = (*before.config, *before.options, *before.maps)
    names = dict((*both, *after.config, *after.options, *after.maps))
    pairs = [(name, before.get(name), after.get(name)) for name in names]
    changes = [f"{name} {_value(a)} to {_value(b)}" for name, a, b in pairs if a != b]
    if before.method != after.method:
        changes.insert(0, f"{before.method} to {after.method}")
    # As many of the changes as there is room for, and the parent where an earlier trial has the
    # same changes.
    parent = f"from #{at.trial.number:02d}"
    for words in ([], [parent]):
        for change in changes:
            if len(f"{plain} ({', '.join([*words, change])})") <= 80:
                words.append(change)
        title = f"{plain} ({', '.join(words)})"
        if words and title not in used:
            return title
    return f"{plain} ({parent})"[:80]


def plain_title(title: str) -> str:
    """Remove the additions from the title of a repeated move."""
    return re.sub(r" \([^()]*\)$", "", title)


def is_titled(name: str, title: str) -> bool:
    """Return whether a title without its family is that of a move of this name, for any state."""
    before, filled, after = name.partition("{state}")
    if not filled:
        return title == name
    return title.startswith(before) and title.endswith(after)


def _value(value: object) -> str:
    """A setting's value, without brackets; `none` where it is not set."""
    if isinstance(value, float):
        return f"{value:.2g}"
    if isinstance(value, tuple):
        return "-".join(str(v) for v in value) or "none"  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    text = str(value).replace("(", "").replace(")", "")
    return "none" if value is None else text


@dataclass(frozen=True)
class Card:
    """Families of one kind and the moves that refine them."""

    families: tuple[Family, ...]
    moves: tuple[Move, ...] = ()
    """Moves on these families alone; on all of them where a move names none."""

    def own_moves(self) -> tuple[Move, ...]:
        """The moves, each with the families it is made on."""
        names = tuple(family.name for family in self.families)
        return tuple(replace(move, families=move.families or names) for move in self.moves)
