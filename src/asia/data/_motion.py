"""Relation between the increments of outputs and the integrals of others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.data._trajectory import Array, Trajectory

# A rate integrates to its output but for noise, delay and a gain near one.
LEAST_CORRELATION = 0.6
LARGEST_GAIN = 1.5


@dataclass(frozen=True)
class Motion:
    """Correlation and least-squares gain (ny, ny) of each output's increment (rows) on the
    integral of each output (columns)."""

    correlation: Array
    gain: Array


def motion(records: Sequence[Trajectory], span: int) -> Motion:
    """Compare increments with integrals over `span` samples in all records.

    Integrals use Euler steps: the rate at a sample moves the output of the next sample.
    """
    moved, integrals = (np.concatenate(parts) for parts in zip(*_pairs(records, span), strict=True))
    energy = np.maximum((moved**2).sum(axis=0), 1e-300)
    effect = np.maximum((integrals**2).sum(axis=0), 1e-300)
    products = moved.T @ integrals
    return Motion(products / np.sqrt(energy[:, None] * effect), products / effect)


def _pairs(records: Sequence[Trajectory], span: int) -> list[tuple[Array, Array]]:
    found: list[tuple[Array, Array]] = []
    for t in records:
        total = np.cumsum(t.y * t.sampling_time, axis=0)
        integral = total[span - 1 : -1] - np.pad(total, ((1, 0), (0, 0)))[: len(t) - span]
        found.append((t.y[span:] - t.y[:-span], integral))
    return found
