"""Data that the validation checks work on: simulations, linear responses, ranges, noise."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from asia.data.segment import SimulatedSegment
from asia.data.trajectory import Array, spread_of
from asia.judge.scoring.checks.check import Check


@dataclass(frozen=True)
class SimulatedSegments:
    """All blocks of a validation report, with the names of their channels."""

    blocks: tuple[SimulatedSegment, ...]
    """Simulated blocks, at least one."""
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    sampling_time: float
    """s."""
    records: tuple[str, ...] = ()
    """Names of the records by their number."""

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


_DECAYED = 1e-3


@dataclass(frozen=True)
class LinearResponse:
    """Response of one model to a small impulse of one input around an operating point."""

    point: str
    input: str
    impulse: Array
    """Change of the outputs (n, ny) for an input of 1 during the first sample."""

    @property
    def step(self) -> Array:
        """Change of the outputs (n, ny) for an input of 1 from the first sample on."""
        return np.cumsum(self.impulse, axis=0)

    @property
    def settled(self) -> bool:
        """Whether the response has decayed by the end."""
        tail = self.impulse[-max(1, len(self.impulse) // 10) :]
        return bool(
            np.max(np.abs(tail)) <= _DECAYED * max(float(np.abs(self.impulse).max()), 1e-300)
        )


@dataclass(frozen=True)
class ValidationData:
    """Simulations and responses of the model that is validated."""

    simulations: SimulatedSegments
    """Measured and simulated outputs of samples that the model was not fitted to."""
    linear_responses: tuple[LinearResponse, ...]
    """Responses to small steps of each input; () where the model has no finite one."""
    lowest: Array
    """Least value of each output in the training records (ny,)."""
    highest: Array
    """Greatest value of each output in the training records (ny,)."""
    noise: Callable[[], Sequence[float | None]]
    """Estimate the noise of each output over its standard deviation, None where it is unknown."""
    long_run: Callable[[], Array | None]
    """Simulate ten horizons (n, ny) with repeated inputs; None where the model has no finite
    answer."""
    fit: float | None = None
    """100 (1 - V) in percent; None where it is not known."""


ValidationCheck: TypeAlias = Callable[[ValidationData], Check | tuple[Check, ...]]
"""One check of a model, or several that share their computations.

Conformance suite: `asia.testing.check_validation_check`.
"""


def without_responses(simulations: SimulatedSegments) -> ValidationData:
    """Data for the checks that need simulations only, with the range of the simulated records."""
    y = np.concatenate([block.complete_y for block in simulations.blocks])
    unknown = [None] * len(simulations.outputs)
    return ValidationData(
        simulations, (), y.min(axis=0), y.max(axis=0), lambda: unknown, lambda: None
    )


def percent(share: float) -> str:
    """Format a share with two digits, such as `41 %` or `0.62 %`."""
    value = 100.0 * share
    return f"{value:.0f} %" if abs(value) >= 10 else f"{value:.2g} %"


def listed(names: Sequence[str]) -> str:
    """`a, b and c`."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
