"""Estimates of the noise model between the fits of a grey-box."""

from __future__ import annotations

import numpy as np

from asia.errors import UserError
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.starts import RecordPieces, SegmentSimulator, Starts, initial_states
from asia.models._least_squares import LevenbergMarquardt, Minimum
from asia.models._noise.choice import NoiseChoice
from asia.models._noise.estimate import LEAST_DEVIATION, estimate_noise, settled
from asia.models._noise.weighting import ErrorWeighting
from asia.models._noise.whitening import ResidualNoise


class NoiseRounds:
    """Last estimate of the noise of the outputs; None where the method is least squares.

    Raises:
        UserError: if the configuration has a robust loss of its own.
    """

    def __init__(
        self,
        structure: GreyBoxStructure,
        segments: RecordPieces,
        simulate: SegmentSimulator,
        method: LevenbergMarquardt,
    ) -> None:
        self._structure, self._segments, self._simulate = structure, segments, simulate
        self._choice = NoiseChoice.of(method)
        self.noise: ResidualNoise | None = None
        self.weighting: ErrorWeighting | None = None
        if self._choice is not None and structure.config.robust is not None:
            raise UserError(
                "greybox.Config: robust is a threshold on simulation errors, and the method weighs "
                "innovations; leave robust out and give LevenbergMarquardt's huber"
            )

    def estimate(self, starts: Starts, found: Minimum) -> bool:
        """Estimate the noise from the residuals of the best fit.

        Returns:
            False where nothing is estimated or the estimate has settled.
        """
        if self._choice is None or not np.isfinite(found.cost).any():
            return False
        structure, segments, best = self._structure, self._segments, int(np.argmin(found.cost))
        z, scales = found.theta[best, : structure.layout.size], starts.scales.of_rows(best)
        x0 = initial_states(structure, starts, found, best)
        y = self._simulate(z[None], scales.for_rows(), x0[None])[0][0]
        mask, floor = segments.counts, np.full(structure.ny, LEAST_DEVIATION)
        if structure.measured:
            # The first error is zero, since the simulation starts at the first measurement.
            mask = mask * (np.arange(mask.shape[1]) > 0)
        time = structure.sampling_time
        residual = (y - segments.y) / scales.y_scale
        noise = estimate_noise(residual, mask, time, self._choice, floor)
        if settled(self.noise, noise):
            return False
        self.noise = noise
        self.weighting = ErrorWeighting.of(noise, time, mask, self._choice.huber)
        return True
