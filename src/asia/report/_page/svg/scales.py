"""Scales from numbers to positions in a drawing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Scale:
    """A linear or logarithmic axis."""

    low: float
    """The number at `start`."""
    high: float
    """The number at `end`."""
    start: float
    """Value at the start of the axis."""
    end: float
    """Value at the end of the axis."""
    log: bool = False
    """True for a logarithmic scale."""

    def at(self, value: float) -> float:
        """The place of a number, kept within the axis."""
        low, high, here = self.low, self.high, min(max(value, self.low), self.high)
        if self.log:
            low, high, here = math.log(low), math.log(high), math.log(here)
        share = (here - low) / (high - low) if high > low else 0.5
        return self.start + share * (self.end - self.start)

    def ticks(self, most: int = 6) -> list[float]:
        """Round numbers within the axis."""
        return _powers(self.low, self.high) if self.log else _steps(self.low, self.high, most)


def _steps(low: float, high: float, most: int) -> list[float]:
    span = high - low
    if not span > 0:
        return [low]
    rough = span / most
    unit = 10.0 ** math.floor(math.log10(rough))
    step = next(unit * k for k in (1, 2, 5, 10) if unit * k >= rough)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 12) + 0.0 for k in range(first, math.floor(high / step + 1e-9) + 1)]


def _powers(low: float, high: float) -> list[float]:
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for marks in ((1, 2, 5), (1, 3), (1,)):
        found = [m * 10.0**d for d in decades for m in marks if low <= m * 10.0**d <= high]
        if len(found) <= 7:
            break
    return found or [low, high]


def written(value: float) -> str:
    """A tick's number."""
    return f"{value:.6g}".replace("-", "−")


def rounded(value: float) -> str:
    """A coordinate."""
    return f"{value:.1f}".removesuffix(".0")


def thinned(values: Sequence[float], columns: int) -> list[tuple[int, float]]:
    """(index, value): all of a short record; of a long one the least and the greatest of each
    column."""
    count = len(values)
    if count <= 2 * columns:
        return list(enumerate(values))
    found: list[tuple[int, float]] = []
    for k in range(columns):
        first, last = k * count // columns, (k + 1) * count // columns
        part = range(first, last)
        ends = {min(part, key=values.__getitem__), max(part, key=values.__getitem__)}
        found += [(i, values[i]) for i in sorted(ends)]
    return found
