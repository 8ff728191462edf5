"""Facts that the training records show before any fit: evidence, integrators, levels, relations,
switching, transport.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import Literal, NamedTuple

import numpy as np

from asia.agents.view import Facts, Trial
from asia.data.frequency import find_period, frequency_response
from asia.data.relations import FoundTransport, find_transport
from asia.data.trajectory import Array, Trajectory
from asia.judge.scoring.residuals import Diagnostics

# Records as a key: the same objects, whatever they hold.


class SameRecords:
    """Key that is equal for the identical record objects, to reuse their analysis."""

    def __init__(self, records: Sequence[Trajectory]) -> None:
        self.records = tuple(records)

    def __hash__(self) -> int:
        return hash(tuple(map(id, self.records)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SameRecords) and (
            len(self.records) == len(other.records)
            and all(a is b for a, b in zip(self.records, other.records, strict=True))
        )


# Detection of integrating outputs: a pole at 1 in a linear model of block means.


# Blocks of all records, lags of the model, and the least pole that counts: a time constant of a
# fifth of the records.
_INTEGRATOR_BLOCKS, _INTEGRATOR_LAGS, _LEAST_POLE, _LARGEST_POLE = 240, 3, 0.975, 1.05
_LEAST_SAMPLES = 60


def integrating(facts: Facts) -> tuple[int, ...]:
    """Numbers of the outputs that drift with the sum of the inputs and do not come back."""
    return _integrating(SameRecords(facts.records))


@lru_cache(maxsize=8)
def _integrating(same: SameRecords) -> tuple[int, ...]:
    records = same.records
    samples = sum(len(r) for r in records)
    size = max(1, samples // _INTEGRATOR_BLOCKS)
    pieces = [
        (_block_means(r.u, size), _block_means(r.y, size))
        for r in records
        if len(r) // size > 4 * _INTEGRATOR_LAGS
    ]
    if sum(len(u) for u, _ in pieces) < _LEAST_SAMPLES:
        return ()
    outputs = range(pieces[0][1].shape[1])
    return tuple(k for k in outputs if _LEAST_POLE < _slowest(pieces, k) < _LARGEST_POLE)


def _block_means(values: Array, size: int) -> Array:
    """Means (blocks, n) of blocks of so many samples."""
    blocks = len(values) // size
    return values[: blocks * size].reshape(blocks, size, -1).mean(axis=1)


def _slowest(pieces: list[tuple[Array, Array]], output: int) -> float:
    """The greatest real pole of an autoregressive model with inputs, 0 where none is positive."""
    rows: list[Array] = []
    targets: list[Array] = []
    for u, every in pieces:
        y = every[:, output]
        past = [y[_INTEGRATOR_LAGS - k : len(y) - k] for k in range(1, _INTEGRATOR_LAGS + 1)]
        drive = [u[_INTEGRATOR_LAGS - k : len(u) - k] for k in range(_INTEGRATOR_LAGS + 1)]
        rows.append(np.column_stack([*past, *drive, np.ones(len(y) - _INTEGRATOR_LAGS)]))
        targets.append(y[_INTEGRATOR_LAGS:])
    x, y = np.concatenate(rows), np.concatenate(targets)
    spread = x.std(axis=0)
    x = x / np.where(spread > 0, spread, 1.0)
    theta = np.linalg.lstsq(x, y, rcond=1e-10)[0] / np.where(spread > 0, spread, 1.0)
    poles = np.roots([1.0, *-theta[:_INTEGRATOR_LAGS]])
    real = poles.real[abs(poles.imag) < 0.02]
    return float(real.max(initial=0.0))


# Detection of several excitation levels and of periodic records.


# Levels are this ratio apart, and each has at least so many records.
_APART, _FEWEST = 1.2, 2


def periodic(facts: Facts) -> bool:
    """Return whether all inputs of all records have one period, and whole records are simulated."""
    return facts.horizon is None and _period(SameRecords(facts.records)) is not None


def several_levels(facts: Facts) -> bool:
    """Return whether the inputs come in levels that are clearly apart, several records a level."""
    scale = np.concatenate([r.u for r in facts.records]).std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    sizes = np.sort([np.sqrt(((r.u / scale) ** 2).mean()) for r in facts.records])
    cuts = np.flatnonzero(sizes[1:] > _APART * sizes[:-1]) + 1
    return len(cuts) > 0 and min(map(len, np.split(sizes, cuts))) >= _FEWEST


def noise_of_periods(facts: Facts) -> float | None:
    """Return the noise floor of V from the variation between periods: standard deviation of the
    noise over that of the output, mean over the outputs. None without periods."""
    return _noise(SameRecords(facts.records)) if periodic(facts) else None


@lru_cache(maxsize=8)
def _noise(same: SameRecords) -> float | None:
    period = _period(same)
    outputs = range(same.records[0].y.shape[1])
    found = [frequency_response(same.records, k, period) for k in outputs]
    levels = [one.levels.noise for one in found if one is not None]
    known = [level for level in levels if level is not None]
    return sum(known) / len(known) if len(known) == len(outputs) else None


@lru_cache(maxsize=8)
def _period(same: SameRecords) -> int | None:
    return find_period(same.records)


# Relation of inputs and outputs in the training records: effect of the inputs, delay, feedback
# from outputs to inputs, and instability.
#
# Correlations are those of innovations, the part of a signal that its own past does not predict.
# Source: L. D. Haugh, Checking the independence of two covariance-stationary time series, J. Am.
# Stat. Assoc. 71, 1976.


_OWN_LAGS, _MOST_SAMPLES, _FAR = 10, 20_000, 400
# Chance of an effect where there is none, over all lags and signals; a correlation below which one
# is of no use to a model; and one of inputs with past outputs below which there need be no loop.
_LEVEL, _LEAST, _LEAST_BACK = 0.01, 0.05, 0.15
# A signal whose past predicts it to this share of its standard deviation holds nothing new.
_PREDICTABLE = 0.02
# Blocks of all records, their lags, and the share of an error that inputs take away by more than
# chance.
_BLOCKS, _BLOCK_LAGS, _LEAST_GAIN = 240, 4, 0.03
# A mode that grows this much over the records.
_GROWTH = 100.0


@dataclass(frozen=True)
class Relation:
    """Relation of inputs and outputs in the training records."""

    effect: float
    """Greatest correlation of an output's innovation with those of the inputs or of their squares;
    0 where it is not significant, or where the inputs are too regular to tell."""
    delay: int
    """Samples after which inputs act first; 0 where there is no such correlation."""
    feedback: float
    """Greatest correlation of an input with past outputs; 0 where it may be chance, or where the
    inputs are too regular to tell."""
    pole: float
    """Greatest modulus of the poles of a linear one-step model."""
    reach: int
    """Greatest lag in samples that was looked at."""
    length: int
    """Samples of the longest record."""
    gain: float
    """Share of the error of one step, on samples left out, that inputs and their squares take
    away from that of past outputs alone."""

    @property
    def acts(self) -> bool:
        """Whether an effect of an input is seen."""
        return self.effect > 0.0 or self.gain > _LEAST_GAIN

    @property
    def unstable(self) -> bool:
        """Whether a growing mode makes a free simulation diverge."""
        return self.pole**self.length > _GROWTH


def relation(facts: Facts) -> Relation:
    """The one of the training records."""
    return _relation(SameRecords(facts.records))


@lru_cache(maxsize=8)
def _relation(same: SameRecords) -> Relation:
    most = max(_MOST_SAMPLES // len(same.records), 20 * _OWN_LAGS)
    records = [r[:most] for r in same.records]
    length = max(map(len, records))
    reach = min(_FAR, length // 4)
    usable = [r for r in records if len(r) > reach + 2 * _OWN_LAGS]
    outputs = [_news(usable, lambda r, k=k: r.y[:, k]) for k in range(records[0].y.shape[1])]
    inputs = range(records[0].u.shape[1])
    plain = [_news(usable, lambda r, j=j: r.u[:, j]) for j in inputs]
    squares = [_news(usable, lambda r, j=j: (r.u[:, j] - r.u[:, j].mean()) ** 2) for j in inputs]
    known = [y for y in outputs if y is not None]
    ahead = [(y, u) for y in known for u in (*plain, *squares) if u is not None]
    back = [(u, y) for u in plain if u is not None for y in known]
    lag, effect = _strongest(ahead, range(reach + 1))
    _, feedback = _strongest(back, range(1, 2 * _OWN_LAGS + 1))
    return Relation(
        effect=effect,
        delay=lag,
        feedback=feedback if feedback >= _LEAST_BACK else 0.0,
        pole=max((_largest_pole(usable, k) for k in range(len(outputs))), default=0.0),
        reach=reach,
        length=max(map(len, same.records)),
        gain=max((_gain(usable, k) for k in range(len(outputs))), default=0.0),
    )


def _news(
    records: Sequence[Trajectory], read: Callable[[Trajectory], Array]
) -> tuple[Array, ...] | None:
    """Return the normalised innovation of each record's signal; None where it is close to zero."""
    signals = [read(r) for r in records]
    if not signals:
        return None
    size = float(np.concatenate(signals).std())
    if size <= 0:
        return None
    past = np.concatenate([_lagged(s / size) for s in signals])
    target = np.concatenate([s[_OWN_LAGS:] / size for s in signals])
    theta = np.linalg.lstsq(past, target, rcond=1e-10)[0]
    news = [s[_OWN_LAGS:] / size - _lagged(s / size) @ theta for s in signals]
    left = float(np.concatenate(news).std())
    return tuple(n / left for n in news) if left > _PREDICTABLE else None


