"""A model family as the built-in agents know it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

from asia.agents._view import Facts
from asia.agents.library.cost import Timing, fit_seconds
from asia.agents.library.recipe import MODELS, Arguments, Recipe
from asia.agents.library.space import Space
from asia.agents.library.traits import Trait, traits

Kind = Literal["equations", "classical", "network"]
# What a trait that speaks against a family takes from its aptness.
_AGAINST = 3.0
_KINDS: tuple[Kind, ...] = ("equations", "classical", "network")


@dataclass(frozen=True)
class Family:
    """When to use a model family, where to start with it, and what may be varied."""

    name: str
    """Its module in `package`, which has `Config`, `build` and `train`."""
    label: str
    """Its name for people."""
    use: str
    """When to reach for it, in the words of the docs."""
    base: float
    """How apt it is for any problem; the built-in families have 1 to 10."""
    start: Callable[[Facts], Recipe]
    """A first configuration, cheap to fit."""
    space: Callable[[Facts], Space]
    """What may be varied."""
    small: Arguments
    """Settings of the first configuration that make it fit in seconds, for tests."""
    timing: Timing = field(default_factory=Timing)
    """What a fit takes; the default is for a family that nobody has timed."""
    longer: Callable[[Facts], Recipe] | None = None
    """The first configuration with a long fit; None where the first fit is cheap anyway."""
    points: tuple[tuple[Trait, float], ...] = ()
    """What each trait of the problem adds to `base`."""
    needs: frozenset[Trait] = frozenset()
    """Traits without which it cannot be used."""
    unfit: frozenset[Trait] = frozenset()
    """Traits with which it is of no use."""
    against: frozenset[Trait] = frozenset()
    """Traits that speak against it: it is tried late, and refined only while it leads."""
    methods: tuple[Callable[[Facts, Recipe], Recipe], ...] = ()
    """Other ways to train it, as changes of a recipe."""
    seeds: bool = False
    """Whether it is a network, of which several seeds can be averaged."""
    settle: Callable[[Facts, Recipe], Recipe] | None = None
    """Last changes of a random draw."""
    extendable: bool = False
    """Whether moves can add what it lacks, so that it leads although a black box is better."""
    stopped_by_score: frozenset[str] = frozenset()
    """Methods, beside the gradient methods, that can stop by the score on the held-out part."""
    package: str = MODELS
    """The package that candidates import it from."""

    @property
    def kind(self) -> Kind:
        """Built on the person's equations, of few parameters, or a network."""
        return "equations" if "physics" in self.needs else "network" if self.seeds else "classical"

    @property
    def place(self) -> tuple[int, float, float, str]:
        """Its place among families that are equally apt: the kinds in the order above, the higher
        base, the larger gain from a single trait."""
        gain = max((points for _, points in self.points), default=0.0)
        return _KINDS.index(self.kind), -self.base, -gain, self.name

    def trial(self, facts: Facts) -> Recipe:
        """The first configuration."""
        return self._own(self.start(facts))

    def full(self, facts: Facts) -> Recipe:
        """The first configuration with what a long fit may cost."""
        return self._own((self.longer or self.start)(facts))

    def smallest(self, facts: Facts) -> Recipe:
        """The first configuration at the size of tests. Raises KeyError for a setting in `small`
        that it does not name."""
        return self.trial(facts).changed(**dict(self.small))

    def suits(self, facts: Facts) -> bool:
        """Whether the family can be used on the problem at all."""
        found = traits(facts)
        return self.needs <= found and not self.unfit & found

    def aptness(self, facts: Facts) -> float:
        """The base and the points of the problem's traits."""
        found = traits(facts)
        points = sum(points for trait, points in self.points if trait in found)
        return self.base + points - _AGAINST * bool(self.against & found)

    def doubtful(self, facts: Facts) -> bool:
        """Whether a trait of the problem speaks against the family."""
        return bool(self.against & traits(facts))

    def seconds(self, facts: Facts, recipe: Recipe) -> float:
        """Expected seconds of one fold's fit."""
        return fit_seconds(self.timing, facts, recipe)

    def _own(self, recipe: Recipe) -> Recipe:
        return replace(recipe, family=self.name, package=self.package)
