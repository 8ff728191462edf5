"""Responses of outputs to inputs by the level of a signal: gain, dead time and time constant.

One least-squares fit has the impulse responses from all inputs, each with coefficients interpolated
between three levels of one signal, an input or the linear simulation of an output. The response at
lag `t` belongs to the mean of that signal over the last `t` samples. So a transport or a lag whose
pace is an input is exact: exp(-integral of the pace). Changes of inputs cause changes of the output
(velocity form: D. J. Leith and W. E. Leithead, Gain-scheduled and nonlinear systems, International
Journal of Control 70, 1998), which makes the response the one around each level.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from asia.data.process import once_for_records
from asia.data.statistics import FALSE_ALARMS, feedback, integrating
from asia.data.trajectory import Array, Mask, Signal, Trajectory, is_constant

# Quantiles of the signal that are the levels; blocks for tests and errors; most samples.
_LEVELS, _BLOCKS, _MOST_SAMPLES = (0.1, 0.5, 0.9), 24, 20_000
# Longest response in samples, and nodes of a response: least number, and number in each octave of
# the lags. What changes with the level has half of them.
_LONGEST, _FEWEST_NODES, _OCTAVE = 400, 4, 4
# Samples of a record, and share of all samples that the longest response has.
_LEAST_SAMPLES, _LARGEST_SHARE = 64, 1 / 8
# Autoregression of the disturbance, ridge (share of the mean square of a regressor), sign changes
# for a distribution, draws for errors.
_NOISE_LAGS, _RIDGE, _FLIPS, _DRAWS = 10, 1e-2, 10_000, 200
# Pairs of signals and numbers of samples for a regressor beyond which nothing is estimated.
_MOST_PAIRS, _SAMPLES_EACH = 12, 4
# Two-point method: C. L. Smith, Digital Computer Process Control, 1972.
_EARLY, _LATE = 0.283, 0.632
# A delay of fewer samples at the lowest level is as good as constant.
_LEAST_DELAY = 2.0
# Standard errors between the values at two levels from which they differ.
_DIFFERENT = 3.0


Kind = Literal["input", "output"]


@dataclass(frozen=True)
class ByLevel:
    """One quantity at three levels.

    Attributes:
        values, errors: (3,) with their standard errors; nan where it is not known.
        change, change_error: value at the highest less that at the lowest level, and its error.
        power, power_error: exponent of the level in the quantity, and its error; nan where level or
            quantity change sign.
    """

    values: Array
    errors: Array
    change: float
    change_error: float
    power: float
    power_error: float

    @property
    def changes(self) -> bool:
        """Whether the value depends on the level by more than chance."""
        return abs(self.change) > _DIFFERENT * self.change_error


@dataclass(frozen=True)
class LevelResponse:
    """Response of an output to an input that depends on the level of a signal.

    Attributes:
        output, input: numbers of the two.
        of: kind of the signal whose level counts. signal: its number.
        levels: (3,), 10 %, 50 % and 90 % quantiles, in its unit.
        chance: probability of such evidence in a linear system, over all outputs and signals.
        share: share of the one-step error of the linear model that the dependence explains in
            blocks left out; the same for all inputs of one output and signal.
        gain: output over input, of the rate of an output that integrates.
        delay, time_constant: in samples; 0 where the response starts before the next sample.
        steps: (3, lags + 1) response to a step at each level.
    """

    output: int
    input: int
    of: Kind
    signal: int
    levels: Array
    chance: float
    share: float
    gain: ByLevel
    delay: ByLevel
    time_constant: ByLevel
    steps: Array


def pacing_input(records: Sequence[Trajectory]) -> int | None:
    """Number of the input that sets a delay: positive, and the delay of a response falls as it
    grows, as in a pipe or on a belt; None without one."""
    for one in level_responses(records):
        paced = one.of == "input" and min(r.u[:, one.signal].min() for r in records) > 0
        delay = one.delay
        if paced and delay.changes and delay.change < 0 and delay.values[0] > _LEAST_DELAY:
            return one.signal
    return None


def describe_levels(
    records: Sequence[Trajectory], inputs: Sequence[Signal], outputs: Sequence[Signal]
) -> list[str]:
    """Sentences on the responses that depend on a level, with the quantities that change."""
    lines: list[str] = []
    for one in level_responses(records):
        signal = (inputs if one.of == "input" else outputs)[one.signal]
        output, given, name = outputs[one.output], inputs[one.input], signal.name
        low, _, high = one.levels
        gain = f"{output.unit or '1'}/{given.unit or '1'}" if output.unit or given.unit else ""
        rows = ("gain", one.gain, gain), ("delay", one.delay, "samples")
        rows = *rows, ("time constant", one.time_constant, "samples")
        texts = [_change(what, q, unit, name) for what, q, unit in rows if q.changes]
        if texts:
            lines.append(
                f"response of output {output.name} to input {given.name} depends on the level of "
                f"{one.of} {name} ({low:.3g} to {high:.3g} {signal.unit}".rstrip()
                + f"), which explains {one.share:.0%} of a linear model's one-step error: "
                + "; ".join(texts)
            )
    return lines


def _change(what: str, of: ByLevel, unit: str, name: str) -> str:
    first, last = (f"{of.values[k]:.3g} ± {of.errors[k]:.1g}" for k in (0, 2))
    how = "changes sign" if of.values[0] * of.values[2] < 0 else (
        "rises" if abs(of.values[2]) > abs(of.values[0]) else "falls"
    )  # fmt: skip
    text = f"{what} {how} from {first} to {last} {unit}".rstrip()
    if np.isfinite(of.power):
        text += f", as {name}^({of.power:.2f} ± {of.power_error:.1g})"
    return text


@once_for_records
def level_responses(records: tuple[Trajectory, ...]) -> tuple[LevelResponse, ...]:
    """Find the responses that depend on a level; one false alarm in a hundred files.

    For each output the signal counts whose level explains most. Outputs that inputs follow (closed
    loop) are left out, as are records with few samples for so many signals.

    The test multiplies the gradients of the error in different blocks: what one part of the records
    says of the dependence has to hold in the others. Signs of the errors in blocks are changed at
    random, and the linear part is fitted again, for the distribution under chance (wild bootstrap).
    """
    nu, ny = records[0].u.shape[1], records[0].y.shape[1]
    used = _first(records)
    if not used or nu * ny > _MOST_PAIRS:
        return ()
    u = np.concatenate([r.u for r in used])
    moving = [j for j in range(nu) if not is_constant(u[:, j])]
    found: list[list[tuple[_Dependence, _Linear]]] = []
    for i in range(ny) if moving else ():
        linear = None
        if not is_constant(np.concatenate([r.y[:, i] for r in used])):
            linear = _linear(_motions(used, i, moving, rate=i in integrating(records)), i)
        if linear is None:
            continue
        signals: list[tuple[Kind, int, list[Array]]] = [
            ("input", j, [r.u[:, j] for r in used]) for j in moving
        ]
        if not linear.motions.rate:
            signals.append(("output", i, linear.simulated()))
        found.append([(_dependence(linear, *signal), linear) for signal in signals])
    family, best = sum(map(len, found)), list[LevelResponse]()
    for each in found:
        sure = [one for one in each if one[0].chance * family < FALSE_ALARMS]
        if not sure:
            continue
        dependence, linear = max(sure, key=lambda one: one[0].share)
        if not (feedback(records)[:, linear.output] < FALSE_ALARMS).any():
            best += _described(dependence, linear, moving, family)
    return tuple(best)


def _first(records: Sequence[Trajectory]) -> list[Trajectory]:
    """First samples of each record, up to a number of all."""
    most = max(_MOST_SAMPLES // len(records), _LEAST_SAMPLES)
    return [r[:most] for r in records if len(r) >= _LEAST_SAMPLES]


# Regressors.


def _lag_nodes(longest: int) -> list[int]:
    """Lags between which coefficients are interpolated; the response is 0 from the last one on."""
    nodes = [0]
    while nodes[-1] < longest:
        nodes.append(max(nodes[-1] + 1, round(nodes[-1] * 2.0 ** (1.0 / _OCTAVE))))
    return nodes


def _weights(nodes: Sequence[int]) -> Array:
    """Weights (lags, nodes - 1) of all nodes but the last, by linear interpolation."""
    lags = np.arange(float(nodes[-1]))
    return np.stack([np.interp(lags, nodes, row) for row in np.eye(len(nodes))[:-1]], axis=1)


def _half(nodes: Sequence[int]) -> list[int]:
    """Every other node and the last one."""
    return [*nodes[:-1:2], nodes[-1]]


def _moving_means(signal: Array) -> Callable[[int], Array]:
    """Means (T,) of a signal over the last `lag + 1` samples, held before the first."""
    sums, place = np.concatenate([[0.0], np.cumsum(signal)]), np.arange(len(signal))

    def of(lag: int) -> Array:
        early = signal[0] * np.maximum(lag - place, 0)
        return (sums[place + 1] - sums[np.maximum(place - lag, 0)] + early) / (lag + 1)

    return of


def _regressors(moves: Array, weights: Array, by: Callable[[int], Array] | None = None) -> Array:
    """Sums over the lags of moves (T, nu), weights (lags, nodes) and functions (T, m) of each
    lag -> (T, nu * nodes * m)."""
    many = 1 if by is None else by(0).shape[1]
    found = np.zeros((moves.shape[1], weights.shape[1], many, len(moves)))
    for lag, row in enumerate(weights[: len(moves)]):
        functions = np.ones((1, len(moves))) if by is None else by(lag).T
        for j, values in enumerate(moves.T):
            product = values[: len(values) - lag] * functions[:, lag:]
            for n in np.flatnonzero(row):
                found[j, n, :, lag:] += row[n] * product
    return found.reshape(-1, len(moves)).T


# Linear part.


@dataclass(frozen=True)
class _Motions:
    """Changes of inputs (T, nu), in their deviations, and of an output (T,), by record; nan where
    it was not measured."""

    u: list[Array]
    y: list[Array]
    size: Array
    inputs: list[Array]
    """(T, nu), less their means, in their deviations."""
    mean: float
    """Mean of the output."""
    rate: bool
    """Whether inputs, not their changes, change the output."""


def _motions(
    records: Sequence[Trajectory], output: int, moving: Sequence[int], *, rate: bool
) -> _Motions:
    u = [r.u[:, moving] for r in records]
    both = np.concatenate(u)
    mean, size = both.mean(axis=0), both.std(axis=0)
    scaled = [(v - mean) / size for v in u]
    targets: list[Array] = []
    for r in records:
        target = np.diff(r.y[:, output], prepend=r.y[0, output])
        if r.missing is not None:
            lost = r.missing[:, output]
            target[lost | np.concatenate([[True], lost[:-1]])] = np.nan
        targets.append(target)
    level = float(np.concatenate([r.y[:, output] for r in records]).mean())
    moves = scaled if rate else [np.diff(v, axis=0, prepend=v[:1]) for v in scaled]
    return _Motions(moves, targets, size, scaled, level, rate)


@dataclass(frozen=True)
class _Linear:
    """Impulse responses to an output, of the length with the least BIC, and its disturbance."""

    motions: _Motions
    output: int
    nodes: list[int]
    """Lags of the nodes of a response."""
    noise: Array
    """(lags + 1,), filter that whitens the disturbance."""
    base: list[Array]
    """Regressors (T, nu * nodes + 1) by record."""
    theta: Array

    def simulated(self) -> list[Array]:
        """Output (T,) of each record."""
        shape = self.motions.size.size, -1
        g = _weights(self.nodes) @ self.theta[:-1].reshape(shape).T
        found: list[Array] = []
        for v in self.motions.inputs:
            before = np.concatenate([np.repeat(v[:1], len(g) - 1, axis=0), v])
            each = [np.convolve(a, b, "valid") for a, b in zip(before.T, g.T, strict=True)]
            found.append(np.sum(each, axis=0))
        shift = self.motions.mean - float(np.concatenate(found).mean())
        return [one + shift for one in found]

    def white(self, parts: Sequence[Array]) -> Array:
        """Whiten signals (T, ...) of each record, and leave out samples without a target."""
        rows = zip(self.motions.y, parts, strict=True)
        return np.concatenate([_filtered(x, self.noise)[_seen(y, self.noise)] for y, x in rows])


def _filtered(x: Array, noise: Array) -> Array:
    """Samples (T - lags, ...) of a signal through a filter."""
    first = len(noise) - 1
    return sum(
        (c * x[first - k : len(x) - k] for k, c in enumerate(noise)), np.zeros_like(x[first:])
    )


def _seen(y: Array, noise: Array) -> Mask:
    return np.isfinite(_filtered(y, noise))


def _solved(x: Array, y: Array) -> Array:
    """Least-squares coefficients."""
    return _ridged(x.T @ x, x.T @ y)


def _ridged(gram: Array, product: Array, ridge: float | Array = 1e-8) -> Array:
    """Solution of normal equations, with a ridge as a share of their diagonal."""
    size = np.sqrt(np.maximum(np.diagonal(gram), 1e-300))
    scaled = gram / np.outer(size, size) + np.eye(len(gram)) * ridge
    return (np.linalg.solve(scaled, (product.T / size).T).T / size).T


def _linear(motions: _Motions, output: int) -> _Linear | None:
    """None for too few samples, and for an output that the inputs explain exactly."""
    nu, samples = motions.size.size, sum(map(len, motions.y))
    nodes = _lag_nodes(min(int(_LARGEST_SHARE * samples), _LONGEST))
    # As many columns of the level as of the linear part.
    most = min(samples // (2 * nu * _SAMPLES_EACH), len(nodes) - 1)
    if most < _FEWEST_NODES:
        return None
    weights = _weights(nodes[: most + 1])
    whole = [np.column_stack([_regressors(v, weights), np.ones(len(v))]) for v in motions.u]
    noise = _noise(motions.y, whole)
    linear = _Linear(motions, output, nodes[: most + 1], noise, whole, np.zeros(0))
    x, y = linear.white(whole), linear.white(motions.y)
    gram, product, square = x.T @ x, x.T @ y, float(y @ y)
    best, least = 0, np.inf
    for many in range(_FEWEST_NODES, most + 1):
        kept = _first_nodes(nu, most, many)
        theta = _ridged(gram[np.ix_(kept, kept)], product[kept])
        left = square - float(product[kept] @ theta)
        if left <= 1e-9 * square:
            return None
        cost = len(y) * np.log(left) + len(kept) * np.log(len(y))
        if cost < least:
            best, least = many, cost
    # The response may be longer at another level.
    many = min(best + _OCTAVE, most)
    base = [v[:, _first_nodes(nu, most, many)] for v in whole]
    theta = _solved(linear.white(base), y)
    return replace(linear, nodes=nodes[: many + 1], base=base, theta=theta)


def _first_nodes(inputs: int, nodes: int, many: int) -> NDArray[np.intp]:
    """Numbers of the columns of the first nodes of each input, and of the constant."""
    columns = np.arange(inputs * nodes).reshape(inputs, nodes)[:, :many].ravel()
    return np.append(columns, inputs * nodes)


def _noise(y: Sequence[Array], base: Sequence[Array]) -> Array:
    """Autoregressive filter (lags + 1,) of what the regressors leave of the targets."""
    x, target = np.concatenate(base), np.concatenate(y)
    seen = np.isfinite(target)
    theta = _solved(x[seen], target[seen])
    rows = np.concatenate([
        np.lib.stride_tricks.sliding_window_view(one - part @ theta, _NOISE_LAGS + 1)
        for one, part in zip(y, base, strict=True)
    ])  # fmt: skip
    rows = rows[np.isfinite(rows).all(axis=1)]
    return np.concatenate([[1.0], -_solved(rows[:, -2::-1], rows[:, -1])])


# Dependence on the level of a signal.


@dataclass(frozen=True)
class _Dependence:
    of: Kind
    signal: int
    levels: Array
    chance: float
    share: float
    x: Array
    """Whitened regressors (n, columns), those of the linear part first."""
    y: Array
    """Whitened target (n,)."""


def _beyond_middle(values: Array, levels: Array) -> Array:
    """Weights (T, 2) of the lowest and of the highest of three levels."""
    low, middle, high = levels
    shares = (middle - values) / (middle - low), (values - middle) / (high - middle)
    return np.clip(np.stack(shares, axis=1), 0.0, 1.0)


def _dependence(linear: _Linear, of: Kind, signal: int, values: Sequence[Array]) -> _Dependence:
    levels = np.quantile(np.concatenate(values), _LEVELS)
    levels = levels + np.array([-1e-9, 0.0, 1e-9]) * max(float(np.abs(levels).max()), 1e-300)
    weights = _weights(_half(linear.nodes))
    parts: list[Array] = []
    for u, s in zip(linear.motions.u, values, strict=True):
        means = _moving_means(s)
        parts.append(_regressors(u, weights, lambda lag, m=means: _beyond_middle(m(lag), levels)))
    base, more, y = linear.white(linear.base), linear.white(parts), linear.white(linear.motions.y)
    error = y - base @ _solved(base, y)
    beyond = more - base @ _solved(base, more)
    size = np.maximum(np.linalg.norm(more, axis=0), 1e-300)
    beyond = beyond / size
    middle = np.linalg.inv(beyond.T @ beyond + _RIDGE * np.eye(len(size)))
    places = np.array_split(np.arange(len(y)), _BLOCKS)
    gradients = np.stack([beyond[k].T @ error[k] for k in places])
    # Signs change the errors of blocks; the linear part is fitted to them again.
    again = _ridged(base.T @ base, np.stack([base[k].T @ error[k] for k in places], axis=1))
    after = -np.stack([beyond[k].T @ base[k] @ again for k in places])
    after[np.arange(_BLOCKS), :, np.arange(_BLOCKS)] += gradients
    both = after.sum(axis=0)
    products = both.T @ middle @ both
    products -= np.einsum("bqc,bqd->cd", after, np.einsum("qr,brd->bqd", middle, after))
    flips = np.random.default_rng(0).choice([-1.0, 1.0], (_FLIPS, _BLOCKS))
    by_chance = np.einsum("fb,fb->f", flips @ products, flips)
    total = float(products.sum())
    chance = float(1 + (by_chance >= total).sum()) / (1 + _FLIPS)
    share = min(max(total / float(error @ error), 0.0), 1.0)
    return _Dependence(of, signal, levels, chance, share, np.column_stack([base, more]), y)


def _described(
    found: _Dependence, linear: _Linear, moving: Sequence[int], family: int
) -> list[LevelResponse]:
    """Quantities of each input's response, with errors by changes of the gradients of blocks."""
    many, x = linear.base[0].shape[1], found.x
    ridge = np.where(np.arange(x.shape[1]) < many, 1e-8, _RIDGE)
    gram = x.T @ x
    theta = _ridged(gram, x.T @ found.y, ridge)
    error = found.y - x @ theta
    gradients = [x[k].T @ error[k] for k in np.array_split(np.arange(len(x)), _BLOCKS)]
    weights = np.random.default_rng(0).normal(size=(_BLOCKS, _DRAWS))
    draws = theta[:, None] + _ridged(gram, np.stack(gradients, axis=1) @ weights, ridge)
    parts = zip(*(_steps(one, linear, many) for one in (theta, *draws.T)), strict=True)
    described: list[LevelResponse] = []
    for j, steps in zip(moving, parts, strict=True):
        quantities = np.array([_two_points(s) for s in steps])
        gain, delay, constant = (_by_level(quantities[:, k], found.levels) for k in range(3))
        described.append(
            LevelResponse(
                linear.output,
                j,
                found.of,
                found.signal,
                found.levels,
                min(found.chance * family, 1.0),
                found.share,
                gain,
                delay,
                constant,
                steps[0],
            )
        )
    return described


