"""The region of validity: where inputs and outputs are like those of the training records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.data import Array

# Lengths of the moving averages, in samples, that describe the recent past of an input; of longer
# ones a short cloud has too few.
_LENGTHS = (1, 4, 16, 64)
_SHORTEST_CLOUD = 16
_SHARE = 0.99
_RIDGE = 1e-6


@dataclass(frozen=True)
class Region:
    """A cloud of training samples, described by moving averages of the inputs and the outputs."""

    centre: Array
    """(features,)."""
    whiten: Array
    """(features, features): (x - centre) @ whiten has unit covariance over the cloud."""
    edge: float
    """The distance that 99 % of the cloud lies within."""
    lengths: tuple[int, ...]
    """Lengths of the moving averages, in samples."""

    def distance(self, past_u: Array, u: Array, y: Array) -> Array:
        """Mahalanobis distance (H,) of each sample over that of the edge: above 1 is outside.
        past_u (n, nu), u (H, nu), y (H, ny), measured or simulated."""
        features = _features(past_u, u, y, self.lengths)
        return np.linalg.norm((features - self.centre) @ self.whiten, axis=1) / self.edge


def region_of(records: Sequence[tuple[Array, Array]]) -> Region:
    """The region of training records (u (N, nu), y (N, ny))."""
    samples = sum(len(u) for u, _ in records)
    lengths = tuple(n for n in _LENGTHS if n == 1 or _SHORTEST_CLOUD * n <= samples)
    cloud = np.concatenate([_features(u[:0], u, y, lengths) for u, y in records])
    centre = cloud.mean(axis=0)
    covariance = np.atleast_2d(np.cov(cloud, rowvar=False, bias=True))
    deviation = np.sqrt(np.diag(covariance))
    deviation[deviation == 0.0] = 1.0
    values, vectors = np.linalg.eigh(covariance / np.outer(deviation, deviation))
    whiten = (vectors / np.sqrt(np.maximum(values, _RIDGE))) / deviation[:, None]
    distances = np.linalg.norm((cloud - centre) @ whiten, axis=1)
    edge = max(float(np.quantile(distances, _SHARE)), np.finfo(np.float64).tiny)
    return Region(centre, whiten, edge, lengths)


def _features(past_u: Array, u: Array, y: Array, lengths: Sequence[int]) -> Array:
    """Averages of the inputs over the samples up to each one, and the output there."""
    whole = np.concatenate([past_u, u])
    total = np.concatenate([np.zeros((1, whole.shape[1])), np.cumsum(whole, axis=0)])
    ends = np.arange(len(past_u), len(whole)) + 1
    averages: list[Array] = []
    for length in lengths:
        starts = np.maximum(ends - length, 0)
        averages.append((total[ends] - total[starts]) / (ends - starts)[:, None])
    return np.concatenate([*averages, y], axis=1)
