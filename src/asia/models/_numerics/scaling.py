"""Z-scores: signals leave physical units inside a model and come back at its border."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.data.trajectory import Array, Trajectory, deviations


@dataclass(frozen=True)
class Scaling:
    """Mean and standard deviation of each channel, in physical units."""

    u_mean: Array  # (nu,)
    u_std: Array  # (nu,), 1 for a constant channel
    y_mean: Array  # (ny,)
    y_std: Array  # (ny,), 1 for a constant channel

    @classmethod
    def of(cls, trajectories: Sequence[Trajectory]) -> Scaling:
        """Statistics over all samples of all records; a constant channel is only shifted."""
        u = np.concatenate([t.u for t in trajectories])
        y = np.concatenate([t.y for t in trajectories])
        return cls(u.mean(axis=0), deviations(u), y.mean(axis=0), deviations(y))

    def inputs(self, u: Array) -> Array:
        """Scale inputs (..., nu) in physical units to z-scores."""
        return (u - self.u_mean) / self.u_std

    def outputs(self, y: Array) -> Array:
        """Scale outputs (..., ny) in physical units to z-scores."""
        return (y - self.y_mean) / self.y_std

    def physical(self, y: Array) -> Array:
        """Convert outputs (..., ny) from z-scores to physical units."""
        return y * self.y_std + self.y_mean
