"""Estimates of a fitted model's parameters: standard errors, intervals and correlations."""

from __future__ import annotations

from dataclasses import dataclass

from asia.data import Array


@dataclass(frozen=True)
class ParameterEstimate:
    """A parameter with its uncertainty."""

    name: str
    """Name as in `parameters()`; at most 48 characters are kept."""
    value: float
    """Estimate in the parameter's unit."""
    standard_error: float
    """Standard error in the same unit; infinite where the records carry no information on it."""
    low: float
    """Lower end of the 95 % interval."""
    high: float
    """Upper end of the 95 % interval."""
    unit: str = ""
    """Unit of the parameter; at most 16 characters are kept."""
    lower: float = float("-inf")
    """Least value that the fit searched; -inf for an open range."""
    upper: float = float("inf")
    """Greatest value that the fit searched; inf for an open range."""
    data_share: float = 1.0
    """Share of the information on the parameter that comes from the records, from 0 to 1; the rest
    comes from a prior or a ridge."""
    misfit_error: float = 0.0
    """Possible shift by a missing effect: half the width of an interval around the value; 0 where
    the residuals show no missing effect."""


@dataclass(frozen=True)
class ParameterEstimates:
    """Estimates of all parameters of a model, with their correlations."""

    parameters: tuple[ParameterEstimate, ...]
    """Estimates, one a parameter; at most 64 are kept."""
    correlation: Array
    """Correlations (n, n) of the errors; nan where one is not known."""
    equations: tuple[str, ...] = ()
    """The model's equations with the numbers put in, one a line; 8000 characters are kept."""
