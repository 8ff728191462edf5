"""A row of the library, and how rows are put in order for a problem."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from asia.agents._view import Facts
from asia.agents.library.recipe import Recipe
from asia.agents.library.space import Space
from asia.agents.library.traits import Trait, traits


@dataclass(frozen=True)
class Family:
    """A model family as the built-in agents know it.

    use: when to reach for it, in the words of the docs. base, points: how apt it is, a base and
    what each trait of the problem adds. needs, unfit: traits without which, or with which, it is
    no use. trial: a first configuration, cheap. full: the same with what a long fit may cost; the
    same function where a fit is cheap anyway. space: what may be varied. methods: training methods
    beside the trial's own. seeds: whether networks from several seeds can be averaged. settle: last
    changes of a random draw, None for none.
    """

    name: str
    label: str
    use: str
    base: float
    trial: Callable[[Facts], Recipe]
    full: Callable[[Facts], Recipe]
    space: Callable[[Facts], Space]
    points: tuple[tuple[Trait, float], ...] = ()
    needs: frozenset[Trait] = frozenset()
    unfit: frozenset[Trait] = frozenset()
    methods: tuple[str, ...] = ()
    seeds: bool = False
    settle: Callable[[Facts, Recipe], Recipe] | None = None

    def suits(self, facts: Facts) -> bool:
        """Whether the family can be used on the problem at all."""
        found = traits(facts)
        return self.needs <= found and not self.unfit & found

    def aptness(self, facts: Facts) -> float:
        """The base and the points of the problem's traits."""
        found = traits(facts)
        return self.base + sum(points for trait, points in self.points if trait in found)
