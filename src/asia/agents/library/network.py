"""Rows of networks trained by Adam: a short fit first, a long one when it is promising."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from asia.agents.library.cost import SampleCost, Stage, Timing
from asia.agents.library.family import Family
from asia.agents.library.methods import adam, by_lbfgs, by_multiple_shooting, network_space
from asia.agents.library.recipe import MODELS, Arguments, Recipe
from asia.agents.library.space import OneOf, Parameter, Space
from asia.agents.library.traits import Trait
from asia.agents.view import Facts

STEP_BY_STEP = (by_lbfgs, by_multiple_shooting)
"""Methods for networks that step through time: multiple shooting can set their state."""
WHOLE_RECORD = (by_lbfgs,)
"""Methods for networks that map a whole record at once."""
_SMALL_STEPS = ("steps", 5)


@dataclass(frozen=True)
class NetworkStart:
    """Initial settings for a kind of network."""

    config: Arguments
    """Settings of the first configuration."""
    rate: float
    """Learning rate of its fit."""
    cost: SampleCost
    """Cost of a sample."""
    vary: tuple[Parameter, ...]
    """Search space besides the settings of Adam and the functions of the inputs."""
    teacher: float | None = None
    """Initial rate of teacher forcing; None where the model feeds back no output."""


def network_family(
    name: str,
    label: str,
    use: str,
    base: float,
    points: tuple[tuple[Trait, float], ...],
    start: NetworkStart | Callable[[Facts], NetworkStart],
    methods: tuple[Callable[[Facts, Recipe], Recipe], ...],
    small: Arguments,
    needs: frozenset[Trait] = frozenset(),
    package: str = MODELS,
    timing: Timing | None = None,
) -> Family:
    """The row of a network.

    Args:
        small: the sizes for tests; the steps of the fit are added
    """

    def start_for(facts: Facts) -> NetworkStart:
        return start if isinstance(start, NetworkStart) else start(facts)

    def recipe(stage: Stage) -> Callable[[Facts], Recipe]:
        def found(facts: Facts) -> Recipe:
            own = start_for(facts)
            recipe = Recipe(name, own.config, "Adam", adam(facts, own.cost, stage, own.rate))
            return recipe.trained(teacher=own.teacher) if own.teacher else recipe

        return found

    def space(facts: Facts) -> Space:
        own = start_for(facts)
        found = network_space(facts, own.cost, own.vary)
        return _for_structure(found, by_multiple_shooting in methods, own.teacher is not None)

    return Family(
        name=name,
        label=label,
        use=use,
        base=base,
        points=points,
        needs=needs,
        start=recipe("trial"),
        longer=recipe("full"),
        space=space,
        small=(*small, _SMALL_STEPS),
        timing=timing or Timing(),
        methods=methods,
        seeds=True,
        package=package,
    )


def _for_structure(space: Space, state: bool, feedback: bool) -> Space:
    """Only settings that the structure takes.

    Args:
        state: it has one, to be carried from one chunk to the next
        feedback: of its own output
    """
    options = tuple(p for p in space.options if state or p.name != "carry")
    teacher = (OneOf("teacher", (0.0, 0.3, 1.0)), OneOf("teacher_end", (0.0,)))
    return replace(space, options=(*options, *(teacher if feedback else ())))
