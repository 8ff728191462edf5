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
# How far beyond the training range a signal still counts as inside, in half ranges from the middle.
_REACH = 1.2
# Least deviation that the size of the changes of an input is taken to have, as a share of its mean:
# that of a periodic input hardly varies.
_LEAST_VARIATION = 0.1


@dataclass(frozen=True)
class Region:
    """A cloud of training samples, described by moving averages of the inputs, by how much these
    change from sample to sample, and by the outputs."""

    centre: Array
    """(features,)."""
    whiten: Array
    """(features, features): (x - centre) @ whiten has unit covariance over the cloud."""
    edge: float
    """The distance that 99 % of the cloud lies within."""
    lengths: tuple[int, ...]
    """Lengths of the moving averages, in samples."""
    change: Array
    """Mean square (nu,) of the change of each input from sample to sample."""
    middle: Array
    """(nu + ny,): the middle of the range of each input and output."""
    reach: Array
    """(nu + ny,): how far from the middle a signal is inside."""

    def distance(self, past_u: Array, u: Array, y: Array) -> Array:
        """Distance (H,) of each sample over that of the edge: above 1 is outside. The larger one of
        the Mahalanobis distance from the cloud and the distance of any signal from the middle of
        its range. past_u (n, nu), u (H, nu), y (H, ny), measured or simulated."""
        features = _features(past_u, u, y, self.lengths, self.change)
        far = np.linalg.norm((features - self.centre) @ self.whiten, axis=1) / self.edge
        signals = np.concatenate([u, y], axis=1)
        return np.maximum(far, np.max(np.abs(signals - self.middle) / self.reach, axis=1))


def region_of(records: Sequence[tuple[Array, Array]]) -> Region:
    """The region of training records (u (N, nu), y (N, ny))."""
    samples = sum(len(u) for u, _ in records)
    lengths = tuple(n for n in _LENGTHS if n == 1 or _SHORTEST_CLOUD * n <= samples)
    steps = [np.diff(u, axis=0) ** 2 for u, _ in records]
    change = np.concatenate(steps).sum(axis=0) / max(1, sum(map(len, steps)))
    cloud = np.concatenate([_features(u[:0], u, y, lengths, change) for u, y in records])
    centre = cloud.mean(axis=0)
    covariance = np.atleast_2d(np.cov(cloud, rowvar=False, bias=True))
    inputs = len(change)
    for k in range(cloud.shape[1] - inputs, cloud.shape[1]):
        covariance[k, k] += (_LEAST_VARIATION * centre[k]) ** 2
    deviation = np.sqrt(np.diag(covariance))
    deviation[deviation == 0.0] = 1.0
    values, vectors = np.linalg.eigh(covariance / np.outer(deviation, deviation))
    whiten = (vectors / np.sqrt(np.maximum(values, _RIDGE))) / deviation[:, None]
    distances = np.linalg.norm((cloud - centre) @ whiten, axis=1)
    edge = max(float(np.quantile(distances, _SHARE)), np.finfo(np.float64).tiny)
    signals = np.concatenate([np.concatenate([u, y], axis=1) for u, y in records])
    low, high = signals.min(axis=0), signals.max(axis=0)
    middle, reach = 0.5 * (low + high), 0.5 * _REACH * (high - low)
    still = reach == 0.0
    reach[still] = 1e-3 * np.where(middle == 0.0, 1.0, np.abs(middle))[still]
    return Region(centre, whiten, edge, lengths, change, middle, reach)


def _features(past_u: Array, u: Array, y: Array, lengths: Sequence[int], change: Array) -> Array:
    """Averages of the inputs over the samples up to each one, the outputs there, and the root mean
    square of the changes of the inputs over the longest average; what lies before the record is
    taken to change as usual."""
    whole = np.concatenate([past_u, u])
    total = np.concatenate([np.zeros((1, whole.shape[1])), np.cumsum(whole, axis=0)])
    ends = np.arange(len(past_u), len(whole)) + 1
    averages: list[Array] = []
    for length in lengths:
        starts = np.maximum(ends - length, 0)
        averages.append((total[ends] - total[starts]) / (ends - starts)[:, None])
    longest = max(lengths)
    squares = np.concatenate([np.tile(change, (longest, 1)), np.diff(whole, axis=0) ** 2])
    power = np.concatenate([np.zeros((1, whole.shape[1])), np.cumsum(squares, axis=0)])
    ends = ends + longest - 1
    moved = np.sqrt(np.maximum(power[ends] - power[ends - longest], 0.0) / longest)
    return np.concatenate([*averages, y, moved], axis=1)
