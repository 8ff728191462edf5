"""Noise model of the residual, a slow disturbance plus white noise, and its whitening filter.

The slow part is an Ornstein-Uhlenbeck process, the white part the noise of the sensor. Innovations
of the stationary Kalman filter of that model, divided by their deviations, are white: generalised
least squares minimises the sum of their squares. Written once for NumPy and JAX.
Source: Harvey, Forecasting, Structural Time Series Models and the Kalman Filter, 1989, chapter 3.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from asia.models._arrays import AnyArray, namespace, scan

# Share of a prediction below which it no longer counts.
_FORGOTTEN = 1e-30


class ResidualNoise(NamedTuple):
    """Sizes of the two parts for each output; JAX reads it as a tree of its arrays."""

    time: AnyArray
    """Time constant of the slow part in s (ny,)."""
    slow: AnyArray
    """Standard deviation of the slow part, in the unit of the residuals (ny,)."""
    white: AnyArray
    """Standard deviation of the white part (ny,)."""

    @property
    def variance(self) -> AnyArray:
        """Variance of the residual (ny,)."""
        return self.slow**2 + self.white**2


class InnovationFilter(NamedTuple):
    """Kalman filter of a noise model on given samples, (..., T, ny) each.

    The prediction of the slow part follows s[k+1] = decay[k] s[k] + gain[k] e[k], s[0] = 0.
    """

    decay: AnyArray
    gain: AnyArray
    weight: AnyArray
    """Reciprocal of the deviation of the innovation; 0 where a sample does not count."""


def innovation_filter(
    noise: ResidualNoise, sampling_time: AnyArray, mask: AnyArray
) -> InnovationFilter:
    """Make the Kalman filter for samples that count where mask (..., T) is positive.

    A sample that does not count leaves the filter to its prediction, so that padding and gaps
    change
    no other innovation. Deviations must be positive in sum; all fields may have leading dimensions
    that
    fit those of `mask`.
    """
    xp = namespace(mask, *noise)
    keep = xp.exp(-sampling_time / noise.time)
    slow, white = noise.slow**2, noise.white**2
    counts = xp.moveaxis(mask, -1, 0)[..., None] > 0

    def step(predicted: AnyArray, here: AnyArray) -> tuple[AnyArray, AnyArray]:
        variance = predicted + white
        gain = xp.where(here, predicted / variance, 0.0)
        after = keep**2 * (1.0 - gain) * predicted + (1.0 - keep**2) * slow
        return after, xp.stack([gain, xp.where(here, variance**-0.5, 0.0)])

    start = slow * xp.ones_like(counts[0] * slow)
    _, found = scan(step, start, counts)
    gain, weight = (xp.moveaxis(found[:, i], 0, -2) for i in range(2))
    keep = keep[..., None, :]
    return InnovationFilter(keep * (1.0 - gain), keep * gain, weight)


def innovations(through: InnovationFilter, residual: AnyArray) -> AnyArray:
    """Convert residuals (..., T, ny) to innovations in their deviations, of the same shape.

    The filter's leading dimensions are those of the residuals, or fit them.
    """
    xp = namespace(residual, through.gain)
    decay, predicted = through.decay, through.gain * residual
    shift, samples = 1, residual.shape[-2]
    # predicted[k] becomes the prediction for sample k + 1: recursive doubling, no loop over time.
    while shift < samples:
        carried = decay[..., shift:, :] * predicted[..., :-shift, :]
        later = predicted[..., shift:, :] + carried
        predicted = xp.concatenate([predicted[..., :shift, :], later], axis=-2)
        longer = decay[..., shift:, :] * decay[..., :-shift, :]
        decay = xp.concatenate([decay[..., :shift, :], longer], axis=-2)
        shift *= 2
        if xp is np and np.abs(decay).max() < _FORGOTTEN:
            break
    known = xp.concatenate([xp.zeros_like(predicted[..., :1, :]), predicted[..., :-1, :]], axis=-2)
    return (residual - known) * through.weight


def huber_root(error: AnyArray, threshold: float) -> AnyArray:
    """Convert errors so that their square is Huber's loss: that of the error up to the threshold,
    then growing in proportion to it."""
    xp, size = namespace(error), abs(error)
    tail = xp.sqrt(xp.maximum(2.0 * threshold * size - threshold**2, 1e-12))
    return xp.where(size <= threshold, error, xp.sign(error) * tail)
