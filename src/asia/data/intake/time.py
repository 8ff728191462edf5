"""Samples on one time grid: sampling time, jitter and gaps."""

import itertools
from dataclasses import dataclass
from math import floor, log10

import numpy as np
from numpy.typing import NDArray

from asia.data.trajectory import Array
from asia.errors import UserError

Rows = NDArray[np.int64]
"""Numbers of rows, or of places on a grid."""

JITTER = 0.01
"""Share of the sampling time by which stamps may lie off the grid and still count as on it."""


@dataclass(frozen=True)
class Clock:
    """Time grid of a record.

    Attributes:
        step: sampling time, s
        jitter: distance from the grid that 99 % of the time stamps keep, as a share of it
        coarse: whether the time stamps are rounded to a resolution that explains the jitter
    """

    step: float
    jitter: float
    coarse: bool = False

    @property
    def regular(self) -> bool:
        """Whether the samples count as taken on the grid."""
        return self.jitter < JITTER or self.coarse


def runs(timestamps: Array, where: str, first_line: int, ignore: str) -> list[slice]:
    """Split the samples where time goes back.

    Args:
        ignore: advice on reading without the time stamps

    Raises:
        UserError: for repeated time stamps, and for rows in no order
    """
    back = np.flatnonzero(np.diff(timestamps) < 0) + 1
    # Records that begin anew are longer than ten samples: else the rows are in no order.
    if back.size > 0.1 * len(timestamps):
        raise UserError(
            f"{where}, line {first_line + int(back[0])}: time goes back, as in {back.size} of "
            f"{len(timestamps)} rows: sort the rows by time, or {ignore}"
        )
    edges = [0, *back.tolist(), len(timestamps)]
    found = [slice(a, b) for a, b in itertools.pairwise(edges)]
    same = np.flatnonzero(np.diff(timestamps) == 0)
    if same.size:
        raise UserError(
            f"{where}, line {first_line + int(same[0]) + 1}: the time stamp repeats the one before "
            f"({same.size} such rows): remove rows that were written twice, write stamps with more "
            f"digits, or {ignore}"
        )
    return found


def clock(timestamps: Array) -> Clock | None:
    """Estimate the clock of increasing time stamps, gaps among them; None for fewer than three."""
    if len(timestamps) < 3:
        return None
    typical = float(np.median(np.diff(timestamps)))
    count = _count(timestamps, typical)
    step, offset = typical, 0.0
    for _ in range(3):
        step, offset = (float(v) for v in np.polyfit(count, timestamps, 1))
        count = _count(timestamps, step)
    off = np.abs(timestamps - (offset + step * count))
    resolutions = (1.0, 0.1, 0.01, 1e-3, 1e-4, 1e-5, 1e-6)
    resolution = next(
        (r for r in resolutions if np.abs(timestamps / r - np.round(timestamps / r)).max() < 1e-3),
        0.0,
    )
    # So much the slope of a line may be off, through stamps that are off by so much at worst.
    doubt = 2.0 * float(np.quantile(off, 0.99)) / float(timestamps[-1] - timestamps[0])
    step = _round(step, max(min(doubt * step, JITTER * step), 1e-9 * step))
    jitter = float(np.quantile(off, 0.99)) / step
    coarse = resolution > 0 and resolution < 0.5 * step and float(off.max()) <= 0.75 * resolution
    return Clock(step, jitter, coarse)


def _count(timestamps: Array, step: float) -> Array:
    """Number of grid steps from the first stamp to each."""
    return np.concatenate([[0.0], np.cumsum(np.maximum(np.round(np.diff(timestamps) / step), 1.0))])


def _round(step: float, tolerance: float) -> float:
    """The roundest number, or rate, within the tolerance."""

    def digits(value: float, count: int) -> float:
        return round(value, count - 1 - floor(log10(abs(value))))

    for count in range(1, 8):
        for value in (digits(step, count), 1.0 / digits(1.0 / step, count)):
            if abs(value - step) <= tolerance:
                return value
    return step


def places(timestamps: Array, step: float) -> Rows:
    """The grid index of each stamp, from 0, for stamps near the grid."""
    return _count(timestamps, step).astype(np.int64)


def segments(index: Rows) -> list[slice]:
    """Split samples into segments without gaps on the grid."""
    breaks = np.flatnonzero(np.diff(index) != 1) + 1
    edges = [0, *breaks.tolist(), len(index)]
    return [slice(a, b) for a, b in itertools.pairwise(edges)]


def held(timestamps: Array, values: Array, at: Array) -> Array:
    """The last value at or before each time, as a zero-order hold gives it: (T, n) to (K, n)."""
    last = np.searchsorted(timestamps, at + 1e-9, side="right") - 1
    return values[np.maximum(last, 0)]


def between(timestamps: Array, values: Array, at: Array) -> Array:
    """Straight lines between neighbours; NaN where a neighbour is missing: (T, n) to (K, n)."""
    return np.stack([np.interp(at, timestamps, column) for column in values.T], axis=1)
