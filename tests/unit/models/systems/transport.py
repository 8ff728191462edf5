"""A belt whose speed is an input: its load reaches a slow sensor later the slower it runs."""

from __future__ import annotations

import numpy as np

from asia.data import Trajectory

LENGTH = 6.0


def belt(samples: int, seed: int, noise: float = 0.01) -> Trajectory:
    """Speed and load (T, 2), sensor (T, 1). Each sample's load lies on the belt as a parcel, whose
    place is followed one by one."""
    rng = np.random.default_rng(seed)
    speed = np.repeat(rng.uniform(0.4, 1.6, samples // 15 + 1), 15)[:samples]
    load = np.repeat(rng.normal(size=samples // 6 + 1), 6)[:samples]
    place = np.concatenate([[0.0], np.cumsum(speed)])
    y = np.zeros(samples)
    for k in range(samples - 1):
        middle = (place[k] + place[k + 1]) / 2 - LENGTH
        entered = np.searchsorted(place, middle, side="right") - 1
        y[k + 1] = 0.6 * y[k] + 0.4 * load[max(entered, 0)]
    y += noise * rng.normal(size=samples)
    return Trajectory(np.column_stack([speed, load]), y, 1.0)
