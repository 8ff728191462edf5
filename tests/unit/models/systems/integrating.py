"""A motor whose angle is measured: what drives it adds up."""

from __future__ import annotations

import numpy as np

from asia.data import Trajectory
from tests.unit.models.systems.equations import held_steps


def motor(seed: int, samples: int = 400, noise: float = 0.003, bend: float = 0.0) -> Trajectory:
    """Speed with a lag and, with `bend`, a cubic drag; the angle is its sum."""
    u = held_steps(samples, seed, -1.0, 1.0, hold=10)
    speed, angle, found = 0.0, 0.0, np.empty((samples, 1))
    for k, now in enumerate(u[:, 0]):
        found[k] = angle
        angle += 0.1 * speed
        speed += 0.1 * (-1.5 * speed - bend * speed**3 + 2.0 * now)
    deviation = noise * found.std() * np.random.default_rng(seed).normal(size=found.shape)
    return Trajectory(u, found + deviation, 0.1, f"run{seed}")
