"""Closed loop of a plant and a controller that runs in a worker, sample by sample.

The controller gets set points and measured outputs up to now, and never the plant, the
disturbances, the noise itself or what is still to come: its worker is asked for one sample, the
plant moves on, and only then comes the next.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from asia.data.trajectory import Array
from asia.problem.control_task import Actuator

Ask: TypeAlias = Callable[[Array], Array]
"""From the next sample of what a model sees to its answer."""
BeginPlant: TypeAlias = Callable[[], AbstractContextManager[Ask]]
"""Begins a case of the plant."""
OpenPlant: TypeAlias = Callable[[], AbstractContextManager[BeginPlant]]
"""Opens the plant."""


@dataclass(frozen=True)
class ClosedLoop:
    """Plant, limits, and the columns of a scenario."""

    plant: OpenPlant
    actuators: tuple[Actuator, ...]
    sampling_time: float
    outputs: int
    """Measured outputs of the plant."""
    controlled: tuple[int, ...]
    """Those with a set point, which are the first columns of a scenario."""
    disturbances: int
    """Disturbances, the next columns."""
    noisy: tuple[int, ...]
    """Outputs with measurement noise, the next columns; plant parameters are the last."""

    @property
    def seen(self) -> int:
        """Signals that a controller sees."""
        return len(self.controlled) + self.outputs

    @property
    def driven(self) -> int:
        """Inputs of the plant that a controller gives."""
        return len(self.actuators)

    def simulate(self, controller: Ask, plant: BeginPlant, outside: Array) -> Array:
        """Simulate one scenario.

        Args:
            controller: set points and measured outputs (nr + ny,) to inputs (nu,)
            plant: begins a case of the plant: inputs, disturbances and parameters to outputs (ny,)
            outside: columns of the scenario (H, n)

        Returns:
            Controlled outputs at the end of each sample and changes of the inputs (H, nr + nu), NaN
            from where one of them is not finite.
        """
        nr, first = len(self.controlled), len(self.controlled) + self.disturbances
        last = first + len(self.noisy)
        found = np.full((len(outside), nr + self.driven), np.nan)
        u = np.array([a.start for a in self.actuators])
        parameters, places = outside[0, last:], list(self.controlled)
        with plant() as step:
            y = step(np.concatenate([u, outside[0, nr:first], parameters]))
            for k, row in enumerate(outside):
                measured = y.copy()
                measured[list(self.noisy)] += row[first:last]
                wanted = controller(np.concatenate([row[:nr], measured]))
                if not np.isfinite(wanted).all():
                    break
                before, u = u, self._applied(wanted, u)
                y = step(np.concatenate([u, row[nr:first], parameters]))
                if not np.isfinite(y).all():
                    break
                found[k] = np.concatenate([y[places], u - before])
        return found

    def _applied(self, wanted: Sequence[float] | Array, last: Array) -> Array:
        rows = zip(self.actuators, wanted, last, strict=True)
        return np.array([a.applied(float(w), float(b), self.sampling_time) for a, w, b in rows])