def _steps(theta: Array, linear: _Linear, many: int) -> list[Array]:
    """Step responses (3, lags + 1) to each input, in physical units."""
    size = linear.motions.size
    base, more = _weights(linear.nodes), _weights(_half(linear.nodes))
    of_base = theta[: many - 1].reshape(len(size), -1)
    of_level = theta[many:].reshape(len(size), -1, 2)
    found: list[Array] = []
    for a, b, s in zip(of_base, of_level, size, strict=True):
        g = base @ a
        low, high = (more @ b).T
        found.append(np.cumsum(np.stack([g + low, g, g + high]), axis=1) / s)
    return found


def _two_points(steps: Array) -> Array:
    """Gain, delay and time constant (3, 3) at each level, by the samples at which the step response
    reaches 28 % and 63 % of its end; nan where it does not end on one side."""
    found = np.full((3, len(steps)), np.nan)
    for k, step in enumerate(steps):
        found[0, k] = gain = step[-1]
        rise = np.concatenate([[0.0], step / gain]) if gain else np.zeros(1)
        times: list[float] = []
        for part in (_EARLY, _LATE):
            above = np.flatnonzero(rise >= part)
            if above.size:
                n = int(above[0])
                times.append(n - 1 - (rise[n] - part) / (rise[n] - rise[n - 1]))
        if len(times) == 2:
            constant = 1.5 * (times[1] - times[0])
            found[1:, k] = max(times[1] - constant, 0.0), constant
    return found


def _by_level(values: Array, levels: Array) -> ByLevel:
    """Values (1 + draws, 3): the estimate first, then draws around it."""

    def error(of: Array) -> Array:
        # Times of a response that noise covers are far off in some draws.
        known = np.where(np.isfinite(of[0]), of[1:], 0.0)
        low, high = np.nanquantile(known, (0.16, 0.84), axis=0)
        return np.where(np.isfinite(of[0]), (high - low) / 2, np.nan)

    change = values[:, 2] - values[:, 0]
    power = np.full(len(values), np.nan)
    signs = np.sign(values)
    one_sign = abs(signs.sum(axis=1)) == 3
    if levels.min() * levels.max() > 0 and one_sign[0]:
        x = np.log(np.abs(levels))
        x = x - x.mean()
        power[one_sign] = np.log(np.abs(values[one_sign])) @ x / float(x @ x)
    return ByLevel(
        values[0], error(values), float(change[0]), float(error(change)), float(power[0]),
        float(error(power)),
    )  # fmt: skip
