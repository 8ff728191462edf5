"""Whether printed files simulate as ASIA does, on the training windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.data import Array, spread_of
from asia.export._model import TrainingWindow
from asia.export._target import Answers

DOUBLE, SINGLE = 1e-9, 1e-4
"""Largest differences, relative to the spread of the measured output."""


@dataclass(frozen=True)
class ParityRow:
    """One line of the table."""

    target: str
    """What was printed."""
    difference: float | None
    """Largest |difference| of an output over the standard deviation of its measured values; None
    where the files could not be run here."""
    limit: float
    """What it may be."""
    microseconds: float | None
    """For each sample."""
    bytes: int
    """Of the files."""
    note: str = ""
    """Why there is no difference, or what came of it."""

    @property
    def holds(self) -> bool:
        """Whether the files may be written."""
        return self.difference is None or self.difference <= self.limit


def parity_row(
    target: str, answers: Answers, windows: Sequence[TrainingWindow], single: bool, size: int
) -> ParityRow:
    """single: whether the model itself computes in single precision."""
    name = target if answers.variant == "double" else f"{target} {answers.variant}"
    samples = sum(len(w.u) for w in windows)
    limit = SINGLE if single or answers.single else DOUBLE
    found = difference(answers.y_hat, windows)
    return ParityRow(name, found, limit, 1e6 * answers.seconds / samples, size)


def difference(y_hat: Sequence[Array], windows: Sequence[TrainingWindow]) -> float:
    """The largest one of all windows and outputs; infinite where one is no number."""
    spread = spread_of(np.concatenate([w.y for w in windows]))
    largest = np.abs(np.concatenate([w.y_hat for w in windows])).max(axis=0)
    spread = np.where(spread > 0, spread, np.where(largest > 0, largest, 1.0))
    worst = 0.0
    for y, window in zip(y_hat, windows, strict=True):
        if y.shape != window.y_hat.shape or not np.isfinite(y).all():
            return float("inf")
        worst = max(worst, float((np.abs(y - window.y_hat) / spread).max()))
    return worst
