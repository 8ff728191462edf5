"""Inputs between samples: held, linear, or on a curve through the last eight samples.

All are causal: inputs up to a sample decide the state there. The curve of a band-limited input is
the best linear prediction from the samples at the ends of an interval and the six before it, for a
signal with the spectrum of the records (Wiener, Extrapolation, Interpolation, and Smoothing of
Stationary Time Series, 1949).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from asia.data.statistics import staircases
from asia.data.trajectory import Array, Intersample, Signal, Trajectory
from asia.errors import UserError
from asia.models._arrays import AnyArray

# Samples before the end of an interval that decide the input in it; a held input is known at the
# start.
_MEMORY: Final[dict[Intersample, int]] = {"zero": 0, "first": 1, "band_limited": 7}
# Equal bands of a spectrum, from zero to half the sampling frequency, and the least share of one:
# what records lack must not have large weights.
_BANDS, _LEAST_SHARE = 32, 1e-6


@dataclass(frozen=True)
class Between:
    """Behaviour of each input between its samples."""

    kinds: tuple[Intersample, ...]
    spectra: tuple[tuple[float, ...], ...] = ()
    """Shares of the power of each input in equal bands from zero to half the sampling frequency,
    without its mean; () is all power in the lower half. Read for band-limited inputs."""

    @cached_property
    def memory(self) -> int:
        """Number of samples before the end of an interval that are read; 0 where all inputs are
        held, so that an interval is known at its start."""
        return max((_MEMORY[kind] for kind in self.kinds), default=0)

    def windows(self, u: AnyArray) -> AnyArray:
        """Samples (T, memory + 1, nu, ...) of inputs u (T, nu, ...) that decide the interval after
        each sample, the oldest first; first and last sample are held outside."""
        if not self.memory:
            return u[:, None]
        last, sample = len(u) - 1, np.arange(len(u))[:, None]
        return u[np.clip(sample + 1 + np.arange(-self.memory, 1), 0, last)]

    def stages(self, window: AnyArray, substeps: int) -> AnyArray:
        """Inputs (substeps, 3, nu, ...) at the start, the middle and the end of equal parts of an
        interval, from its window (memory + 1, nu, ...)."""
        return (self._weights(substeps, window.ndim) * window).sum(axis=2)

    def start(self, window: AnyArray) -> AnyArray:
        """Inputs (nu, ...) at the start of an interval."""
        return window[max(self.memory - 1, 0)]

    def _weights(self, substeps: int, axes: int) -> Array:
        times = (np.arange(substeps)[:, None] + np.array([0.0, 0.5, 1.0])) / substeps
        shown = self.spectra or ((1.0, 0.0),) * len(self.kinds)
        each = [
            interpolation(kind, times, self.memory, spectrum)
            for kind, spectrum in zip(self.kinds, shown, strict=True)
        ]
        found = np.stack(each, axis=-1)
        return found.reshape(*found.shape, *(1,) * (axes - 2))


def interpolation(
    kind: Intersample, times: Array, memory: int, spectrum: Sequence[float] = (1.0, 0.0)
) -> Array:
    """Weights (..., memory + 1) of the samples up to the end of an interval, the oldest first, in
    the input at relative times (...) of the interval, from 0 to 1, for shares of power as in
    `Between.spectra`."""
    found = np.zeros((*times.shape, memory + 1))
    if kind == "zero":
        found[..., max(memory - 1, 0)] = 1.0
    elif kind == "first":
        found[..., -2], found[..., -1] = 1.0 - times, times
    else:
        nodes = np.arange(-_MEMORY[kind], 1) + 1.0
        size = len(nodes)
        # The last row demands that a constant input stays one.
        system = np.ones((size + 1, size + 1))
        system[:size, :size] = _correlation(nodes[:, None] - nodes, spectrum)
        system[size, size] = 0.0
        right = np.ones((*times.shape, size + 1))
        right[..., :size] = _correlation(times[..., None] - nodes, spectrum)
        found[..., memory + 1 - size :] = (right @ np.linalg.inv(system))[..., :size]
    return found


def _correlation(lags: Array, spectrum: Sequence[float]) -> Array:
    """Correlation (...) of a signal at lags (...) in samples, from shares of power in bands."""
    shares = np.array(spectrum) + _LEAST_SHARE
    width = 0.5 / len(shares)
    middle = width * (np.arange(len(shares)) + 0.5)
    bands = np.cos(2.0 * np.pi * lags[..., None] * middle) * np.sinc(width * lags[..., None])
    return bands @ (shares / shares.sum())


def _spectra(records: Sequence[Trajectory]) -> tuple[tuple[float, ...], ...]:
    """Shares of the power of each input in equal bands, for `Between`."""
    found = np.zeros((_BANDS, records[0].u.shape[1]))
    for record in records:
        moved = (record.u - record.u.mean(axis=0)) * np.hanning(len(record))[:, None]
        power = np.abs(np.fft.rfft(moved, axis=0)) ** 2
        place = np.minimum(np.arange(len(power)) * _BANDS * 2 // len(record), _BANDS - 1)
        np.add.at(found, place, power)
    shares = found / np.maximum(found.sum(axis=0), np.finfo(float).tiny)
    return tuple(tuple(map(float, column)) for column in shares.T)


def inputs_of(
    source: str, inputs: Sequence[Signal], records: Sequence[Trajectory]
) -> tuple[Intersample, ...]:
    """Behaviour of each input between samples in the model of a candidate, from its source and the
    records it was fitted to."""
    from asia.recipe import read_recipe

    recipe = read_recipe(source)
    stated = None if recipe is None else recipe.get("intersample")
    return between(inputs, records, next((k for k in _MEMORY if k == stated), None)).kinds


def between(
    inputs: Sequence[Signal], records: Sequence[Trajectory], others: Intersample | None
) -> Between:
    """Choose the behaviour of each input: that of the problem file; without one a staircase is
    held, and `others` is for the rest, None to hold them.

    Raises:
        UserError: for `others` = "band_limited" where the inputs are not sampled regularly
    """
    held = staircases(records)
    kinds = tuple[Intersample, ...](
        "zero"
        if signal.role == "time_step"
        else signal.intersample or ("zero" if stairs else others or "zero")
        for signal, stairs in zip(inputs, held, strict=True)
    )
    if "band_limited" in kinds and any(s.role == "time_step" for s in inputs):
        raise UserError(
            'intersample = "band_limited" needs one sampling time: give "first" or "zero" with '
            "irregular samples"
        )
    return Between(kinds, _spectra(records) if "band_limited" in kinds else ())
