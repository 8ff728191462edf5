"""What a move is: a change to a trial's recipe, when it is worth making, and why."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from asia.agents._view import AgentView, Facts, Trial
from asia.agents.library.family import Family
from asia.agents.library.recipe import Recipe


@dataclass(frozen=True)
class Case:
    """What a move decides from: the search, the trial it would start from, that trial's recipe and
    family, and the place of the family among those tried (0 leads)."""

    view: AgentView
    trial: Trial
    recipe: Recipe
    row: Family
    place: int
    families: int

    @property
    def facts(self) -> Facts:
        """The problem."""
        return self.view.facts

    @property
    def states(self) -> tuple[str, ...]:
        """States of the person's equations."""
        return self.facts.physics.states if self.facts.physics else ()

    @property
    def in_best_third(self) -> bool:
        """Whether the family is among the best third of those tried, the leader always."""
        return 3 * self.place < self.families

    @property
    def behind(self) -> float:
        """V over the best V; 1 without a score."""
        best = self.view.best
        if best is None or not best.value or self.trial.value is None:
            return 1.0
        return self.trial.value / best.value

    def varies(self, name: str) -> bool:
        """Whether the library lets the setting be varied in this family."""
        return self.row.space(self.facts).find(name) is not None


@dataclass(frozen=True)
class Move:
    """families: where it can be made, () for all. weight: how promising it is on a case, 0 when it
    does not apply; 0.9 and more is near certain. `{state}` in the name is the state it acts on.

    after: made on the best trial of a family, or on one of a family that only failed.
    behind_counts: whether the weight shrinks with the distance to the leading family. fade:
    what is left of the weight after each time it did not help.
    """

    name: str
    families: tuple[str, ...]
    weight: Callable[[Case], float]
    change: Callable[[Case], Recipe]
    hypothesis: str
    expected: str
    state: Callable[[Case], str] = lambda _: ""
    after: Literal["score", "failure"] = "score"
    behind_counts: bool = True
    fade: float = 0.4

    def applies(self, case: Case) -> bool:
        """Whether the family and the outcome are of the move's kind."""
        known = not self.families or case.recipe.family in self.families
        return known and (case.trial.value is None) == (self.after == "failure")

    def title(self, case: Case) -> str:
        """Family and name, with the state filled in."""
        return f"{case.row.label}: {self.name.format(state=self.state(case))}"
