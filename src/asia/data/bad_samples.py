"""Bad samples of records: outliers, frozen outputs, counters that overflowed, and missing-value
codes, each named by record, row and time."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from asia.data.trajectory import Array, Trajectory

_CODE = re.compile(r"-?9999*(\.9+)?|-999\.25|-?[67]999|32767|-32768|65535")
"""Values that loggers write for a missing one."""
_FAR, _MOST, _LEVEL = 3.0, 5, 1e-3
"""Distance of a code from the others in their range, outliers looked for at once in a signal, and
false alarms in a signal. On records without bad samples the alarms of all kinds stay below 2 % of
the files (benchmarks/data/bad_samples.py)."""
_SHORTEST, _LONGER = 10, 4.0
"""Samples of a frozen segment, and its length over that of the longest other rest of the output
while inputs move."""


@dataclass(frozen=True)
class BadSamples:
    """Samples of one signal that no model can explain.

    Attributes:
        first, last: rows of the record, 1-based and inclusive
        time: s from the start of the record to the first one
        value: the first one
        statistic: distance from the other samples: over their range for a code, over the next
            largest departure for an outlier, over the next longest rest for a frozen output, in
            steps of the counter for an overflow
        count: samples of this kind in the signal
    """

    kind: Literal["outlier", "frozen", "overflow", "code"]
    signal: str
    record: str
    first: int
    last: int
    time: float
    value: float
    statistic: float
    count: int

    def __str__(self) -> str:
        rows = (
            f"row {self.first}" if self.first == self.last else f"rows {self.first} to {self.last}"
        )
        place = f"{rows} of record '{self.record}' (from {self.time:g} s)"
        many = f"in {self.count} samples, the first in" if self.count > 1 else "in"
        if self.kind == "code":
            return (
                f"{self.signal} is {self.value:g} {many} {place}, {self.statistic:.2g} times the "
                "range of the others away: if this marks a missing value, give --missing-code "
                f"{self.value:g}, or leave the cell empty"
            )
        if self.kind == "outlier":
            many = "samples jump" if self.count > 1 else "sample jumps"
            return (
                f"{self.signal}: {self.count} {many} away from both neighbours, the first at "
                f"{place} to {self.value:g}, {self.statistic:.2g} times as far as any other: leave "
                "the cell empty if the sensor failed there"
            )
        if self.kind == "overflow":
            more = f" and {self.count - 1} more" if self.count > 1 else ""
            return (
                f"{self.signal} jumps by {self.statistic:g} steps of its resolution, a power of "
                f"two, at {place}{more}: a counter may have overflowed; add the missing turns "
                "before the record is used"
            )
        return (
            f"{self.signal} is frozen at {self.value:g} in {place}, while inputs move, "
            f"{self.statistic:.2g} times as long as at any other rest: the sensor may have failed "
            "there; leave these cells empty, or add to [data] of problem.toml: missing = "
            f'[{{ signal = "{self.signal.partition(" ")[2]}", record = "{self.record}", '
            f"rows = [{self.first}, {self.last}] }}]"
        )


def find_bad_samples(
    records: Sequence[Trajectory],
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    only_inputs: bool = False,
) -> tuple[BadSamples, ...]:
    """Find the bad samples of records.

    Args:
        inputs, outputs: names of the signals
        only_inputs: leave the outputs alone, as those of a test
    """
    found: list[BadSamples] = []
    if not records:
        return ()
    for i, name in enumerate(inputs):
        signal = _Signal(f"input {name}", records, [r.u[:, i] for r in records])
        found += list(_codes(signal)) or list(_outliers(signal, is_input=True))
    pulses = {(one.record, one.first) for one in found if one.kind == "outlier"}
    for j, name in enumerate(outputs if not only_inputs else ()):
        signal = _Signal(f"output {name}", records, [r.measured_y[:, j] for r in records])
        codes = list(_codes(signal))
        spikes = () if codes else _outliers(signal, is_input=False)
        found += codes
        # One sample after a pulse of an input a fast output follows it.
        found += [s for s in spikes if not any((s.record, s.first - k) in pulses for k in range(3))]
        found += [*_overflows(signal), *_frozen(signal)]
    return tuple(found)


@dataclass(frozen=True)
class _Signal:
    name: str
    records: Sequence[Trajectory]
    parts: Sequence[Array]
    """Samples in each record, NaN where one is missing."""

    @property
    def values(self) -> Array:
        """All samples that were measured."""
        values = np.concatenate(self.parts)
        return values[np.isfinite(values)]

    def bad(
        self, kind: Literal["outlier", "frozen", "overflow", "code"], place: tuple[int, int],
        statistic: float, count: int = 1, length: int = 1,
    ) -> BadSamples:  # fmt: skip
        """Name the samples from a place: number of the record, and of the sample in it."""
        k, row = place
        record = self.records[k]
        return BadSamples(
            kind, self.name, record.name, row + 1, row + length, row * record.sampling_time,
            float(self.parts[k][row]), statistic, count,
        )  # fmt: skip


def _codes(signal: _Signal) -> Iterator[BadSamples]:
    """Codes of missing values far from all others."""
    values = signal.values
    if values.size < _SHORTEST:
        return
    low, high = (float(v) for v in np.quantile(values, (0.025, 0.975)))
    away = _FAR * (high - low)
    for value in np.unique(values[(values < low - away) | (values > high + away)]).tolist():
        if away == 0 or not _CODE.fullmatch(f"{value:g}"):
            continue
        places = [
            (k, int(r)) for k, p in enumerate(signal.parts) for r in np.flatnonzero(p == value)
        ]
        others = values[values != value]
        distance = min(abs(value - low), abs(value - high)) / float(np.ptp(others) or high - low)
        yield signal.bad("code", places[0], distance, len(places))


def _outliers(signal: _Signal, *, is_input: bool) -> Iterator[BadSamples]:
    """Single samples that depart from both neighbours farther than the tail of such departures
    allows.

    Of departures with a Pareto tail, j log(d_j / d_(j+1)) is exponential, with the mean that Hill's
    estimator gives (Embrechts, Klueppelberg, Mikosch, Modelling Extremal Events, 1997, section
    6.4); of lighter tails it is smaller.
    """
    departures: list[Array] = []
    for part in signal.parts:
        steps = np.diff(part)
        away = np.zeros(len(part))
        if len(part) > 2:
            before, after = steps[:-1], -steps[1:]
            same = np.nan_to_num(before * after) > 0
            away[1:-1] = np.where(same, np.minimum(np.abs(before), np.abs(after)), 0.0)
        departures.append(away)
    pooled, values = np.concatenate(departures), signal.values
    order = np.argsort(-pooled, kind="stable")
    size = pooled[order]
    most = min(25, len(size) - _MOST - 2)
    if values.size < 30 or most < 10 or size[0] <= 0:
        return
    levels = np.unique(values)
    resolution = float(np.diff(levels).min()) if len(levels) > 1 else 0.0
    starts = np.cumsum([0, *(len(p) for p in signal.parts)])
    for j in range(_MOST, 0, -1):
        tail = np.log(size[j : j + most] + resolution)
        mean = max(float(np.mean(tail - math.log(size[j + most] + resolution))), 0.1)
        ratio = size[j - 1] / (size[j] + resolution)
        others = np.delete(np.concatenate(signal.parts), order[:j])
        others = others[np.isfinite(others)]
        spread = float(np.ptp(others)) if is_input else float(np.std(others))
        # A departure ten times the next is rare even where the tail of smooth signals is uneven.
        is_rare = ratio > 10.0 or math.exp(-j * math.log(max(ratio, 1.0)) / mean) <= _LEVEL
        if ratio > 3.0 and is_rare and size[j - 1] > spread > 0:
            jumped = np.concatenate(signal.parts)[order[:j]]
            if is_input and j > 1 and np.ptp(jumped) == 0:
                return  # Pulses of one height are part of the experiment.
            row = int(order[:j].min())
            k = int(np.searchsorted(starts, row, side="right")) - 1
            yield signal.bad("outlier", (k, row - int(starts[k])), float(ratio), j)
            return


def _overflows(signal: _Signal) -> Iterator[BadSamples]:
    """Jumps by a power of two of the resolution against the slope on both sides."""
    values = signal.values
    levels = np.unique(values)
    if len(levels) < 10:
        return
    resolution = float(np.diff(levels).min())
    multiples = (levels - levels[0]) / resolution
    if np.abs(multiples - np.round(multiples)).max() > 1e-3:
        return
    places: list[tuple[int, int, float]] = []
    for k, part in enumerate(signal.parts):
        steps = np.diff(part) / resolution
        for row in np.flatnonzero(np.abs(steps) > 128).tolist():
            size = 2.0 ** round(math.log2(abs(steps[row])))
            near = np.concatenate([steps[max(row - 5, 0) : row], steps[row + 1 : row + 6]])
            # Without the overflow the signal would have gone on with the slope around it.
            slope = float(np.median(near)) if near.size > 3 else 0.0
            least = 0.05 * size
            if (
                slope * steps[row] < 0
                and np.abs(near).max() < least
                and abs(steps[row] + math.copysign(size, slope) - slope) <= 3.0 * np.abs(near).max()
                and size >= 256
            ):
                places.append((k, row + 1, size))
    if places:
        k, row, size = places[0]
        yield signal.bad("overflow", (k, row), size, len(places))


def _frozen(signal: _Signal) -> Iterator[BadSamples]:
    """Segments of equal samples, while inputs move, that are far longer than any other one.

    A segment at the least or the largest value is a limit of the sensor or the system, one at the
    start of a record may be rest or dead time.
    """
    values = signal.values
    if not values.size or np.ptp(values) == 0:
        return
    spread = np.std(np.concatenate([r.u for r in signal.records]), axis=0)
    rests: list[tuple[int, int, int, bool]] = []
    for k, (part, record) in enumerate(zip(signal.parts, signal.records, strict=True)):
        edges = np.flatnonzero(np.diff(part) != 0) + 1
        for first, end in zip([0, *edges], [*edges, len(part)], strict=True):
            length = int(end - first)
            if length < 3:
                continue
            u = record.u[first : first + max(2 * length // 3, 2)]
            moves = (u.std(axis=0) > 0.3 * spread)[spread > 0]
            if moves.any():
                ends = float(part[first]) in (float(values.min()), float(values.max()))
                rests.append((length, k, int(first), bool(first > 0 and not ends)))
    rests.sort(key=lambda one: -one[0])
    equal = sum(int((np.diff(p) == 0).sum()) for p in signal.parts)
    for j in range(min(3, len(rests)), 0, -1):
        length = rests[j - 1][0]
        longest = rests[j][0] if len(rests) > j else 2
        inside = sum(one[0] - 1 for one in rests[:j])
        share = max(equal - inside, 1) / max(len(values) - inside, 1)
        chance = math.log(len(values)) + (length - 1) * math.log(min(share, 1.0))
        if length >= max(_SHORTEST, _LONGER * longest) and chance < math.log(_LEVEL):
            for size, k, first, counts in sorted(rests[:j], key=lambda one: one[1:3]):
                if counts:
                    yield signal.bad("frozen", (k, first), size / longest, size, size)
            return
