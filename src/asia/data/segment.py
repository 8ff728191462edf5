"""A part of a record: what a model simulates, and what was measured there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TypeVar

import numpy as np

from asia.data.trajectory import Array, filled


@dataclass(frozen=True)
class Segment:
    """Part of a record with the past windows before it."""

    past_u: Array
    """Past window of the inputs (n_past_u, nu)."""
    past_y: Array
    """Past window of the outputs (n_past_y, ny)."""
    u: Array
    """Inputs (H, nu) of the samples to simulate."""
    y: Array
    """Measured outputs (H, ny), NaN where none was measured. A candidate never has them."""
    name: str = ""
    """Name of the record."""
    record: int = 0
    """Number of the record among those that were cut, 0-based."""
    start: int = 0
    """The first sample to simulate in that record, 0-based."""

    @property
    def stop(self) -> int:
        """One past the last sample, 0-based."""
        return self.start + len(self.y)

    @property
    def unmeasured(self) -> Segment:
        """The segment without its outputs, for a machine that must not have them."""
        return replace(self, y=np.broadcast_to(np.float64(np.nan), self.y.shape))

    def simulated(self, y_hat: Array) -> SimulatedSegment:
        """Return the segment with its simulated outputs (H, ny)."""
        parts = {one.name: getattr(self, one.name) for one in fields(Segment)}
        return SimulatedSegment(**parts, y_hat=y_hat)


@dataclass(frozen=True)
class SimulatedSegment(Segment):
    """Segment, measured and simulated."""

    y_hat: Array = field(kw_only=True)
    """Simulated outputs (H, ny)."""

    @property
    def residual(self) -> Array:
        """Measured less simulated (H, ny), on straight lines between the measured samples."""
        return filled(self.y - self.y_hat)

    @property
    def complete_y(self) -> Array:
        """Measured outputs (H, ny), simulated plus residual where an output was not measured."""
        return self.y_hat + self.residual if np.isnan(self.y).any() else self.y

    def part(self, first: int, stop: int) -> SimulatedSegment:
        """Return the samples from `first` up to `stop`, with the past windows before them."""
        rows = slice(first, stop)

        def before(past: Array, values: Array) -> Array:
            if first >= len(past):
                return values[first - len(past) : first]
            return np.concatenate([past, values[:first]])[first:]

        return replace(
            self,
            past_u=before(self.past_u, self.u),
            past_y=before(self.past_y, self.y),
            u=self.u[rows],
            y=self.y[rows],
            y_hat=self.y_hat[rows],
            start=self.start + first,
        )


S = TypeVar("S", bound=Segment)


def stacked(segments: Sequence[S]) -> S:
    """Return a batch of segments of one length: each array has a leading axis. A single one, which
    may be long, is not copied; name, record and start are those of the first."""
    first = segments[0]
    arrays = {
        one.name: getattr(first, one.name)[None]
        if len(segments) == 1
        else np.stack([getattr(segment, one.name) for segment in segments])
        for one in fields(first)
        if isinstance(getattr(first, one.name), np.ndarray)
    }
    return replace(first, **arrays)
