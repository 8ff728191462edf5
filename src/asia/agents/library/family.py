"""A model family as the built-in agents know it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

from asia.agents.library.space import Space
from asia.agents.library.traits import Trait, traits
from asia.agents.view import AgentView, Facts
from asia.recipe import GRADIENT, MODELS, Arguments, Recipe, read_recipe

SampleCost = Literal["light", "medium", "heavy"]
Stage = Literal["trial", "full"]

# Costs are estimated from sizes and constants of an ordinary core, never from a clock: the same
# problem gives the same candidates everywhere.

# Seconds, forward and backward: of one sample in a batch by cost, and of one step in time.
_SAMPLE: dict[SampleCost, float] = {"light": 6e-7, "medium": 2e-6, "heavy": 4e-6}
_TICK = 5e-6
# Share of the time a fit may take, most seconds, most updates.
_EFFORT: dict[Stage, tuple[float, float, int]] = {
    "trial": (0.1, 12.0, 2500),
    "full": (0.4, 60.0, 8000),
}
FEWEST_STEPS = 200
GENTLE_STEPS = 400
CHUNK = 128
_BATCH = 128
_USUAL_SIZE = 16.0


@dataclass(frozen=True)
class Timing:
    """Seconds of one fold's fit on an ordinary core. Fitted to recorded searches by
    `benchmarks/models/cost.py`."""

    start: float = 2.0
    """Seconds of every fit for imports, tracing and compilation."""
    unit: float = 1e-6
    """Seconds for each simulated sample at the usual size of a model."""


def work(facts: Facts, recipe: Recipe) -> float:
    """Samples that a fit simulates, all its steps and repetitions together, times the size of the
    model over the usual one; at least half of it counts whatever the size."""
    rounds = recipe.number("steps", 1.0) * recipe.number("iterations", 1.0)
    if recipe.get("noise_model") == "slow" and not recipe.has("steps"):
        # Fits of few parameters are repeated after each estimate of the noise model.
        rounds *= 2.0
    samples = float(facts.fit_samples)
    if recipe.method == "Adam":
        length = recipe.number("truncation", facts.horizon or facts.fit_samples)
        samples = min(samples, recipe.number("batch", _BATCH) * length)
    repeats = max(1.0, recipe.number("starts", 1.0)) * max(1.0, recipe.number("members", 1.0))
    sizes = ("hidden", "width", "units", "states", "slow", "residual")
    size = max(recipe.number(name, 0.0) for name in sizes)
    return rounds * samples * repeats * (0.5 + 0.5 * (size or _USUAL_SIZE) / _USUAL_SIZE)


def steps(facts: Facts, cost: SampleCost, stage: Stage) -> int:
    """Updates that a fit of this cost may take."""
    share, most_seconds, most = _EFFORT[stage]
    seconds = min(share * facts.budget.fit_seconds, most_seconds)
    length = facts.horizon or CHUNK
    samples = min(facts.fit_samples, _BATCH * length)
    found = seconds / (samples * _SAMPLE[cost] + length * _TICK)
    return int(float(f"{max(FEWEST_STEPS, min(most, round(found))):.2g}"))


@dataclass(frozen=True)
class Path:
    """Values of a setting from stiff to free. Where a recipe leaves it open, a search chooses, see
    `asia.search.fair_trial`."""

    name: str
    values: tuple[float, ...]
    needs: str = ""
    """Setting without which it means nothing."""

    def is_open(self, recipe: Recipe) -> bool:
        """Return whether the recipe leaves the setting open."""
        return not recipe.has(self.name) and bool(not self.needs or recipe.get(self.needs))


Kind = Literal["equations", "classical", "network"]
_KINDS: tuple[Kind, ...] = ("equations", "classical", "network")


@dataclass(frozen=True)
class Family:
    """Model family: its use, its first recipe and its search space."""

    name: str
    """Module in `package`, which has `Config`, `build` and `train`."""
    label: str
    """Name for users."""
    use: str
    """Use of the family, in the words of the docs."""
    base: float
    """Aptness for any problem; the built-in families have 1 to 10."""
    start: Callable[[Facts], Recipe]
    """A first configuration, cheap to fit."""
    space: Callable[[Facts], Space]
    small: Arguments
    """Settings of the first configuration that make it fit in seconds, for tests."""
    timing: Timing = field(default_factory=Timing)
    """Cost of a fit; the default is for a family without measured costs."""
    path: Path | None = None
    """Setting of the model that decides how far it may go from its start; None for a family
    without."""
    longer: Callable[[Facts], Recipe] | None = None
    """The first configuration with a long fit; None where the first fit is cheap anyway."""
    points: tuple[tuple[Trait, float], ...] = ()
    """Points that each trait of the problem adds to `base`."""
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
    has_static: bool = False
    """Whether it has static functions of its inputs and outputs inside. Its fits through a second
    one were worse, so its first trial takes over none that leads in another family, except a sensor
    without sign."""
    settle: Callable[[Facts, Recipe], Recipe] | None = None
    """Last changes of a random draw."""
    extendable: bool = False
    """Whether moves can add missing effects, so that it leads although a black box is better."""
    stopped_by_score: frozenset[str] = frozenset()
    """Methods, besides the gradient methods, that can stop by the score on the held-out part."""
    irregular: bool = False
    """Whether it can use records that are not sampled regularly."""
    intersample: bool = False
    """Whether it is in continuous time: its setting `intersample` is the behaviour of the inputs
    between samples, which a search chooses where a recipe leaves it open."""
    feedback: bool = False
    """Whether it has methods for records from a closed loop. Others fit biased gains to them, which
    V does not show."""
    package: str = MODELS
    """The package that candidates import it from."""

    @property
    def kind(self) -> Kind:
        """Kind of the family: built on the problem's equations, of few parameters, or a network."""
        return (
            "equations"
            if self.needs & {"physics", "plant"}
            else "network"
            if self.seeds
            else "classical"
        )

    @property
    def place(self) -> tuple[int, float, float, str]:
        """Sort key among equally apt families: the kinds in the order above, the higher base, the
        larger gain from a single trait."""
        gain = max((points for _, points in self.points), default=0.0)
        return _KINDS.index(self.kind), -self.base, -gain, self.name

    def trial(self, facts: Facts) -> Recipe:
        """The first configuration."""
        return self._own(self.start(facts))

    def full(self, facts: Facts) -> Recipe:
        """Return the first configuration at the cost of a long fit."""
        return self._own((self.longer or self.start)(facts))

    def smallest(self, facts: Facts) -> Recipe:
        """The first configuration at the size of tests.

        Raises:
            KeyError: for a setting in `small` that it does not name
        """
        return self.trial(facts).changed(**dict(self.small))

    def suits(self, facts: Facts) -> bool:
        """Return whether the family can be used on the problem at all."""
        found = traits(facts)
        sampled = self.irregular or "irregular" not in found
        # Equations of the user's own are tried all the same.
        unbiased = self.feedback or "feedback" not in found or self.kind == "equations"
        return self.needs <= found and not self.unfit & found and sampled and unbiased

    def aptness(self, facts: Facts) -> float:
        """The base and the points of the problem's traits."""
        found = traits(facts)
        points = sum(points for trait, points in self.points if trait in found)
        return self.base + points - 3.0 * bool(self.against & found)

    def doubtful(self, facts: Facts) -> bool:
        """Return whether a trait of the problem speaks against the family."""
        return bool(self.against & traits(facts))

    def seconds(self, facts: Facts, recipe: Recipe) -> float:
        """Expected seconds of one fold's fit."""
        return self.timing.start + self.timing.unit * work(facts, recipe)

    def _own(self, recipe: Recipe) -> Recipe:
        return replace(recipe, family=self.name, package=self.package)


def under_protocol(recipe: Recipe, row: Family, facts: Facts) -> Recipe:
    """Adapt a recipe to the protocol: with `early_stopping = "validation"` a fit that can stops by
    the held-out part; otherwise the recipe is unchanged."""
    if facts.early_stopping != "validation":
        return recipe
    if recipe.method in row.stopped_by_score:
        return recipe.trained(stop="validation")
    if recipe.method not in GRADIENT:
        return recipe
    # The paper's early stopping: a check every 25 updates, 20 without improvement.
    return recipe.trained(stop="validation", every=25, patience=20)


def is_new(view: AgentView, row: Family, recipe: Recipe) -> bool:
    """Return whether no proposal has the configuration, regardless of the order of its settings."""
    recipe = under_protocol(recipe, row, view.facts)
    tried = (read_recipe(known.source) for known in view.proposed)
    if any(other is not None and other.key == recipe.key for other in tried):
        return False
    return not view.is_known(recipe.source(""))
