"""Preprocessing of every record before a search, and its inverse for simulated outputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from pydantic import Field

from asia.data.trajectory import Array, Signal, Trajectory
from asia.errors import UserError

_Positive = Annotated[float, Field(gt=0)]


@dataclass(frozen=True)
class Preprocess:
    """`[preprocess]` of a problem file. In this order: inputs are delayed, every Nth sample is kept
    (inputs averaged over the N samples from it on), and every signal becomes
    (value - offset) / scale."""

    delay: Mapping[str, Annotated[int, Field(ge=0, le=1_000_000)]] = field(
        default_factory=dict[str, int]
    )
    """Delay of each input in samples: a model receives values measured this many samples
    earlier."""
    decimate: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    offset: Mapping[str, float] = field(default_factory=dict[str, float])
    scale: Mapping[str, _Positive] = field(default_factory=dict[str, float])

    def __bool__(self) -> bool:
        return self != Preprocess()

    @property
    def longest_delay(self) -> int:
        """Samples."""
        return max(self.delay.values(), default=0)

    def check(self, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        """Raise UserError for a name that is no signal, or no input where one is wanted."""
        signals = [*inputs, *outputs]
        for table, known in (("delay", inputs), ("offset", signals), ("scale", signals)):
            for name in getattr(self, table):
                if name not in known:
                    raise UserError(
                        f"preprocess.{table} names '{name}', expected one of {', '.join(known)}"
                    )

    def signals(self, signals: Sequence[Signal]) -> tuple[Signal, ...]:
        """Return the signals with their units after preprocessing: 3 V for a voltage scaled by 3
        V."""
        return tuple(
            Signal(s.name, f"{self.scale[s.name]:g} {s.unit}".strip())
            if s.name in self.scale
            else s
            for s in signals
        )

    def length(self, samples: int) -> int:
        """Return the length after preprocessing of a record of `samples` samples."""
        return max(samples - self.longest_delay, 0) // self.decimate

    def record(
        self, record: Trajectory, inputs: Sequence[Signal], outputs: Sequence[Signal]
    ) -> Trajectory:
        """The record as the search sees it."""
        if not self:
            return record
        rows = self.length(len(record)) * self.decimate
        return Trajectory(
            self.inputs(record.u, inputs)[: self.length(len(record))],
            self.outputs(record.measured_y[self.longest_delay :][:rows], outputs),
            record.sampling_time * self.decimate,
            record.name,
        )

    def records(
        self, records: Sequence[Trajectory], inputs: Sequence[Signal], outputs: Sequence[Signal]
    ) -> tuple[Trajectory, ...]:
        """Preprocess several records, as `record`."""
        return tuple(self.record(record, inputs, outputs) for record in records)

    def inputs(self, u: Array, signals: Sequence[Signal]) -> Array:
        """Preprocess measured inputs (T, nu) to model inputs (length(T), nu).

        The first `longest_delay` samples are taken up by the delays.
        """
        longest, rows = self.longest_delay, len(u)
        late = [longest - self.delay.get(s.name, 0) for s in signals]
        moved = [u[k : rows - longest + k, i] for i, k in enumerate(late)]
        whole = np.stack(moved, axis=1)[: self.length(rows) * self.decimate]
        means = whole.reshape(-1, self.decimate, len(signals)).mean(axis=1)
        return (means - self._offsets(signals)) / self._scales(signals)

    def outputs(self, y: Array, signals: Sequence[Signal]) -> Array:
        """Measured outputs (T, ny) -> those of the samples that are kept, from the first on."""
        return (y[:: self.decimate] - self._offsets(signals)) / self._scales(signals)

    def back(self, y: Array, signals: Sequence[Signal], samples: int) -> Array:
        """Convert simulated outputs -> (samples, ny) in physical units; on straight lines between
        the samples that were kept, and held after the last."""
        if not self:
            return y
        return self.refined(y * self._scales(signals) + self._offsets(signals), samples)

    def refined(self, values: Array, samples: int) -> Array:
        """(K, n) -> (samples, n), on straight lines between the samples that were kept."""
        if self.decimate == 1:
            return values[:samples]
        kept = np.arange(len(values), dtype=np.float64) * self.decimate
        return np.stack([np.interp(np.arange(samples), kept, c) for c in values.T], axis=1)

    def _offsets(self, signals: Sequence[Signal]) -> Array:
        return np.array([self.offset.get(s.name, 0.0) for s in signals])

    def _scales(self, signals: Sequence[Signal]) -> Array:
        return np.array([self.scale.get(s.name, 1.0) for s in signals])
