"""Fit of a grey-box to records: screening, multi-start, then the additions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from asia.data import Array
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.noise_rounds import NoiseRounds
from asia.models._equations.past_window import window_prior
from asia.models._equations.simulate import Scales, WindowPrior
from asia.models._equations.simulation_error import SimulationError
from asia.models._equations.starts import (
    RecordPieces,
    SegmentSimulator,
    Starts,
    add_network,
    augment,
    initial_states,
    screen,
)
from asia.models._least_squares import TRIALS, LevenbergMarquardt, Minimum, minimise
from asia.models._noise.estimate import NOISE_ROUNDS
from asia.models._noise.whitening import ResidualNoise

if TYPE_CHECKING:
    from asia.models._equations.programs import CompiledSimulator


@dataclass(frozen=True)
class FittedEquations:
    """Result of training a grey-box."""

    z: Array
    """Coordinates (size,)."""
    scales: Scales
    """Sizes of the signals."""
    prior: WindowPrior
    """Map from a past window to the state, with its error."""
    history: Array
    """Cost after each iteration."""
    noise: ResidualNoise | None = None
    """The noise under which it was fitted, in units of `y_scale`; None is least squares, and in
    older models."""
    huber: float | None = None
    """Threshold on the innovations of that noise."""
    x0: Array | None = None
    """Initial states (S, nx) of the records as the fit cut them; None in older models."""


def fit(
    structure: GreyBoxStructure, segments: RecordPieces, method: LevenbergMarquardt, seed: int
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
    structure: GreyBoxStructure, segments: RecordPieces, starts: Starts, method: LevenbergMarquardt
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
    segments: RecordPieces
    method: LevenbergMarquardt
    simulate: CompiledSimulator
    noise: NoiseRounds
    curve: list[Array]
    """Cost after each iteration, of the best start, one array a fit."""

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
    segments: RecordPieces,
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
