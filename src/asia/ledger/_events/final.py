"""The models that a search ends with, and how they were compared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Use = Literal["ensemble", "refit", "stack"]


@dataclass(frozen=True)
class RefitStart:
    """One fit of the winner to all training records, compared with the fold models."""

    error: float | None
    """Its error on the training records, in the metric of V; None where it gives no answer."""
    disagreement: float | None
    """Root mean square of its difference from the ensemble there, over the standard deviation of
    the output, mean over the outputs; None where one of the two gives no answer."""
    objection: str = ""
    """Why it is not used; "" where nothing speaks against it."""


@dataclass(frozen=True)
class RefitCheck:
    """Errors of the fold models and of each start of the refit on the training records."""

    fold_errors: tuple[float | None, ...]
    """The error of each fold model, in the metric of V; None where it gives no answer."""
    ensemble_error: float | None
    """The error of the mean of their answers; None where one gives none."""
    fold_disagreement: float | None
    """Root mean square of the difference of a fold model from the mean of the others, over the
    standard deviation of the output, mean over fold models and outputs; None where one gives no
    answer, or where there is one fold."""
    starts: tuple[RefitStart, ...]
    """The fits, one a seed."""
    kept: int | None = None
    """The start that is the refit, 1-based; None where there is no refit."""


@dataclass(frozen=True)
class StackMember:
    """The ensemble of the fold models of an experiment, as a part of a stack."""

    experiment: int
    """1-based."""
    weight: float
    """The share of its simulation; those of all members add up to 1."""


@dataclass(frozen=True)
class Stack:
    """A weighted mean of the ensembles of several experiments."""

    members: tuple[StackMember, ...]
    """The largest weight first."""
    value: float
    """V by nested cross-validation: each fold is judged with weights chosen on the other folds."""
    folds: tuple[float, ...]
    """The part of each fold in it."""
