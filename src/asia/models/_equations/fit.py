"""Fit of a grey-box: screening, starts, noise rounds, additions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asia.data.trajectory import Array
from asia.errors import UserError
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.simulate import Scales, WindowPrior
from asia.models._equations.simulation_error import SimulationError
from asia.models._equations.starts import (
    RecordSegments,
    Starts,
    add_network,
    augment,
    initial_states,
    screen,
    short_segments,
    starts_near,
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

# Iterations, and the ratio to the least cost beyond which a start is then given up. In 55 fits to
# the halves of the cascaded tanks the start that won was never beyond 3.1, 1.2 and 1.1.
_RACE = ((10, 5.0), (15, 3.0), (20, 1.5))
# Starts whose trial points are simulated together: more cost as much each, and few are left soon.
_SIDE_BY_SIDE = 4
# Starts that noise rounds go on from: so many, within this ratio of the least cost.
_MOST_UNDER_NOISE, _NEAR = 3, 1.2
# Relative decrease of the cost below which a fit stops that another one goes on from, and one under
# an estimate of the noise. With 1e-9 for both, models of the cascaded tanks take twice as long, and
# V differs by 2 % at most.
_BEFORE, _UNDER_NOISE = 1e-4, 1e-5
# First layers drawn for the residual network: on the tanks eight ended within 1 % of each other.
_NETWORKS = 3


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

    @property
    def n_parameters(self) -> int:
        """Number of fitted parameters."""
        return self.z.size


def fit(
    structure: GreyBoxStructure,
    segments: RecordSegments,
    method: LevenbergMarquardt,
    seed: int,
    log: Callable[[float, float], None] | None = None,
    near: Sequence[FittedEquations] = (),
) -> FittedEquations:
    """Best of `method.starts` fits, in up to three stages; with `near`, fits of the same structure
    to parts of the records, best of the fits of all coordinates from these.

    The first stage fits only the equations, from points drawn in their ranges and screened, and
    from fits to short segments of the records; the second fits the additions from the better half
    of these, with starting points drawn anew; the third fits the residual network, which starts
    without effect, from the best of these.
    With a noise model, the fits before the network and those with it are followed by estimates of
    the noise from the best fit's residuals, and generalised least squares from the best points
    found. The same seed gives bitwise the same result. `log` receives the number of each iteration
    and the least cost of all starting points.

    Raises:
        FloatingPointError: if no starting point gives a finite simulation.
        UserError: if the configuration has a robust loss and the method a noise model.
    """
    rng = np.random.default_rng(seed)
    layout, count = structure.layout, method.starts
    fits = _Fits(structure, segments, method, count, log)
    if near:
        active = np.ones(layout.size)
        starts = starts_near(structure, segments, near)
        starts, found = fits.under_noise(starts, active, fits.best(starts, active))
        if np.isfinite(found.cost).any():
            return fits.finished(starts, found)
    active = np.zeros(layout.size)
    active[layout.parameters] = 1.0
    augmented, residual = structure.config.augmented, structure.config.residual > 0
    later = residual or fits.choice is not None
    short, z = short_segments(structure, segments), None
    if short is not None:
        first = _Fits(structure, short, replace(method, noise_model="white"), count)
        starts = screen(structure, short, first.simulate, count, rng)
        z = first.best(starts, active, _BEFORE).theta[:, : layout.size]
    starts = screen(structure, segments, fits.simulate, count, rng, z)
    found = fits.best(starts, active, _BEFORE if augmented or later else 0.0)
    if augmented:
        active = np.ones(layout.size)
        active[layout.hidden] = active[layout.readout] = 0.0
        starts = augment(structure, segments, fits.simulate, starts, found, rng)
        found = fits.best(starts, active, _BEFORE if later else 0.0)
    starts, found = fits.under_noise(starts, active, found)
    if residual:
        active[:] = 1.0
        starts = add_network(structure, starts, found, min(count, _NETWORKS), rng)
        found = fits.best(starts, active, 0.0 if fits.choice is None else _BEFORE)
        starts, found = fits.under_noise(starts, active, found)
    if not np.isfinite(found.cost).any():
        raise FloatingPointError("grey-box: no starting point gives a finite simulation")
    return fits.finished(starts, found)


def refit(
    structure: GreyBoxStructure,
    segments: RecordSegments,
    starts: Starts,
    method: LevenbergMarquardt,
) -> FittedEquations:
    """Fit all coordinates from one starting point."""
    fits, active = _Fits(structure, segments, method, 1), np.ones(structure.layout.size)
    return fits.finished(*fits.under_noise(starts, active, fits.best(starts, active)))


class _Fits:
    """Fits of one model from all starting points at once, under the last estimate of the noise of
    the outputs; that is None where the method is least squares."""

    def __init__(
        self,
        structure: GreyBoxStructure,
        segments: RecordSegments,
        method: LevenbergMarquardt,
        starts: int,
        log: Callable[[float, float], None] | None = None,
    ) -> None:
        # Import of JAX, which a trained model does not need.
        from asia.models._equations.programs import CompiledSimulator

        self.structure, self.segments, self.method = structure, segments, method
        rows = TRIALS * min(starts, _SIDE_BY_SIDE)
        self.simulate = CompiledSimulator(structure, segments.u, rows)
        self.choice = NoiseChoice.of(method)
        self.noise: ResidualNoise | None = None
        self.weighting: ErrorWeighting | None = None
        # Cost after each iteration, of the best start, one array a fit.
        self.curve: list[Array] = []
        self.log, self.iterations = log, 0
        if self.choice is not None and structure.config.robust is not None:
            raise UserError(
                "greybox.Config: robust is a threshold on simulation errors, and the method weighs "
                "innovations; leave robust out and give LevenbergMarquardt's huber"
            )

    def best(
        self, starts: Starts, active: Array, tolerance: float = 0.0, begin: Array | None = None
    ) -> Minimum:
        """Fit from the starting points, or from theta `begin`; `active` (size,) is 1 where a
        coordinate is free, and `tolerance` acts where it is larger than that of the method."""
        error = SimulationError(
            self.structure, self.segments, starts, active, self.simulate, self.weighting,
            forward=True,
        )  # fmt: skip
        begin = error.theta0 if begin is None else begin

        def watch(_: Array, cost: Array) -> None:
            self.iterations += 1
            if self.log is not None and np.isfinite(cost).any():
                self.log(float(self.iterations), float(cost.min()))

        method = replace(self.method, tolerance=max(tolerance, self.method.tolerance))
        found = minimise(error.cost, error.linearise, begin, method, race=_RACE, after=watch)
        self.curve.append(found.history[np.argmin(found.cost)])
        return found

    def under_noise(self, starts: Starts, active: Array, found: Minimum) -> tuple[Starts, Minimum]:
        """Repeat the fit `found` from its best starts under each estimate of the noise, until it
        has settled; return these starts and the last fit."""
        if self.choice is None:
            return starts, found
        structure, segments = self.structure, self.segments
        mask, time = segments.noisy, structure.sampling_time
        for _ in range(NOISE_ROUNDS):
            if not np.isfinite(found.cost).any():
                break
            _, scales, _, y, _ = self._simulated_best(starts, found)
            residual = (y - segments.y) / scales.y_scale
            floor = np.full(structure.ny, LEAST_DEVIATION)
            noise = estimate_noise(residual, mask, time, self.choice, floor)
            if settled(self.noise, noise):
                break
            self.noise = noise
            self.weighting = ErrorWeighting.of(noise, time, mask, self.choice.huber)
            near = found.cost <= _NEAR * found.cost.min()
            order = np.argsort(found.cost, kind="stable")[: min(near.sum(), _MOST_UNDER_NOISE)]
            starts = starts.chosen(order)
            found = self.best(starts, active, _UNDER_NOISE, found.theta[order])
        return starts, found

    def finished(self, starts: Starts, found: Minimum) -> FittedEquations:
        """Learn from the training simulation the map from a past window to the state, and the range
        outside which a simulation has diverged."""
        structure, segments = self.structure, self.segments
        z, scales, x0, y, x = self._simulated_best(starts, found)
        inside = segments.mask > 0
        low, high = x[inside].min(axis=0), x[inside].max(axis=0)
        rest = np.maximum(1e-3 * np.abs(high), 1e-6 * scales.x_scale)
        span = np.maximum(high - low, rest)
        scales = scales._replace(low=low - 10.0 * span, high=high + 10.0 * span)
        error = np.where(segments.counts > 0, y - segments.y, np.nan).reshape(-1, structure.ny)
        if structure.config.robust is not None:
            deviation = 1.4826 * np.nanmedian(np.abs(error), axis=0)
        else:
            deviation = np.sqrt(np.nanmean(error**2, axis=0))
        deviation = np.maximum(deviation, 1e-3 * scales.y_scale)
        prior = window_prior(structure, segments, scales, x, deviation)
        history = np.concatenate(self.curve)
        return FittedEquations(z, scales, prior, history, self.noise, self.method.huber, x0)

    def _simulated_best(
        self, starts: Starts, found: Minimum
    ) -> tuple[Array, Scales, Array, Array, Array]:
        """Coordinates, scales and initial states of the best fit, its outputs and its states."""
        best = int(np.argmin(found.cost))
        z = found.theta[best, : self.structure.layout.size].copy()
        scales = starts.scales.of_rows(best)
        x0 = initial_states(self.structure, starts, found, best)
        y, x = self.simulate(z[None], scales.for_rows(), x0[None])
        return z, scales, x0, y[0], x[0]
