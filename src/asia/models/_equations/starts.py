"""Starts of the fit of a grey-box, and initial states from past windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asia.data.trajectory import Array, Trajectory
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.simulate import Scales, WindowPrior, physical_parameters
from asia.models._equations.transport import along_record
from asia.models._least_squares import Minimum
from asia.models._numerics.training_records import measured_weight, rows, side_by_side, spread

if TYPE_CHECKING:
    from asia.models._equations.fit import FittedEquations
    from asia.models._equations.programs import CompiledSimulator

# Starting points of the fit of a grey-box: records cut to segments, draws, screening, scales.

# Coordinates at which an addition has no effect: a limit far above any state, a fraction of zero.
_NO_LIMIT = 20.0
_NO_SPILL = -30.0
_SCREENED_PER_START = 16
_MOST_SCREENED_VALUES = 20_000_000
_MOST_INITIAL_STATES = 240
# Outputs in a short segment for each state, its samples and the number of them, at least.
_VALUES_OF_STATE, _SHORTEST, _FEWEST = 6, 10, 3
# Limit on samples times squared coordinates of one iteration where initial states are measured.
_MOST_WORK, _MEASURED_WINDOWS = 2e9, (60, 400)
# Deviation of drawn parameters relative to their range, which is 2 wide.
_SPREAD_OF_PARAMETERS = 0.3
# Limit beyond any state in any unit, whose sums of squares are still finite.
_OPEN = 1e100
# Parameters drawn for the length of a buffer, and values of a signal for them.
_DRAWN_DELAYS, _MOST_DRAWN_DELAYS = 64, 500_000
# Ratio to the median amplitude at which a start has diverged.
_RUNAWAY = 1e6


class RecordSegments(NamedTuple):
    """Training records, or windows of them, side by side."""

    u: Array  # (S, T, nu)
    y: Array  # (S, T, ny)
    mask: Array  # (S, T), 0 in the padding
    counts: Array  # (S, T, ny), 0 in the padding and where an output was not measured
    noisy: Array  # (S, T, ny), `counts`, 0 too at the measurement that a simulation starts at


class Starts(NamedTuple):
    """Starting points, one a row."""

    z: Array  # Coordinates (P, size)
    shift: Array
    """Differences (P, S, nx) of the initial states from the guess, in units of their scale."""
    x_guess: Array  # Guessed initial states (P, S, nx)
    scales: Scales  # Sizes of the signals, for each start

    def chosen(self, rows: NDArray[np.intp]) -> Starts:
        """Select some starting points."""
        scales = self.scales.of_rows(rows)
        return Starts(self.z[rows], self.shift[rows], self.x_guess[rows], scales)


def cut_segments(
    structure: GreyBoxStructure, trajectories: Sequence[Trajectory], horizon: int | None
) -> RecordSegments:
    """Cut the records to segments.

    They are whole records, or, with a horizon, windows spread over them: past and horizon, or where
    the initial state is measured the last past sample and the horizon.
    """
    cuts: list[Trajectory] = list(trajectories)
    if horizon is not None:
        length = (1 if structure.states_measured else structure.n_past) + horizon
        cuts = [t[k : k + length] for t in trajectories for k in range(0, len(t), length)]
        cuts = [t for t in cuts if len(t) == length] or list(trajectories)
        most = max(1, _MOST_INITIAL_STATES // structure.nx)
        if structure.states_measured:
            each = length * structure.ny * max(structure.layout.size, 1) ** 2
            most = int(np.clip(_MOST_WORK / each, *_MEASURED_WINDOWS))
        cuts = [cuts[i] for i in spread(len(cuts), most)]
    mask = side_by_side([np.ones(len(t)) for t in cuts])
    u = side_by_side([t.u for t in cuts], "edge")
    if structure.states_measured and structure.n_past_u == 0 and u.shape[1] > 1:
        # Hold the first known input, as in simulation, where the last past input is unknown.
        u[:, 0] = u[:, 1]
    counts = side_by_side([measured_weight(t) for t in cuts])
    noisy = counts * (np.arange(counts.shape[1]) >= structure.states_measured)[:, None]
    return RecordSegments(u, side_by_side([t.y for t in cuts], "edge"), mask, counts, noisy)


def with_memory(
    structure: GreyBoxStructure, segments: RecordSegments, z: Array | None = None
) -> GreyBoxStructure:
    """Choose how many samples the buffers of delays hold: for coordinates z (size,), or before a
    fit for the ranges of the parameters, where a signal of a state is delayed."""
    system = structure.equations
    if len(system.delays) == (system.driven if z is None else 0):
        return structure
    u = segments.u.transpose(1, 2, 0)[:, :, None]
    count = int(np.clip(_MOST_DRAWN_DELAYS // u[:, 0].size, 2, _DRAWN_DELAYS))
    shape = (len(structure.ranges), count)
    own = np.random.default_rng(0).uniform(-1.0, 1.0, shape)
    if z is not None:
        own = z[structure.layout.parameters, None]
    with np.errstate(all="ignore"):
        parameters = physical_parameters(structure.ranges, own)
        x = np.zeros((structure.nx, len(u), own.shape[1], u.shape[3]))
        free = replace(structure, memory=())
        found, needed = along_record(free, parameters, u, x)
        hidden = slice(structure.nx_own, structure.nx_own + len(system.rest))
        # A lag at rest follows its signal, which can be that of another one.
        for _ in system.rest:
            x[hidden] = system.at_rest(parameters[..., None], x, found.swapaxes(0, 1))
            found, needed = along_record(free, parameters, u, x)
    return replace(structure, memory=needed)


def short_segments(structure: GreyBoxStructure, segments: RecordSegments) -> RecordSegments | None:
    """Cut segments to short ones, in which a wrong frequency hardly shifts the phase: fits from
    distant starting points converge there. None where the segments are hardly longer, initial
    states are measured, or the equations delay signals."""
    length = max(_SHORTEST, _VALUES_OF_STATE * structure.nx // structure.ny)
    ends = range(length, segments.u.shape[1] + 1, length)
    whole = [(s, k) for k in ends for s in np.flatnonzero(segments.mask[:, k - 1])]
    if structure.states_measured or structure.equations.delays or len(ends) < _FEWEST:
        return None
    chosen = [whole[i] for i in spread(len(whole), max(1, _MOST_INITIAL_STATES // structure.nx))]
    return RecordSegments(
        *(np.stack([values[s, k - length : k] for s, k in chosen]) for values in segments)
    )


def initial_states(structure: GreyBoxStructure, starts: Starts, found: Minimum, i: int) -> Array:
    """Initial states (S, nx) at the end of fit `i`."""
    if structure.states_measured:
        return starts.x_guess[i]
    shift = found.theta[i, structure.layout.size :].reshape(-1, structure.nx)
    return starts.x_guess[i] + shift * starts.scales.x_scale[:, i]


def _base_scales(structure: GreyBoxStructure, segments: RecordSegments) -> Scales:
    """Scales before any state is known."""
    nx, inside = structure.nx, segments.mask > 0

    def deviation(values: Array) -> Array:
        spread = values[inside].std(axis=0)
        return np.where(spread > 0, spread, 1.0)

    return Scales(
        x_center=np.zeros(nx),
        x_scale=np.ones(nx),
        x_max=np.ones(nx),
        rate=np.ones(nx),
        u_center=segments.u[inside].mean(axis=0),
        u_scale=deviation(segments.u),
        y_scale=deviation(segments.y),
        low=np.full(nx, -_OPEN),
        high=np.full(nx, _OPEN),
        hidden=np.zeros((structure.config.residual, structure.nx_own + structure.nu + 1)),
    )


def opened(scales: Scales) -> Scales:
    """Remove the limits outside which the simulation of a trained model counts as diverged."""
    low = np.full_like(np.asarray(scales.low), -_OPEN)
    return scales._replace(low=low, high=-low)


def _neutral_draws(structure: GreyBoxStructure, segments: RecordSegments, count: int) -> Array:
    """Coordinates without effect (P, size), to choose `count` starts from: as many as memory
    allows, at most 16 times."""
    values = segments.mask.size * structure.config.substeps * structure.nx * count
    drawn = count * int(np.clip(_MOST_SCREENED_VALUES // values, 1, _SCREENED_PER_START))
    z = np.zeros((drawn, structure.layout.size))
    z[:, structure.layout.limits] = _NO_LIMIT
    z[:, structure.layout.spill] = _NO_SPILL
    return z


def screen(
    structure: GreyBoxStructure,
    segments: RecordSegments,
    simulate: CompiledSimulator,
    count: int,
    rng: np.random.Generator,
    near: Array | None = None,
) -> Starts:
    """Choose the `count` best of many points drawn in the parameter ranges, one of them the
    middle, and of those near (N, size)."""
    z = _neutral_draws(structure, segments, count)
    shape = (len(z) - 1, len(structure.ranges))
    z[1:, structure.layout.parameters] = rng.uniform(-1.0, 1.0, shape)
    if near is not None:
        z = np.concatenate([near, z[: max(count, len(z) - len(near))]])
    drawn = len(z)
    # Initial states: the first measurement, else the middle of the bounds, else 0.
    low, high = np.array(structure.low), np.array(structure.high)
    closed = np.isfinite(low) & np.isfinite(high)
    middle = np.where(closed, 0.5 * (np.where(closed, low, 0.0) + np.where(closed, high, 0.0)), 0.0)
    first = np.tile(np.clip(middle, low, high), (segments.u.shape[0], 1))
    for state, output in structure.measured_states.items():
        first[:, state] = segments.y[:, 0, output]
    guess = np.tile(first, (drawn, 1, 1))
    base = _base_scales(structure, segments).for_rows(drawn)
    y, states = simulate(z, base, guess)
    center, scale = _spread(states, segments)
    hidden = [i for i in range(structure.nx) if i not in structure.measured_states]
    if hidden:
        guess[:, :, hidden] = center[:, None, hidden]
        y, _ = simulate(z, base, guess)
    scales = base._replace(x_center=center.T, x_scale=scale.T)
    order = _ranking(segments, base, y)
    return Starts(z, np.zeros_like(guess), guess, scales).chosen(order[:count])


def starts_near(
    structure: GreyBoxStructure, segments: RecordSegments, near: Sequence[FittedEquations]
) -> Starts:
    """Starting points at fits of the same layout to other records."""
    each = zip(*(fitted.scales for fitted in near), strict=True)
    scales = opened(Scales(*(np.stack(values, axis=-1) for values in each)))
    # All starts count errors in the same units.
    y_scale = _base_scales(structure, segments).for_rows(len(near)).y_scale
    guess = np.stack([np.tile(f.scales.x_center, (segments.u.shape[0], 1)) for f in near])
    for state, output in structure.measured_states.items():
        guess[:, :, state] = segments.y[:, 0, output]
    z = np.stack([fitted.z for fitted in near])
    return Starts(z, np.zeros_like(guess), guess, scales._replace(y_scale=y_scale))


def _ranking(segments: RecordSegments, scales: Scales, outputs: Array) -> NDArray[np.intp]:
    """Order of the starts from the smallest simulation error to the greatest."""
    with np.errstate(over="ignore", invalid="ignore"):
        error = (outputs - segments.y) / scales.y_scale[:, 0]
        cost = (error**2 * segments.counts).sum(axis=(1, 2, 3))
    return np.argsort(cost, kind="stable")


def _spread(states: Array, segments: RecordSegments) -> tuple[Array, Array]:
    """Mean and standard deviation (P, nx) of simulated states (P, S, T, nx)."""
    inside = states[:, segments.mask > 0]
    deviation = inside.std(axis=1)
    scale = np.maximum(deviation, 1e-3 * np.abs(inside).max(axis=1))
    # A diverging start would make the weight of its own initial state vanish.
    usual = np.median(scale, axis=0)
    scale = np.minimum(scale, np.where(usual > 0, _RUNAWAY * usual, np.inf))
    return inside.mean(axis=1), np.where(scale > 0, scale, 1.0)


def augment(
    structure: GreyBoxStructure,
    segments: RecordSegments,
    simulate: CompiledSimulator,
    starts: Starts,
    found: Minimum,
    rng: np.random.Generator,
) -> Starts:
    """Starting points around the best fits of the bare equations, with the additions drawn."""
    layout, size = structure.layout, structure.layout.size
    count, learned = len(starts.z), len(structure.learned.names)
    plain = _neutral_draws(structure, segments, count)
    drawn = len(plain)
    # Cycle through the better half of the first fits: others have often ended in a poor minimum.
    order = np.argsort(found.cost, kind="stable")[: max(1, count // 2)]
    parents = np.resize(order, drawn)
    z = found.theta[parents, :size].copy()
    x0 = np.stack([initial_states(structure, starts, found, int(i)) for i in parents])
    z[len(order) :, layout.parameters] += rng.normal(
        scale=_SPREAD_OF_PARAMETERS, size=(drawn - len(order), len(structure.ranges))
    )
    plain[:, layout.parameters] = z[:, layout.parameters]
    # Sizes of the states where nothing is added to the equations.
    scales = _base_scales(structure, segments).for_rows(drawn)
    states = simulate(plain, scales, x0)[1]
    center, scale = _spread(states, segments)
    inside, time = segments.mask > 0, structure.sampling_time
    moves = np.diff(states, axis=2)[:, inside[:, 1:]]
    rate = np.sqrt((moves**2).mean(axis=1)) / time
    scales = scales._replace(
        x_center=center.T,
        x_scale=scale.T,
        x_max=states[:, inside].max(axis=1).T,
        rate=np.maximum(rate, 1e-9 * scale / time).T,
    )
    z[:, layout.limits] = rng.uniform(np.log(0.5), 0.0, z[:, layout.limits].shape)
    z[:, layout.spill] = rng.uniform(-2.0, 1.0, z[:, layout.spill].shape)
    z[:, layout.delay] = rng.uniform(0.0, 0.8, z[:, layout.delay].shape)
    if structure.config.drawn:
        z[len(order) :, layout.learned] = rng.normal(size=(drawn - len(order), learned))
    # One start with almost no effect, so that additions do not begin worse than the equations.
    z[0, layout.limits], z[0, layout.spill], z[0, layout.delay] = 0.0, -4.0, 0.0
    ranking = _ranking(segments, scales, simulate(z, scales, x0)[0])
    best = np.concatenate([[0], ranking[ranking != 0]])[:count]
    return Starts(z, np.zeros_like(x0), x0, scales).chosen(best)


def add_network(
    structure: GreyBoxStructure,
    starts: Starts,
    found: Minimum,
    count: int,
    rng: np.random.Generator,
) -> Starts:
    """Repeat the best fit `count` times, each with another first layer of the network."""
    best = int(np.argmin(found.cost))
    inner = structure.nx_own + structure.nu + 1
    z = np.tile(found.theta[best, : structure.layout.size], (count, 1))
    x0 = np.tile(initial_states(structure, starts, found, best), (count, 1, 1))
    hidden = rng.normal(size=(count, structure.config.residual, inner)) / np.sqrt(inner)
    scales = starts.scales.of_rows(best).for_rows(count)
    return Starts(z, np.zeros_like(x0), x0, scales._replace(hidden=hidden.transpose(1, 2, 0)))


# Range of the states, and map from a past window to the state, both learned in training.


# Ridges of the map from a past window to the state. A large one hides the speed in the small
# differences between the outputs of a window.
_WINDOW_RIDGES = (1.0, 1e-2, 1e-4, 1e-6)
# Degrees of freedom that a smaller one than the first must leave, relative to the windows.
_LEAST_FREE = 0.2


def _ridge_weights(phi: Array, target: Array) -> tuple[Array, Array]:
    """Weights (n, m) of a ridge regression of targets (N, m) on phi (N, n), each with the ridge of
    the least error by generalised cross-validation (Golub, Heath and Wahba, Technometrics 21(2),
    1979), and these errors (m,), root mean squares."""
    count = len(phi)
    size, axes = np.linalg.eigh(phi.T @ phi)
    size = np.maximum(size, 0.0)
    found, errors = list[Array](), list[Array]()
    for ridge in _WINDOW_RIDGES:
        free = count - float((size / (size + ridge)).sum())
        if found and free < _LEAST_FREE * count:
            break
        found.append(axes @ ((axes.T @ (phi.T @ target)) / (size + ridge)[:, None]))
        square = ((target - phi @ found[-1]) ** 2).sum(axis=0)
        errors.append(np.sqrt(count * square) / max(free, 1.0))
    best, each = np.argmin(errors, axis=0), np.arange(target.shape[1])
    return np.stack(found)[best, :, each].T, np.stack(errors)[best, each]


def window_prior(
    structure: GreyBoxStructure,
    segments: RecordSegments,
    scales: Scales,
    x: Array,
    y_deviation: Array,
) -> WindowPrior:
    """Ridge regression of the simulated state, `n_fit` samples before the first simulated one, on
    the past window's samples."""
    n_past, inside = structure.n_past, segments.mask > 0
    width = 1 + structure.n_past_u * structure.nu + structure.n_past_y * structure.ny
    y_center = segments.y[inside].mean(axis=0)
    spread = np.maximum(x[inside].std(axis=0), 1e-6 * scales.x_scale)
    prior = WindowPrior(np.zeros((structure.nx, width)), spread, y_center, y_deviation)
    # Every past window, and the state `n_fit` samples before its end.
    windows: list[tuple[Array, Array, Array]] = []
    for u, y, states, live in zip(segments.u, segments.y, x, inside, strict=True):
        ends = np.arange(max(n_past, structure.n_fit), live.sum())
        if len(ends):
            shown_u = u[live][rows(ends - structure.n_past_u, structure.n_past_u)]
            shown_y = y[live][rows(ends - structure.n_past_y, structure.n_past_y)]
            windows.append((shown_u, shown_y, states[live][ends - structure.n_fit]))
    mean = x[inside].mean(axis=0)
    if not windows:
        return prior._replace(mean=np.hstack([mean[:, None], prior.mean[:, 1:]]))
    past_u, past_y, start = (np.concatenate(part) for part in zip(*windows, strict=True))
    phi = np.column_stack(
        [
            np.ones(len(start)),
            ((past_u - scales.u_center) / scales.u_scale).reshape(len(start), -1),
            ((past_y - y_center) / scales.y_scale).reshape(len(start), -1),
        ]
    )
    target = start - mean
    columns, error = _ridge_weights(phi, target)
    weights = columns.T
    weights[:, 0] += mean
    return prior._replace(mean=weights, x_deviation=np.maximum(error, 1e-3 * spread))
