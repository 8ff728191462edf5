"""Equations of a problem file with the ranges of their parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

from annotated_types import MinLen


@dataclass(frozen=True)
class ParameterRange:
    """Search range of a physical parameter."""

    min: float
    """The least starting value; above 0 the range is searched on a log scale."""
    max: float
    """The largest starting value."""


@dataclass(frozen=True)
class Bounds:
    """Physical range of a state."""

    min: float | None = None
    """The least value; None is open."""
    max: float | None = None
    """The largest value; None is open."""


@dataclass(frozen=True)
class Prior:
    """Prior of a combination of parameters: a normal distribution."""

    mean: float
    """The most probable value, in the unit of the combination."""
    deviation: float
    """Standard deviation, above 0, in the same unit."""
    reason: str = ""
    """Reason for the prior, in words."""


@dataclass(frozen=True)
class Correction:
    """An unknown effect at a place in the equations, learned from the records."""

    scale: float
    """Typical size, above 0, in the unit of its equation."""


@dataclass(frozen=True)
class Physics:
    """Equations of a problem.

    Expressions are text in the names of states, inputs, parameters, constants and definitions;
    `expressions.py` lists what they may hold.
    """

    states: Annotated[tuple[str, ...], MinLen(1)]
    """Names of the states."""
    dynamics: Mapping[str, str]
    """Time derivative of every state."""
    parameters: Mapping[str, ParameterRange] = field(default_factory=dict[str, ParameterRange])
    """Ranges of the numbers that are fitted."""
    constants: Mapping[str, float] = field(default_factory=dict[str, float])
    """Known numbers."""
    definitions: Mapping[str, str] = field(default_factory=dict[str, str])
    """Named intermediate expressions."""
    observation: Mapping[str, str] = field(default_factory=dict[str, str])
    """Outputs from states; default: the state of the same name."""
    bounds: Mapping[str, Bounds] = field(default_factory=dict[str, Bounds])
    """Physical ranges of states, which the simulator keeps to."""
    priors: Mapping[str, Prior] = field(default_factory=dict[str, Prior])
    """Priors of parameters, by an expression in them and in constants."""
    corrections: Mapping[str, Correction] = field(default_factory=dict[str, Correction])
    """Names in the equations that represent unknown effects: 0 until a model learns them."""
