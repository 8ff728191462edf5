"""Weighting of simulation errors by generalised least squares, in NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asia.data import Array
from asia.models._noise.whitening import (
    InnovationFilter,
    ResidualNoise,
    huber_root,
    innovation_filter,
    innovations,
)


@dataclass(frozen=True)
class ErrorWeighting:
    """Whitening of errors.

    Under white noise of one output the result is the error as it was: a ridge
    keeps the deviation that it has beside least squares with residuals of the same variance.
    """

    through: InnovationFilter
    """Filter of the noise model."""
    unit: float
    """Deviation of the residuals, over the outputs in the root mean square."""
    huber: float | None
    """Threshold on the innovations in their deviations."""

    @classmethod
    def of(
        cls, noise: ResidualNoise, sampling_time: float, mask: Array, huber: float | None
    ) -> ErrorWeighting:
        """Make the weighting of errors in the unit of the noise model, where mask (S, T) is
        positive."""
        unit = float(np.sqrt(noise.variance.mean()))
        return cls(innovation_filter(noise, sampling_time, mask), unit, huber)

    def __call__(self, error: Array, part: slice = slice(None)) -> Array:
        """Whiten errors (..., S, T, ny) of some segments; the results are squared."""
        found = innovations(InnovationFilter(*(a[part] for a in self.through)), error)
        if self.huber is not None:
            found = huber_root(found, self.huber)
        return self.unit * found

    def jacobian(self, error: Array, derivatives: Array) -> Array:
        """Derivatives (S, T, ny, P) of the whitened errors, from those of the errors (S, T, ny)."""
        # Column by column, so that the filter's temporary arrays are small.
        columns = [innovations(self.through, column) for column in np.moveaxis(derivatives, -1, 0)]
        found = self.unit * np.stack(columns, axis=-1)
        if self.huber is None:
            return found
        white = innovations(self.through, error)
        root = huber_root(white, self.huber)
        tail = np.abs(white) > self.huber
        slope = np.where(tail, self.huber / np.maximum(np.abs(root), self.huber), 1.0)
        return slope[..., None] * found
