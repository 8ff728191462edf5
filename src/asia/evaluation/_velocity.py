"""Constant velocity: the reference that knows how the outputs move, and nothing of the inputs."""

from __future__ import annotations

import numpy as np

from asia.data import Array
from asia.data._motion import LARGEST_GAIN, LEAST_CORRELATION, motion
from asia.protocol import Block, Fold

Rates = tuple[int | None, ...]


def find_rates(fold: Fold, horizon: int) -> Rates:
    """Find for each output the output that is its rate of change, from the training records.

    It is the one whose integral over `horizon` samples correlates best with the output's own
    increment, with a correlation above 0.6 and a gain between 2/3 and 3/2; None where there is
    none.
    """
    found = motion(fold.train, horizon)
    gain, correlation = found.gain, found.correlation
    fits = (correlation > LEAST_CORRELATION) & (gain > 1 / LARGEST_GAIN) & (gain < LARGEST_GAIN)
    np.fill_diagonal(fits, False)
    best = np.where(fits, correlation, 0.0).argmax(axis=1).tolist()
    return tuple(j if fits[i, j] else None for i, j in enumerate(best))


def constant_velocity(block: Block, rates: Rates, sampling_time: float) -> Array:
    """(H, ny): outputs with a rate move on at its last measured value (Euler steps of
    `sampling_time`, s); the others at their mean rate over the past window, of which one sample
    holds the output."""
    past = block.case.past_y
    slope = (past[-1] - past[0]) / max(len(past) - 1, 1)
    for output, rate in enumerate(rates):
        if rate is not None:
            slope[output] = sampling_time * past[-1, rate]
    return past[-1] + np.arange(1, len(block.y) + 1)[:, None] * slope
