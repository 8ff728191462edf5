"""Fit of a grey-box: screening, starts, noise rounds, additions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from asia.data.trajectory import Array
from asia.errors import UserError
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.simulate import Scales, WindowPrior
from asia.models._equations.simulation_error import SimulationError
from asia.models._equations.starts import (
    RecordSegments,
    SegmentSimulator,
    Starts,
    add_network,
    augment,
    initial_states,
    screen,
    window_prior,
)
from asia.models._least_squares import TRIALS, LevenbergMarquardt, Minimum, minimise
from asia.models._noise.model import (
    LEAST_DEVIATION,
    NOISE_ROUNDS,
    ErrorWeighting,
    NoiseChoice,
    ResidualNoise,
    estimate_noise,
    settled,
)

if TYPE_CHECKING:
    from asia.models._equations.programs import CompiledSimulator


# Estimates of the noise model between the fits of a grey-box.


class NoiseRounds:
    """Last estimate of the noise of the outputs; None where the method is least squares.

    Raises:
        UserError: if the configuration has a robust loss of its own.
    """

    def __init__(
        self,
        structure: GreyBoxStructure,
        segments: RecordSegments,
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


# Fit of a grey-box to records: screening, multi-start, then the additions.


@dataclass(frozen=True)
class FittedEquations:
    """Result of training a grey-box."""

    z: Array  # Coordinates (size,)
    scales: Scales  # Sizes of the signals
    prior: WindowPrior  # Map from a past window to the state, with its error
    history: Array  # Cost after each iteration
    noise: ResidualNoise | None = None
    """The noise under which it was fitted, in units of `y_scale`; None is least squares, and in
    older models."""
    huber: float | None = None  # Threshold on the innovations of that noise
    x0: Array | None = None
    """Initial states (S, nx) of the records as the fit cut them; None in older models."""


def fit(
    structure: GreyBoxStructure, segments: RecordSegments, method: LevenbergMarquardt, seed: int
) -> FittedEquations:
    """Best of `method.starts` fits, in up to three stages.

    The first stage fits only the equations, from points drawn in their ranges and screened; the
    second
    fits the additions from the better half of these, with starting points drawn anew; the third
    fits the residual network, which starts without effect, from the best of these.
    With a noise model, the fits before the network and those with it are followed by estimates of
    the noise from the best fit's residuals, and generalised least squares from all points found.
    The same seed gives bitwise the same result.

    Raises:
        FloatingPointError: if no starting point gives a finite simulation.
    """
    # Import of JAX, which a trained model does not need.
    from asia.models._equations.programs import CompiledSimulator

    rng = np.random.default_rng(seed)
    layout, count = structure.layout, method.starts
    simulate = CompiledSimulator(structure, segments.u, TRIALS * count)
    noise = NoiseRounds(structure, segments, simulate, method)
    stages = _Stages(structure, segments, method, simulate, noise, [])
    active = np.zeros(layout.size)
    active[layout.parameters] = 1.0
    starts = screen(structure, segments, simulate, count, rng)
    found = stages.best_fits(starts, active)
    if structure.config.augmented:
        active = np.ones(layout.size)
        active[layout.hidden] = active[layout.readout] = 0.0
        starts = augment(structure, segments, simulate, starts, found, rng)
        found = stages.best_fits(starts, active)
    found = stages.under_noise(starts, active, found)
    if structure.config.residual:
        starts, active = add_network(structure, starts, found, rng), np.ones(layout.size)
        found = stages.under_noise(starts, active, stages.best_fits(starts, active))
    if not np.isfinite(found.cost).any():
        raise FloatingPointError("grey-box: no starting point gives a finite simulation")
    fitted = _finish(structure, segments, simulate, starts, found, np.concatenate(stages.curve))
    return replace(fitted, noise=noise.noise, huber=method.huber)


def refit(
    structure: GreyBoxStructure,
    segments: RecordSegments,
    starts: Starts,
    method: LevenbergMarquardt,
) -> FittedEquations:
    """Fit all coordinates from one starting point."""
    from asia.models._equations.programs import CompiledSimulator

    simulate = CompiledSimulator(structure, segments.u, TRIALS)
    noise = NoiseRounds(structure, segments, simulate, method)
    stages = _Stages(structure, segments, method, simulate, noise, [])
    active = np.ones(structure.layout.size)
    found = stages.under_noise(starts, active, stages.best_fits(starts, active))
    fitted = _finish(structure, segments, simulate, starts, found, np.concatenate(stages.curve))
    return replace(fitted, noise=noise.noise, huber=method.huber)


@dataclass(frozen=True)
class _Stages:
    """Fits of one model, from all starting points at once."""

    structure: GreyBoxStructure
    segments: RecordSegments
    method: LevenbergMarquardt
    simulate: CompiledSimulator
    noise: NoiseRounds
    curve: list[Array]  # Cost after each iteration, of the best start, one array a fit

    def best_fits(self, starts: Starts, active: Array) -> Minimum:
        """Fit from the starting points; `active` (size,) is 1 where a coordinate is free."""
        return self._minimum(starts, active, None)

    def under_noise(self, starts: Starts, active: Array, found: Minimum) -> Minimum:
        """Repeat the fit `found` under each estimate of the noise."""
        for _ in range(NOISE_ROUNDS):
            if not self.noise.estimate(starts, found):
                break
            found = self._minimum(starts, active, found.theta)
        return found

    def _minimum(self, starts: Starts, active: Array, theta: Array | None) -> Minimum:
        error = SimulationError(
            self.structure, self.segments, starts, active, self.simulate, self.noise.weighting
        )
        begin = error.theta0 if theta is None else theta
        found = minimise(error.cost, error.linearise, begin, self.method)
        self.curve.append(found.history[np.argmin(found.cost)])
        return found


def _finish(
    structure: GreyBoxStructure,
    segments: RecordSegments,
    simulate: SegmentSimulator,
    starts: Starts,
    found: Minimum,
    history: Array,
) -> FittedEquations:
    """Learn from the training simulation the map from a past window to the state, and the range
    outside which a simulation has diverged."""
    best = int(np.argmin(found.cost))
    z = found.theta[best, : structure.layout.size].copy()
    scales = starts.scales.of_rows(best)
    x0 = initial_states(structure, starts, found, best)
    y, x = (part[0] for part in simulate(z[None], scales.for_rows(), x0[None]))
    inside = segments.mask > 0
    low, high = x[inside].min(axis=0), x[inside].max(axis=0)
    rest = np.maximum(1e-3 * np.abs(high), 1e-6 * scales.x_scale)
    span = np.maximum(high - low, rest)
    scales = scales._replace(low=low - 10.0 * span, high=high + 10.0 * span)
    deviation = _deviation(structure, (y - segments.y)[segments.counts > 0])
    deviation = np.maximum(deviation, 1e-3 * scales.y_scale)
    prior = window_prior(structure, segments, scales, x, deviation)
    return FittedEquations(z, scales, prior, history, x0=x0)


def _deviation(structure: GreyBoxStructure, error: Array) -> Array:
    """Size of the simulation error (N, ny) per output, robust to outliers where the loss is."""
    if structure.config.robust is not None:
        return 1.4826 * np.median(np.abs(error), axis=0)
    return np.sqrt((error**2).mean(axis=0))
