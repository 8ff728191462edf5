"""A move: a change to a trial's recipe, when it is worth making, and why."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from asia.agents.library.family import Family
from asia.agents.library.recipe import Recipe
from asia.agents.view import AgentView, Facts, Trial


@dataclass(frozen=True)
class Situation:
    """Situation that a move decides from."""

    view: AgentView
    """The search so far."""
    trial: Trial
    """The trial that the move would start from."""
    recipe: Recipe
    """The configuration of that trial."""
    row: Family
    """The family of that trial."""
    place: int
    """The place of the family among those tried; 0 leads."""
    families: int
    """The number of families tried."""

    @property
    def facts(self) -> Facts:
        """The problem."""
        return self.view.facts

    @property
    def states(self) -> tuple[str, ...]:
        """States of the problem's equations."""
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
        """Return whether the library lets the setting be varied in this family."""
        return self.row.space(self.facts).find(name) is not None


@dataclass(frozen=True)
class Move:
    """A change of one kind, with the reasons that are recorded before the outcome is known."""

    name: str
    """Title of the change. `{state}` in it is the state that the move acts on."""
    weight: Callable[[Situation], float]
    """Weight of the move; 0 where it does not apply, 0.9 and more where it is near certain."""
    change: Callable[[Situation], Recipe]
    """The new recipe."""
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
    behind_counts: bool = True
    """Whether the weight shrinks with the distance to the leading family."""
    same_effort: bool = False
    """Whether a fit takes as long as that of the trial, whatever is changed."""
    fade: float = 0.4
    """Factor of the weight after each time that the move did not help."""

    def applies(self, at: Situation) -> bool:
        """Return whether the family and the outcome are of the move's kind."""
        known = not self.families or at.recipe.family in self.families
        return known and (at.trial.value is None) == (self.after == "failure")

    def title(self, at: Situation) -> str:
        """Family and name, with the state filled in."""
        return f"{at.row.label}: {self.name.format(state=self.state(at))}"
