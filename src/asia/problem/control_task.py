"""Task of a controller: what a candidate receives of a control problem. Workers load this module,
so it imports little."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import Annotated

from annotated_types import Gt

from asia.data.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class Actuator:
    """Limits of an input of the plant, which hold whatever a controller asks for."""

    min: float
    max: float
    start: float
    """Value before the first sample."""
    rate: Annotated[float, Gt(0)] = inf
    """Largest change in 1/s."""

    def __post_init__(self) -> None:
        if not self.min < self.max or not self.min <= self.start <= self.max:
            raise ValueError(
                f"has limits {self.min:g} to {self.max:g} and start {self.start:g}: expected "
                "min < max, and start between them"
            )

    def applied(self, wanted: float, last: float, sampling_time: float) -> float:
        """Value that the plant gets for a wanted one, after the last one."""
        most = self.rate * sampling_time
        return min(max(min(max(wanted, self.min), self.max), last - most), last + most)


@dataclass(frozen=True)
class ControlTask:
    """Everything that a controller's author may know, as part of `Context`: nothing of the plant
    but what its records show."""

    setpoints: tuple[str, ...]
    """Outputs with a set point, in the order of r."""
    controlled: tuple[int, ...]
    """Their places among the outputs, which are the order of y."""
    actuators: tuple[Actuator, ...]
    """Limits of the inputs, in the order of u."""
    tolerance: tuple[float, ...]
    """Size of an error that costs 1: of each output in `setpoints`, then of the change of each
    input from sample to sample."""
    noise: tuple[float, ...]
    """Standard deviation of the measurement noise of each output."""
    ranges: tuple[tuple[float, float], ...]
    """Smallest and largest set point of each output in `setpoints`."""
    records: tuple[Trajectory, ...] = field(repr=False)
    """Open-loop records of the plant."""
    models: tuple[bytes, ...] = field(default=(), repr=False)
    """Identified models as a worker loads them: of all records, then of parts of them."""
    scenarios: tuple[Trajectory, ...] = field(default=(), repr=False)
    """Training scenarios: `u` has the set points, then disturbances, noise and plant parameters."""
    metric: str = "rmse"
    """Measure of the errors: rmse or mae."""
