"""Search space of recipes, and recipes under a protocol."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from asia.recipe import Recipe, Value


@dataclass(frozen=True)
class Span:
    """A number between two limits."""

    name: str
    low: float
    high: float
    log: bool = True
    """Whether it is drawn evenly in the logarithm."""
    whole: bool = False
    needs: str = ""
    """A setting without which it has no meaning: while that is absent, false or zero."""
    being: Value = None
    """The value that `needs` must have; None for any that is not false."""

    def tidy(self, number: float) -> int | float:
        """Two significant digits, or a whole number, inside the range."""
        if self.whole:
            return min(max(round(number), round(self.low)), round(self.high))
        return min(max(float(f"{number:.2g}"), self.low), self.high)

    def draw(self, rng: np.random.Generator) -> Value:
        """A number with even chance."""
        low, high = (self.low, self.high + self.whole * 0.999)
        if self.log:
            number = math.exp(rng.uniform(math.log(low), math.log(high)))
        else:
            number = rng.uniform(low, high)
        return self.tidy(math.floor(number) if self.whole else number)


@dataclass(frozen=True)
class OneOf:
    """One of a list of values."""

    name: str
    values: tuple[Value, ...]
    needs: str = ""
    """Condition, as in `Span`."""
    being: Value = None
    """Value of the condition, as in `Span`."""

    def draw(self, rng: np.random.Generator) -> Value:
        """A value with even chance."""
        return self.values[int(rng.integers(len(self.values)))]


Parameter = Span | OneOf


@dataclass(frozen=True)
class Space:
    """Search space of a recipe."""

    config: tuple[Parameter, ...]
    """Parameters of the model."""
    options: tuple[Parameter, ...]
    """Parameters of the training method."""

    def find(self, name: str) -> Parameter | None:
        """A parameter by name."""
        return next((p for p in (*self.config, *self.options) if p.name == name), None)

    def opened(self, before: Recipe, after: Recipe) -> Space:
        """Return the part of the space that applies in `after` only."""

        def new(parameters: tuple[Parameter, ...]) -> tuple[Parameter, ...]:
            return tuple(p for p in parameters if applies(p, after) and not applies(p, before))

        return Space(new(self.config), new(self.options))

    def spans(self, recipe: Recipe) -> tuple[Span, ...]:
        """The numbers that the recipe names and that have a meaning in it."""
        return tuple(
            p
            for p in (*self.config, *self.options)
            if isinstance(p, Span) and applies(p, recipe) and recipe.number(p.name, 0.0) > 0
        )


def draw(rng: np.random.Generator, recipe: Recipe, space: Space) -> Recipe:
    """The recipe with everything in the space drawn anew."""
    for parameter in space.config:
        if applies(parameter, recipe):
            recipe = recipe.configured(**{parameter.name: parameter.draw(rng)})
    for parameter in space.options:
        if applies(parameter, recipe):
            recipe = recipe.trained(**{parameter.name: parameter.draw(rng)})
    return recipe


def applies(parameter: Parameter, recipe: Recipe) -> bool:
    """Return whether the parameter has a meaning in the recipe."""
    if not parameter.needs:
        return True
    value = recipe.get(parameter.needs)
    return bool(value) if parameter.being is None else value == parameter.being
