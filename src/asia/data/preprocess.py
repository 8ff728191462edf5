"""Preprocessing of every record before a search, and what each fit does to its own records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from asia.data.trajectory import Array, Signal, Trajectory
from asia.errors import UserError

_OLD_RULE = (
    "is of an older version, with offset or scale in numbers, which may come from samples that a "
    "fold holds out: write detrend = true, scale = true, and start a new run; the version that "
    "began an old run can still use it"
)


def without_numbers(table: Any) -> Any:
    """Return a table `[preprocess]` unchanged. Raises ValueError where it is of the old rule."""
    if isinstance(table, dict) and ("offset" in table or isinstance(table.get("scale"), dict)):
        raise ValueError(_OLD_RULE)
    return table


@dataclass(frozen=True)
class Preprocess:
    """`[preprocess]` of a problem file. In this order: inputs are delayed, and every Nth sample is
    kept (inputs averaged over the N samples from it on). Each fit then subtracts the mean of its
    own training records, and divides by their standard deviation: `asia.data.standardise`."""

    delay: Mapping[str, Annotated[int, Field(ge=0, le=1_000_000)]] = field(
        default_factory=dict[str, int]
    )
    """Delay of each input in samples: a model receives values measured this many samples
    earlier."""
    decimate: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    detrend: bool = False
    """Whether each fit subtracts the mean of its training records from every signal."""
    scale: bool = False
    """Whether each fit divides every signal by its standard deviation over the training records."""

    def __bool__(self) -> bool:
        return self != Preprocess()

    @property
    def longest_delay(self) -> int:
        """Samples."""
        return max(self.delay.values(), default=0)

    def check(self, inputs: Sequence[str]) -> None:
        """Raise UserError for a delay of what is no input."""
        for name in self.delay:
            if name not in inputs:
                raise UserError(
                    f"preprocess.delay names '{name}', expected one of {', '.join(inputs)}"
                )

    def signals(self, signals: Sequence[Signal]) -> tuple[Signal, ...]:
        """Return the signals with their units in a fit: `std`, of its training records, where they
        are scaled."""
        return tuple(replace(s, unit="std") if self.scale else s for s in signals)

    def length(self, samples: int) -> int:
        """Return the length after preprocessing of a record of `samples` samples."""
        return max(samples - self.longest_delay, 0) // self.decimate

    def record(self, record: Trajectory, inputs: Sequence[Signal]) -> Trajectory:
        """The record as the search sees it."""
        if not (self.longest_delay or self.decimate > 1):
            return record
        rows = self.length(len(record)) * self.decimate
        return Trajectory(
            self.inputs(record.u, inputs)[: self.length(len(record))],
            self.outputs(record.measured_y[self.longest_delay :][:rows]),
            record.sampling_time * self.decimate,
            record.name,
        )

    def records(
        self, records: Sequence[Trajectory], inputs: Sequence[Signal]
    ) -> tuple[Trajectory, ...]:
        """Preprocess several records, as `record`."""
        return tuple(self.record(record, inputs) for record in records)

    def inputs(self, u: Array, signals: Sequence[Signal]) -> Array:
        """Preprocess measured inputs (T, nu) to model inputs (length(T), nu).

        The first `longest_delay` samples are taken up by the delays.
        """
        longest, rows = self.longest_delay, len(u)
        late = [longest - self.delay.get(s.name, 0) for s in signals]
        moved = [u[k : rows - longest + k, i] for i, k in enumerate(late)]
        whole = np.stack(moved, axis=1)[: self.length(rows) * self.decimate]
        return whole.reshape(-1, self.decimate, len(signals)).mean(axis=1)

    def outputs(self, y: Array) -> Array:
        """Measured outputs (T, ny) -> those of the samples that are kept, from the first on."""
        return y[:: self.decimate]

    def refined(self, values: Array, samples: int) -> Array:
        """(K, n) -> (samples, n), on straight lines between the samples that were kept, and held
        after the last."""
        if self.decimate == 1:
            return values[:samples]
        kept = np.arange(len(values), dtype=np.float64) * self.decimate
        return np.stack([np.interp(np.arange(samples), kept, c) for c in values.T], axis=1)


@dataclass(frozen=True)
class Preparation:
    """Requested preprocessing. The command line shows the texts."""

    delay: Annotated[
        str | None, 'Samples to delay the inputs by; "auto": from correlations. [preprocess]'
    ] = None
    decimate: Annotated[int, "Keep every Nth sample. [preprocess]"] = 1
    detrend: Annotated[
        bool, "In each fold, subtract the training mean from every signal. [preprocess]"
    ] = False
    scale: Annotated[
        bool,
        "In each fold, divide every signal by its training standard deviation. [preprocess]",
    ] = False
