"""Time axes, and free places for text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from asia.data.trajectory import Array

LOGARITHMIC_CHECKS: Final = frozenset({"frequency response", "error spectrum"})
"""Validation checks whose curves have two logarithmic axes."""

# Placement of labels near their points: no two overlap, none covers a point, none leaves the frame.
# x points right, y down.


LINE = 15.0
"""Height of a line of text."""
_RISES = (8.0, 22.0, -22.0, 36.0, -36.0, 52.0, -52.0)
_RADIUS = 5.0


@dataclass(frozen=True)
class Box:
    """A rectangle that a text or a marker takes up."""

    left: float
    top: float
    right: float
    bottom: float

    def meets(self, other: Box) -> bool:
        """Return whether two boxes overlap."""
        apart = self.right < other.left or other.right < self.left
        return not (apart or self.bottom < other.top or other.bottom < self.top)

    def holds(self, other: Box) -> bool:
        """Return whether the other box is inside this one."""
        across = self.left <= other.left and other.right <= self.right
        return across and self.top <= other.top and other.bottom <= self.bottom


@dataclass(frozen=True)
class Tag:
    """A text of size (width, height) for the point `anchor`."""

    anchor: tuple[float, float]
    size: tuple[float, float]


def place(
    tags: Sequence[Tag],
    points: Sequence[tuple[float, float]],
    frame: Box,
    lines: Sequence[Box] = (),
) -> tuple[Box | None, ...]:
    """A place for each tag, the first ones served first; None where there is no room. points,
    lines: must stay visible."""
    taken = [*lines]
    taken += [Box(x - _RADIUS, y - _RADIUS, x + _RADIUS, y + _RADIUS) for x, y in points]
    places: list[Box | None] = []
    for tag in tags:
        free = (b for b in _candidates(tag) if frame.holds(b) and not any(map(b.meets, taken)))
        found = next(free, None)
        places.append(found)
        if found is not None:
            taken.append(found)
    return tuple(places)


def _candidates(tag: Tag) -> list[Box]:
    """Above, below, to the right and to the left of the point, the nearest first."""
    (x, y), (width, height) = tag.anchor, tag.size
    found: list[Box] = []
    for rise in _RISES:
        for left in (x + 2, x - width / 2, x - width - 2, x - 24):
            top = y - rise - height if rise > 0 else y - rise - LINE + 2
            found.append(Box(left, top, left + width, top + height))
    return found


@dataclass(frozen=True)
class TimeUnit:
    """Unit of a time axis: its name and its length in seconds."""

    name: str
    seconds: float


_UNITS = (
    (1.0, TimeUnit("ms", 1e-3)),
    (600.0, TimeUnit("s", 1.0)),
    (36000.0, TimeUnit("min", 60.0)),
    (float("inf"), TimeUnit("h", 3600.0)),
)


def time_unit(span: float) -> TimeUnit:
    """The unit that keeps the numbers of an axis of `span` seconds short."""
    return next(unit for longest, unit in _UNITS if span < longest)


@dataclass(frozen=True)
class Stretch:
    """Part of a record: its first sample, 0-based, and its number of samples."""

    start: int
    length: int


@dataclass(frozen=True)
class TimeAxis:
    """Positions of segments on one time axis: `times` holds the time of each sample in `unit`,
    `pieces` names the kind of the segments.

    A single segment keeps the time of its record; several are laid end to end with a gap.
    """

    times: tuple[Array, ...]
    unit: TimeUnit
    limits: tuple[float, float]
    pieces: str = "records"

    @property
    def label(self) -> str:
        """Text for the axis."""
        joined = f", {self.pieces} end to end" if len(self.times) > 1 else ""
        return f"Time{joined} [{self.unit.name}]"

    @property
    def seams(self) -> tuple[float, ...]:
        """Times between consecutive segments."""
        pairs = zip(self.times, self.times[1:], strict=False)
        return tuple(float(a[-1] + b[0]) / 2 for a, b in pairs)


def last_sample(stretches: Sequence[Stretch]) -> int:
    """Return the last sample of the axis for these segments."""
    total = sum(s.length for s in stretches)
    return stretches[0].start + total if len(stretches) == 1 else total


def lay_out(
    stretches: Sequence[Stretch], sampling_time: float, unit: TimeUnit, pieces: str = "records"
) -> TimeAxis:
    """Return the time axis for segments.

    Args:
        stretches: the segments.
        sampling_time: sampling time of their records, s.
        unit: unit of the axis.
        pieces: name of the kind of the segments.
    """
    total = sum(s.length for s in stretches)
    gap = total // 50 + 1
    first = stretches[0].start if len(stretches) == 1 else 0
    scale = sampling_time / unit.seconds
    times: list[Array] = []
    for segment in stretches:
        times.append((first + np.arange(segment.length, dtype=np.float64)) * scale)
        first += segment.length + gap
    edge = total * scale / 100
    limits = float(times[0][0]) - edge, float(times[-1][-1]) + edge
    return TimeAxis(tuple(times), unit, limits, pieces)
