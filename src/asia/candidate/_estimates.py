"""What a fitted model may say of its parameters beside their values."""

from __future__ import annotations

from dataclasses import dataclass

from asia.data import Array


@dataclass(frozen=True)
class ParameterEstimate:
    """A parameter with its uncertainty."""

    name: str
    """As in `parameters()`; at most 48 characters are kept."""
    value: float
    """In its unit."""
    standard_error: float
    """In the same unit; infinite where the records say nothing of it."""
    low: float
    """Lower end of the 95 % interval."""
    high: float
    """Upper end."""
    unit: str = ""
    """Its unit; at most 16 characters are kept."""
    lower: float = float("-inf")
    """The least value that the fit looked for; infinite where it is open."""
    upper: float = float("inf")
    """The greatest one."""
    data_share: float = 1.0
    """The part of what is known of it that comes from the records, from 0 to 1; the rest is a prior
    or a ridge."""
    misfit_error: float = 0.0
    """How far a missing effect may have moved it: half the width of an interval around the value;
    0 where the residuals show no missing effect."""


@dataclass(frozen=True)
class ParameterEstimates:
    """What the records say of a model's parameters."""

    parameters: tuple[ParameterEstimate, ...]
    """At most 64 are kept."""
    correlation: Array
    """(n, n), of their errors; nan where one is not known."""
    equations: tuple[str, ...] = ()
    """The model's equations with the numbers put in, one a line; 8000 characters are kept."""
