"""Maximum likelihood of the noise model from the residuals of a fit, in NumPy."""

from __future__ import annotations

import numpy as np

from asia.data import Array
from asia.models._data.cuts import spread
from asia.models._noise.choice import NoiseChoice
from asia.models._noise.whitening import (
    ResidualNoise,
    huber_root,
    innovation_filter,
    innovations,
)

NOISE_ROUNDS = 3
"""Greatest number of noise estimates, each followed by a fit."""
LEAST_DEVIATION = 1e-6
"""Share of the output's deviation below which a residual is rounding."""

# Numbers of candidates: time constants, and ratios of the slow part to the white one, both spaced
# logarithmically.
_TIMES, _RATIOS = 9, 9
_RATIO_LIMITS = (0.1, 100.0)
# Shortest time constant in samples, longest one as a share of the longest segment, and least upper
# bound of it in samples. A longer one would leave the level of the output without weight, which the
# errors of a poor model favour.
_FASTEST, _LONGEST_SHARE, _LEAST_LONGEST = 3.0, 0.25, 20.0
# Rounds of a grid around the best candidate, each with half the spacing.
_ROUNDS, _WAYS = 4, np.array([-1.0, 0.0, 1.0])
_MOST_SAMPLES = 20_000
_SCALE_ROUNDS = 12
_SAME_SIZE, _SAME_TIME = 0.03, 0.1


def estimate_noise(
    residual: Array, mask: Array, sampling_time: float, choice: NoiseChoice, floor: Array
) -> ResidualNoise:
    """Estimate the noise from residuals.

    Without a slow part its size is 0, and so it is where it does not raise the likelihood by more
    than two parameters would by chance (Schwarz, Annals of Statistics 6(2), 1978).

    Args:
        residual: (S, T, ny).
        mask: (S, T), positive where a residual counts.
        sampling_time: in s.
        choice: given and estimated parts.
        floor: least deviation (ny,).
    """
    residual, mask = _some(residual, mask)
    samples = max(float((mask > 0).sum()), 1.0)
    search = _Search(residual, mask, sampling_time, choice.huber)
    still = np.full((1, residual.shape[-1]), sampling_time)
    plain, size = search(still, np.zeros_like(still))
    white = ResidualNoise(still[0], np.zeros_like(floor), np.maximum(size[0], floor))
    if not choice.slow:
        return white
    longest = max(_LONGEST_SHARE * float((mask > 0).sum(axis=1).max()), _LEAST_LONGEST)
    ranges = (_FASTEST * sampling_time, longest * sampling_time), _RATIO_LIMITS
    if choice.time is not None:
        ranges = (choice.time, choice.time), _RATIO_LIMITS
    at, likelihood, size = _best(search, [np.log(r) for r in ranges], residual.shape[-1])
    time, ratio = np.exp(at)
    time = time if choice.time is None else np.full_like(time, choice.time)
    size = np.maximum(size, floor / np.sqrt(1.0 + ratio**2))
    better = plain[0] - likelihood > np.log(samples)
    return ResidualNoise(
        np.where(better, time, white.time),
        np.where(better, ratio * size, white.slow),
        np.where(better, size, white.white),
    )


def _some(residual: Array, mask: Array) -> tuple[Array, Array]:
    """Subset of long data: segments spread over them, and their first part."""
    length = min(residual.shape[1], _MOST_SAMPLES)
    rows = spread(len(residual), max(1, _MOST_SAMPLES // length))
    return residual[rows, :length], mask[rows, :length]


def _best(search: _Search, limits: list[Array], ny: int) -> tuple[Array, Array, Array]:
    """Best candidate: logarithms of time constant and ratio (2, ny), the negative log likelihood
    there (ny,) and the size of the white part (ny,)."""
    axes = [np.linspace(a, b, n) for (a, b), n in zip(limits, (_TIMES, _RATIOS), strict=True)]
    spacing = np.array([axis[1] - axis[0] for axis in axes])
    grid = np.stack([a.ravel() for a in np.meshgrid(*axes, indexing="ij")])
    points = np.repeat(grid[:, :, None], ny, axis=2)
    around = np.stack([a.ravel() for a in np.meshgrid(_WAYS, _WAYS, indexing="ij")])
    low, high = (np.array([limit[i] for limit in limits])[:, None, None] for i in range(2))
    each, rounds = np.arange(ny), 0
    while True:
        values, sizes = search(*np.exp(points))
        best = values.argmin(axis=0)
        at = points[:, best, each]
        if rounds == _ROUNDS:
            return at, values[best, each], sizes[best, each]
        rounds, spacing = rounds + 1, 0.5 * spacing
        points = np.clip(at[:, None] + (around * spacing[:, None])[:, :, None], low, high)


class _Search:
    """Negative log likelihood, its scale at its optimum, of candidates side by side."""

    def __init__(
        self, residual: Array, mask: Array, sampling_time: float, huber: float | None
    ) -> None:
        self._residual, self._mask, self._huber = residual, mask, huber
        self._sampling_time = sampling_time

    def __call__(self, time: Array, ratio: Array) -> tuple[Array, Array]:
        """Evaluate candidates: time and ratio (G, ny) -> likelihoods and sizes of the white part
        (G, ny)."""
        wide = time[:, None], ratio[:, None]
        unit = ResidualNoise(*wide, np.ones_like(wide[0]))
        through = innovation_filter(unit, self._sampling_time, self._mask)
        inside = self._mask[..., None] > 0
        weight = np.where(inside, through.weight, 1.0)
        error = innovations(through, self._residual)
        axes, samples = (1, 2), max(float(inside.sum()), 1.0)
        squares = (error**2).sum(axis=axes)
        tiny = np.finfo(float).tiny
        size = np.sqrt(np.maximum(squares / samples, tiny))
        penalty = 0.5 * samples
        if self._huber is not None:
            for _ in range(_SCALE_ROUNDS):
                scaled = np.abs(error) / size[:, None, None]
                share = np.minimum(1.0, self._huber / np.maximum(scaled, tiny))
                size = np.sqrt(np.maximum((share * error**2).sum(axis=axes) / samples, tiny))
            scaled = np.abs(error) / size[:, None, None]
            penalty = (0.5 * huber_root(scaled, self._huber) ** 2).sum(axis=axes)
        return samples * np.log(size) - np.log(weight).sum(axis=axes) + penalty, size


def settled(before: ResidualNoise | None, after: ResidualNoise) -> bool:
    """Return whether two estimates in a row agree: deviations within 3 %, time constants within 10
    % where there is a slow part."""
    if before is None:
        return False
    unit = np.sqrt(after.variance)
    sizes = [np.abs(a - b) < _SAME_SIZE * unit for a, b in zip(before[1:], after[1:], strict=True)]
    times = np.abs(np.log(after.time / before.time)) < _SAME_TIME
    return bool(np.all(sizes) and np.all(times | (after.slow < _SAME_SIZE * unit)))
