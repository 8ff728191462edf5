"""Inputs between samples: held, linear, or on a curve through the last four samples.

All are causal: inputs up to a sample decide the state there. The curve is the cubic through the
samples at the ends of an interval and the two before it (Lagrange), which follows a band-limited
input closer than a line does.
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
_MEMORY: Final[dict[Intersample, int]] = {"zero": 0, "first": 1, "band_limited": 3}


@dataclass(frozen=True)
class Between:
    """Behaviour of each input between its samples."""

    kinds: tuple[Intersample, ...]

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
        each = np.stack([interpolation(kind, times, self.memory) for kind in self.kinds], axis=-1)
        return each.reshape(*each.shape, *(1,) * (axes - 2))


def interpolation(kind: Intersample, times: Array, memory: int) -> Array:
    """Weights (..., memory + 1) of the samples up to the end of an interval, the oldest first, in
    the input at relative times (...) of the interval, from 0 to 1."""
    found = np.zeros((*times.shape, memory + 1))
    nodes = np.arange(-_MEMORY[kind], 1) + 1.0
    if kind == "zero":
        found[..., max(memory - 1, 0)] = 1.0
        return found
    for k, node in enumerate(nodes):
        others = np.delete(nodes, k)
        weights = ((times[..., None] - others) / (node - others)).prod(axis=-1)
        found[..., memory + 1 - len(nodes) + k] = weights
    return found


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
    return Between(kinds)