def _lagged(signal: Array) -> Array:
    """(T - lags, lags + 1): past samples and a constant."""
    rows = len(signal) - _OWN_LAGS
    columns = [signal[_OWN_LAGS - k : _OWN_LAGS - k + rows] for k in range(1, _OWN_LAGS + 1)]
    return np.column_stack([*columns, np.ones(rows)])


def _strongest(
    pairs: Sequence[tuple[tuple[Array, ...], tuple[Array, ...]]], lags: range
) -> tuple[int, float]:
    """The first lag with at least half of the greatest correlation of (a, b delayed), and that
    correlation; (0, 0.0) where it may be chance."""
    found: list[tuple[float, int, float]] = []
    for a, b in pairs:
        samples = sum(map(len, a))
        for lag in lags:
            products = np.concatenate(
                [p[lag:] * q[: len(q) - lag] for p, q in zip(a, b, strict=True)]
            )
            # Held inputs are new at few samples: their correlations by chance are the larger.
            chance = float((products**2).sum()) ** 0.5 / samples
            found.append((abs(float(products.sum())) / samples, lag, chance))
    band = NormalDist().inv_cdf(1.0 - _LEVEL / (2 * max(len(found), 1)))
    sure = [(size, lag) for size, lag, chance in found if size > max(band * chance, _LEAST)]
    if not sure:
        return 0, 0.0
    greatest = max(sure)[0]
    return min(lag for size, lag in sure if size > 0.5 * greatest), greatest


