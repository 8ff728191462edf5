"""A person's equations with the ranges of their parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class ParameterRange:
    """Search range of a physical parameter; `min > 0` is searched on a log scale."""

    min: float
    max: float


@dataclass(frozen=True)
class Bounds:
    """Physical range of a state; None is open."""

    min: float | None = None
    max: float | None = None


@dataclass(frozen=True)
class Physics:
    """The person's equations. Expressions are text in the names of states, inputs, parameters,
    constants and definitions; `_expressions.py` says what they may hold."""

    states: tuple[str, ...]
    dynamics: Mapping[str, str]
    parameters: Mapping[str, ParameterRange] = field(default_factory=dict[str, ParameterRange])
    constants: Mapping[str, float] = field(default_factory=dict[str, float])
    definitions: Mapping[str, str] = field(default_factory=dict[str, str])
    observation: Mapping[str, str] = field(default_factory=dict[str, str])
    bounds: Mapping[str, Bounds] = field(default_factory=dict[str, Bounds])
