"""Data of the residual checks: simulations of samples that the model was not fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.data.trajectory import Array, filled, spread_of
from asia.judge.scoring.outcome import without_gaps


@dataclass(frozen=True)
class SimulatedBlock:
    """Segment of a record, measured and simulated."""

    u: Array
    """Inputs (H, nu)."""
    y: Array
    """Measured outputs (H, ny), NaN where an output was not measured."""
    y_hat: Array
    """Simulated outputs (H, ny)."""
    record: int = 0
    """Number of the record, 0-based."""
    start: int = 0
    """The first sample in that record, 0-based."""

    @property
    def residual(self) -> Array:
        """Measured less simulated (H, ny), on straight lines between the measured samples."""
        return filled(self.y - self.y_hat)

    @property
    def complete_y(self) -> Array:
        """Measured outputs (H, ny), simulated plus residual where an output was not measured."""
        return without_gaps(self.y, self.y_hat)


@dataclass(frozen=True)
class SimulatedBlocks:
    """All blocks of a validation report, with the names of their channels."""

    blocks: tuple[SimulatedBlock, ...]
    """Simulated blocks, at least one."""
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    sampling_time: float
    """s."""

    @property
    def deviation(self) -> Array:
        """Standard deviation of the measured outputs (ny,), never 0."""
        found = spread_of(np.concatenate([b.y for b in self.blocks]))
        return np.where(found > 0.0, found, 1.0)

    def residuals(self, output: int) -> list[Array]:
        """Return the residuals of one output, (H,) a block."""
        return [b.residual[:, output] for b in self.blocks]

    def input(self, number: int) -> list[Array]:
        """One input, (H,) a block."""
        return [b.u[:, number] for b in self.blocks]

    @property
    def shortest(self) -> int:
        """Samples of the shortest block."""
        return min(len(b.y) for b in self.blocks)


def percent(share: float) -> str:
    """Format a share with two digits, such as `41 %` or `0.62 %`."""
    value = 100.0 * share
    return f"{value:.0f} %" if abs(value) >= 10 else f"{value:.2g} %"


def listed(names: Sequence[str]) -> str:
    """`a, b and c`."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
