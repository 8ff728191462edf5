"""Constant velocity: the reference that knows how the outputs move, and nothing of the inputs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asia.problem import Array, Trajectory
from asia.protocol import Block, Fold

# A rate integrates to its output but for noise, delay and a gain near one.
_LEAST_CORRELATION = 0.6
_LARGEST_GAIN = 1.5

Rates = tuple[int | None, ...]


def find_rates(fold: Fold, horizon: int) -> Rates:
    """For each output the output that is its rate of change, as its training records show.

    It is the one whose integral over `horizon` samples goes best with the output's own increment,
    with a correlation above 0.6 and a gain between 2/3 and 3/2; None where there is none.
    """
    increments, integrals = _motion(fold.train, horizon)
    energy = np.maximum((increments**2).sum(axis=0), 1e-300)
    effect = np.maximum((integrals**2).sum(axis=0), 1e-300)
    products = increments.T @ integrals
    correlation = products / np.sqrt(energy[:, None] * effect)
    gain = products / effect
    fits = (correlation > _LEAST_CORRELATION) & (gain > 1 / _LARGEST_GAIN) & (gain < _LARGEST_GAIN)
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


def _motion(records: Sequence[Trajectory], horizon: int) -> tuple[Array, Array]:
    """Increments of the outputs over `horizon` samples, and their integrals over them."""
    increments: list[Array] = []
    integrals: list[Array] = []
    for record in records:
        total = np.cumsum(record.y * record.sampling_time, axis=0)
        increments.append(record.y[horizon:] - record.y[:-horizon])
        integrals.append(total[horizon:] - total[:-horizon])
    return np.concatenate(increments), np.concatenate(integrals)
