"""Data of the pictures that compare several searches. No matplotlib here: a comparison builds
these.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from asia.data.trajectory import Array


@dataclass(frozen=True)
class Curve:
    """V of each experiment of one search, in order; None without a score."""

    values: tuple[float | None, ...]

    def best_so_far(self, length: int) -> Array:
        """(length,); NaN before the first score, the last value again after the end."""
        values = [np.nan if v is None else v for v in self.values]
        padded = np.array(values + [np.nan] * (length - len(values)))
        return np.fmin.accumulate(padded)


@dataclass(frozen=True)
class ArmCurves:
    """One side of the comparison with a curve for each seed."""

    label: str
    curves: tuple[Curve, ...]


@dataclass(frozen=True)
class ComparedValue:
    """A V to compare searches with."""

    label: str
    """Name of the agent."""
    value: float
    """V."""


@dataclass(frozen=True)
class ArmsPicture:
    """Searches against each other; `name` of the file, `metric` `rmse` or `mae`."""

    name: str
    title: str
    sides: tuple[ArmCurves, ...]
    levels: tuple[ComparedValue, ...]
    metric: str


@dataclass(frozen=True)
class PublishedMee:
    """Published Mean Euclidean Errors of one model: (output group, samples, error)."""

    model: str
    errors: tuple[tuple[str, int, float], ...]


@dataclass(frozen=True)
class BenchPictures:
    """All pictures of a comparison.

    Attributes:
        progress: file name and run directory.
        opened: run whose sealed test was opened.
        test_mark: published test error to mark next to ours.
        caption: protocol of the published Mean Euclidean Errors.
    """

    progress: tuple[tuple[str, Path], ...]
    sides: tuple[ArmsPicture, ...]
    opened: Path | None = None
    test_mark: tuple[str, float] | None = None
    mee: tuple[PublishedMee, ...] = ()
    caption: str = ""
