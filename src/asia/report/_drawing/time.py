"""Time axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.data import Array


@dataclass(frozen=True)
class TimeUnit:
    """Unit of a time axis: its name and its length in seconds."""

    name: str
    seconds: float


_UNITS = (TimeUnit("ms", 1e-3), TimeUnit("s", 1.0), TimeUnit("min", 60.0), TimeUnit("h", 3600.0))
_LONGEST = (1.0, 600.0, 36000.0, float("inf"))


def time_unit(span: float) -> TimeUnit:
    """The unit that keeps the numbers of an axis of `span` seconds short."""
    return next(u for u, longest in zip(_UNITS, _LONGEST, strict=True) if span < longest)


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
