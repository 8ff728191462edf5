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
# How far beyond the training the changes of an input may go, as a share of the largest there.
_FASTER = 1.1


@dataclass(frozen=True)
class Region:
    """A cloud of training samples, described by moving averages of the inputs and the outputs; the
    range of each signal; and how fast the inputs change."""

    centre: Array
    """(features,)."""
    whiten: Array
    """(features, features): (x - centre) @ whiten has unit covariance over the cloud."""
    edge: float
    """The distance that 99 % of the cloud lies within."""
    lengths: tuple[int, ...]
    """Lengths of the moving averages, in samples."""
    mean: Array
    """(nu,): mean of each input."""
    change: Array
    """Mean square (nu,) of the change of each input from sample to sample."""
    fastest: Array
    """(nu,): the root mean square, over the longest average, of the changes of each input that is
    inside; infinite for an input that never changes."""
    middle: Array
    """(nu + ny,): the middle of the range of each input and output."""
    reach: Array
    """(nu + ny,): how far from the middle a signal is inside."""

    def distance(self, past_u: Array, u: Array, y: Array) -> Array:
        """Distance (H,) of each sample over that of the edge: above 1 is outside. The largest of
        the Mahalanobis distance from the cloud, the distance of any signal from the middle of its
        range, and how fast any input changes. past_u (n, nu), u (H, nu), y (H, ny), measured or
        simulated."""
        features = _features(past_u, u, y, self.lengths, self.mean)
        far = np.linalg.norm((features - self.centre) @ self.whiten, axis=1) / self.edge
        signals = np.concatenate([u, y], axis=1)
        beyond = np.max(np.abs(signals - self.middle) / self.reach, axis=1)
        fast = np.max(_changes(past_u, u, max(self.lengths), self.change) / self.fastest, axis=1)
        return np.maximum(np.maximum(far, beyond), fast)


def region_of(records: Sequence[tuple[Array, Array]]) -> Region:
    """The region of training records (u (N, nu), y (N, ny))."""
    samples = sum(len(u) for u, _ in records)
    lengths = tuple(n for n in _LENGTHS if n == 1 or _SHORTEST_CLOUD * n <= samples)
    mean = np.concatenate([u for u, _ in records]).mean(axis=0)
    cloud = np.concatenate([_features(u[:0], u, y, lengths, mean) for u, y in records])
    centre = cloud.mean(axis=0)
    covariance = np.atleast_2d(np.cov(cloud, rowvar=False, bias=True))
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
    steps = [np.diff(u, axis=0) ** 2 for u, _ in records]
    change = np.concatenate(steps).sum(axis=0) / max(1, sum(map(len, steps)))
    moved = [_changes(u[:0], u, max(lengths), change) for u, _ in records]
    fastest = _FASTER * np.concatenate(moved).max(axis=0)
    fastest[fastest == 0.0] = np.inf
    return Region(centre, whiten, edge, lengths, mean, change, fastest, middle, reach)


def _features(past_u: Array, u: Array, y: Array, lengths: Sequence[int], usual: Array) -> Array:
    """Average the inputs over the samples up to each one, and append the outputs there.

    Args:
        usual: (nu,) assumed inputs before the past window
    """
    whole = np.concatenate([past_u, u])
    averages = [_average(whole, length, usual)[len(past_u) :] for length in lengths]
    return np.concatenate([*averages, y], axis=1)


def _changes(past_u: Array, u: Array, length: int, usual: Array) -> Array:
    """Compute the root mean square (H, nu) of the input changes over the last `length` samples.

    Args:
        usual: (nu,) mean square of the changes, assumed before the past window
    """
    whole = np.concatenate([past_u, u])
    squares = np.diff(whole, axis=0, prepend=whole[:1]) ** 2
    squares[0] = usual
    return np.sqrt(np.maximum(_average(squares, length, usual), 0.0))[len(past_u) :]


def _average(values: Array, length: int, before: Array) -> Array:
    """Compute the moving average (N, n) over the `length` samples up to each one.

    Args:
        before: (n,) values in place of the samples before the first
    """
    whole = np.concatenate([np.tile(before, (length - 1, 1)), values])
    total = np.concatenate([np.zeros((1, whole.shape[1])), np.cumsum(whole, axis=0)])
    return (total[length:] - total[:-length]) / length