def _gain(records: Sequence[Trajectory], output: int) -> float:
    """Return the gain in samples and in means of blocks: slow effects are hidden by the noise of
    single samples."""
    size = max(1, sum(map(len, records)) // _BLOCKS)
    return max(_gain_of_blocks(records, output, 1), _gain_of_blocks(records, output, size))


def _gain_of_blocks(records: Sequence[Trajectory], output: int, size: int) -> float:
    alone: list[Array] = []
    driven: list[Array] = []
    targets: list[Array] = []
    for record in records:
        y, u = _means(record.y[:, output : output + 1], size)[:, 0], _means(record.u, size)
        rows = len(y) - _BLOCK_LAGS
        if rows < 2:
            continue
        past = [y[_BLOCK_LAGS - k : _BLOCK_LAGS - k + rows] for k in range(1, _BLOCK_LAGS + 1)]
        inputs = np.hstack([u, (u - u.mean(axis=0)) ** 2])
        late = [inputs[_BLOCK_LAGS - k : _BLOCK_LAGS - k + rows] for k in range(_BLOCK_LAGS + 1)]
        alone.append(np.column_stack([*past, np.ones(rows)]))
        driven.append(np.column_stack([*past, *late, np.ones(rows)]))
        targets.append(y[_BLOCK_LAGS:])
    if not targets:
        return 0.0
    target = np.concatenate(targets)
    without = _left_out_error(np.concatenate(alone), target)
    return 1.0 - _left_out_error(np.concatenate(driven), target) / max(without, 1e-300)


def _left_out_error(x: Array, y: Array) -> float:
    """Root mean square error of each half by a linear model of the other."""
    spread = np.where(x.std(axis=0) > 0, x.std(axis=0), 1.0)
    x, half, total = x / spread, len(y) // 2, 0.0
    for fitted, left in ((slice(half), slice(half, None)), (slice(half, None), slice(half))):
        theta = np.linalg.lstsq(x[fitted], y[fitted], rcond=1e-8)[0]
        total += float(((y[left] - x[left] @ theta) ** 2).sum())
    return (total / len(y)) ** 0.5


def _means(values: Array, size: int) -> Array:
    """Means (blocks, n) of blocks of so many samples."""
    blocks = len(values) // size
    return values[: blocks * size].reshape(blocks, size, -1).mean(axis=1)


def _largest_pole(records: Sequence[Trajectory], output: int) -> float:
    """Greatest modulus of the poles of linear one-step models of two orders: the lesser of both,
    because a model of too high an order has poles of its own."""
    return min((_pole_of_order(records, output, order) for order in (2, 4)), default=0.0)


def _pole_of_order(records: Sequence[Trajectory], output: int, order: int) -> float:
    rows: list[Array] = []
    targets: list[Array] = []
    for record in records:
        y = record.y[:, output]
        steps = range(1, order + 1)
        past = [y[order - k : len(y) - k] for k in steps]
        # Without the present input: in a loop it holds the present output.
        drive = [record.u[order - k : len(y) - k] for k in steps]
        rows.append(np.column_stack([*past, *drive, np.ones(len(y) - order)]))
        targets.append(y[order:])
    if not rows:
        return 0.0
    x = np.concatenate(rows)
    spread = np.where(x.std(axis=0) > 0, x.std(axis=0), 1.0)
    theta = np.linalg.lstsq(x / spread, np.concatenate(targets), rcond=1e-10)[0] / spread
    return float(abs(np.roots([1.0, *-theta[:order]])).max(initial=0.0))


# Detection of dry friction, hysteresis and backlash.
#
# The test relates the error of a one-step model with smooth terms to a direction of motion, or to
# the memory of where a signal reversed.


Cause = Literal["velocity", "displacement", "input"]

# Share of the one-step error's square that a switching term has to explain; smooth curves that the
# terms of the model lack look a little like a displacement's.
_LEAST_SHARE: dict[Cause, float] = {"velocity": 0.05, "displacement": 0.13, "input": 0.1}
_LAGS, _SWITCHING_SAMPLES = 6, 4000
# Reach of the memory in standard deviations: of an output, and of an input.
_OUTPUT_REACH, _INPUT_REACH = (0.05, 0.2, 0.6), (0.1, 0.5)
_FINE = 0.1


@dataclass(frozen=True)
class Switching:
    """The switching term that explains most."""

    share: float
    """Share of the squared one-step error that remains with smooth terms."""
    cause: Cause
    """"velocity": the sign of an output; "displacement": which way an output moves, or where it
    turned; "input": where an input turned."""
    signal: int
    """Number of that output or input."""

    @property
    def found(self) -> bool:
        """Whether it is more than chance and smooth curves give."""
        return self.share >= _LEAST_SHARE[self.cause]


def switching(facts: Facts) -> Switching:
    """The one of the training records."""
    records = facts.records
    most = max(_SWITCHING_SAMPLES // len(records), 50 * _LAGS)
    pieces = [r[:most] for r in records if len(r) > 20 * _LAGS]
    return _switching(tuple(_Samples(r.u.tobytes(), r.y.tobytes(), len(r)) for r in pieces))


def moved_with_stop(signal: Array, reach: float) -> Array:
    """The stop operator (T,): it follows the signal's changes (T,) within `reach` of zero, in
    units of it."""
    state, found = 0.0, np.empty(len(signal))
    for k, change in enumerate(np.diff(signal, prepend=signal[0])):
        state = min(max(state + change, -reach), reach)
        found[k] = state / reach
    return found


class _Samples(NamedTuple):
    """Segment of a record, hashable."""

    u: bytes
    y: bytes
    length: int

    def arrays(self) -> tuple[Array, Array]:
        """Inputs (T, nu) and outputs (T, ny)."""
        u, y = (np.frombuffer(b).reshape(self.length, -1) for b in (self.u, self.y))
        return u, y


@lru_cache(maxsize=16)
def _switching(pieces: tuple[_Samples, ...]) -> Switching:
    best = Switching(0.0, "velocity", 0)
    records = [piece.arrays() for piece in pieces]
    for output in range(records[0][1].shape[1] if records else 0):
        for found in _of_output(records, output):
            best = max(best, found, key=lambda s: s.share)
    return best


def _of_output(records: list[tuple[Array, Array]], output: int) -> list[Switching]:
    u, y = (np.concatenate(part) for part in zip(*records, strict=True))
    size, spread = y[:, output].std() or 1.0, np.where(u.std(axis=0) > 0, u.std(axis=0), 1.0)
    outputs = [y[:, output] / size for _, y in records]
    inputs = [u / spread for u, _ in records]
    mean, level = y[:, output].mean() / size, u.mean(axis=0) / spread
    smooth = np.concatenate(
        [_smooth(v, w, mean, level) for v, w in zip(outputs, inputs, strict=True)]
    )
    target = np.concatenate([v[_LAGS:] for v in outputs])
    basis = np.linalg.qr(smooth)[0]
    error = target - basis @ (basis.T @ target)
    found: list[Switching] = []
    pace = np.concatenate([np.diff(v) for v in outputs]).std() or 1.0
    for cause, signal, parts in _terms(outputs, inputs, pace):
        term = np.concatenate(parts)
        term = term - basis @ (basis.T @ term)
        gain = np.linalg.lstsq(term, error, rcond=None)[0]
        left = float(((error - term @ gain) ** 2).sum() / max(float((error**2).sum()), 1e-300))
        found.append(Switching(1.0 - left, cause, output if signal < 0 else signal))
    return found


def _terms(
    outputs: list[Array], inputs: list[Array], pace: float
) -> list[tuple[Cause, int, list[Array]]]:
    """Switching terms (T, n) of each record, with their cause and the number of the input."""
    found: list[tuple[Cause, int, list[Array]]] = [
        ("velocity", -1, [_late(np.sign(v), 1) for v in outputs]),
        (
            "displacement",
            -1,
            [_late(np.tanh(np.diff(v, prepend=v[0]) / (_FINE * pace)), 1) for v in outputs],
        ),
    ]
    for reach in _OUTPUT_REACH:
        stops = [moved_with_stop(v, reach) for v in outputs]
        found.append(("displacement", -1, [_late(s, 1) for s in stops]))
    for j in range(inputs[0].shape[1]):
        for reach in _INPUT_REACH:
            stops = [moved_with_stop(w[:, j], reach) for w in inputs]
            found.append(("input", j, [np.hstack([_late(s, 0), _late(s, 1)]) for s in stops]))
    return found


def _smooth(y: Array, u: Array, mean: float, level: Array) -> Array:
    """Lags of one output (T,) and of the inputs (T, nu), and their first products."""
    past, now = _late(y, 1) - mean, _late(u, 1) - level
    lags = [_late(y, k) for k in range(1, _LAGS + 1)] + [_late(u, k) for k in range(_LAGS)]
    bent = [past**2, past**3, now**2, now**3, past * now, past**2 * now, past * now**2]
    return np.hstack([np.ones((len(past), 1)), *lags, *bent])


def _late(values: Array, lag: int) -> Array:
    """Columns (T - lags, n) that lag behind the samples from the number of lags on."""
    columns = values[:, None] if values.ndim == 1 else values
    return columns[_LAGS - lag : len(columns) - lag]


# Detection of variable transport delays set by an input: a flow in a pipe, the speed of a belt.


# Share of the squared one-step error under the best constant delay that may be left, and the least
# delay in samples: a shorter one is as good as constant.
_LARGEST_RATIO, _LEAST_DELAY = 0.6, 2.0
# Least deviation of a pace from its mean, as a share of it, and how many inputs are looked at.
_LEAST_CHANGE, _MOST_INPUTS = 0.05, 4


def transport(facts: Facts) -> FoundTransport | None:
    """The pipe that the training records show, at the pace of one of the inputs; None without."""
    return _transport(SameRecords(facts.records))


@lru_cache(maxsize=8)
def _transport(same: SameRecords) -> FoundTransport | None:
    u = np.concatenate([r.u for r in same.records])
    moving = u.std(axis=0) > _LEAST_CHANGE * np.abs(u.mean(axis=0))
    paces = [j for j in range(u.shape[1]) if u[:, j].min() > 0.0 and moving[j]]
    each = [find_transport(same.records, j) for j in paces[:_MOST_INPUTS]]
    likely = [f for f in each if f.ratio < _LARGEST_RATIO and f.delay > _LEAST_DELAY]
    return min(likely, key=lambda f: f.ratio, default=None)


# Evidence from data and training residuals for the choice of the next move.


def plateau_share(facts: Facts) -> float:
    """Largest share over the outputs of samples within 0.5 % of the range from the maximum: a
    signal that stays there is limited by the system or by its sensor."""
    y = np.concatenate([r.y for r in facts.records])
    reach = y.max(axis=0) - 0.005 * (y.max(axis=0) - y.min(axis=0))
    return float((y >= reach).mean(axis=0).max())


def worst(trial: Trial, read: Callable[[Diagnostics], float]) -> float:
    """The largest value of a diagnostic over the folds; 0 without evidence."""
    return max((read(d) for d in trial.diagnostics), default=0.0)


def overfit(trial: Trial) -> float:
    """V over the training error: far above 1 the model has learned its own fold."""
    train = trial.train_error
    if trial.value is None or not train:
        return 1.0
    return trial.value / train


def by_overfit(trial: Trial, far: float, some: float, none: float) -> float:
    """A weight by how far V is above the training error."""
    ratio = overfit(trial)
    return far if ratio > 2.0 else some if ratio > 1.3 else none


def coloured(trial: Trial) -> bool:
    """The residual is far from white: dynamics are missing."""
    return worst(trial, lambda d: d.whiteness) > 0.5


def biased(trial: Trial) -> bool:
    """The mean residual is not small."""
    return worst(trial, lambda d: d.bias) > 0.03


def fails_on_top(trial: Trial) -> bool:
    """Errors gather where the output is highest."""
    return worst(trial, lambda d: d.top_error) > 1.3


def input_left(trial: Trial) -> bool:
    """The input still explains part of the residual."""
    return worst(trial, lambda d: d.input_correlation) > 0.25


def curved(trial: Trial) -> bool:
    """The residual goes with the square of the output: a static nonlinearity is missing."""
    return worst(trial, lambda d: d.curvature) > 0.25


def folds_disagree(trial: Trial) -> float:
    """Return the largest over the smallest V of the folds: far above 1 the training parts differ in
    information."""
    if not trial.folds or min(trial.folds) <= 0:
        return 1.0
    return max(trial.folds) / min(trial.folds)
