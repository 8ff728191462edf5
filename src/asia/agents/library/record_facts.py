"""Facts that the training records show before any fit: evidence, integrators, levels, relations,
switching, transport.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, wraps
from statistics import NormalDist
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from asia.agents.view import Facts
from asia.data.frequency import find_period, frequency_response
from asia.data.relations import FoundTransport, find_transport
from asia.data.trajectory import Array, Trajectory

T = TypeVar("T")


class _SameRecords:
    """Key that is equal for the identical record objects."""

    def __init__(self, records: Sequence[Trajectory]) -> None:
        self.records = tuple(records)

    def __hash__(self) -> int:
        return hash(tuple(map(id, self.records)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _SameRecords) and (
            len(self.records) == len(other.records)
            and all(a is b for a, b in zip(self.records, other.records, strict=True))
        )


def _cached(analyse: Callable[[tuple[Trajectory, ...]], T]) -> Callable[[Facts], T]:
    """Analyse the training records of a problem, once for the same record objects."""
    analysis = lru_cache(maxsize=8)(lambda same: analyse(same.records))

    @wraps(analyse)
    def of_facts(facts: Facts) -> T:
        return analysis(_SameRecords(facts.records))

    return of_facts


def _lagged(values: Array, lags: range, most: int) -> list[Array]:
    """Samples of a signal from number `most` on, late by each of the lags."""
    return [values[most - k : len(values) - k] for k in lags]


def _block_means(values: Array, size: int) -> Array:
    """Means (blocks, n) of blocks of so many samples."""
    blocks = len(values) // size
    return values[: blocks * size].reshape(blocks, size, -1).mean(axis=1)


def _one_step_poles(
    signals: Sequence[tuple[Array, Array]], output: int, order: int, first: int
) -> NDArray[Any]:
    """Poles of a linear one-step model of an output, with the inputs from lag `first` on."""
    x = np.concatenate([
        np.column_stack([
            *_lagged(y[:, output], range(1, order + 1), order),
            *_lagged(u, range(first, order + 1), order),
            np.ones(len(y) - order),
        ])
        for u, y in signals
    ])  # fmt: skip
    spread = np.where(x.std(axis=0) > 0, x.std(axis=0), 1.0)
    response = np.concatenate([y[order:, output] for _, y in signals])
    theta = np.linalg.lstsq(x / spread, response, rcond=1e-10)[0] / spread
    return np.roots([1.0, *-theta[:order]])


# Integrating outputs: a pole at 1 in a linear model of block means.


# Blocks of all records, lags of the model, and the least pole that counts: a time constant of a
# fifth of the records.
_INTEGRATOR_BLOCKS, _INTEGRATOR_LAGS, _LEAST_POLE, _LARGEST_POLE = 240, 3, 0.975, 1.05
_LEAST_SAMPLES = 60


@_cached
def integrating(records: tuple[Trajectory, ...]) -> tuple[int, ...]:
    """Numbers of the outputs that drift with the sum of the inputs and do not come back."""
    size = max(1, sum(len(r) for r in records) // _INTEGRATOR_BLOCKS)
    means = [
        (_block_means(r.u, size), _block_means(r.y, size))
        for r in records
        if len(r) // size > 4 * _INTEGRATOR_LAGS
    ]
    if sum(len(u) for u, _ in means) < _LEAST_SAMPLES:
        return ()
    found: list[int] = []
    for output in range(means[0][1].shape[1]):
        poles = _one_step_poles(means, output, _INTEGRATOR_LAGS, 0)
        real = np.real(poles)[abs(np.imag(poles)) < 0.02]
        if _LEAST_POLE < float(real.max(initial=0.0)) < _LARGEST_POLE:
            found.append(output)
    return tuple(found)


# Lightly damped modes of a one-step model: lags, largest damping ratio, least samples a period.
# Noise alone makes modes near the Nyquist frequency.
_MODE_LAGS, _LIGHT, _LEAST_PERIOD = 8, 0.1, 3.0


@_cached
def resonant(records: tuple[Trajectory, ...]) -> bool:
    """Return whether an output has a lightly damped mode."""
    signals = [(r.u, r.y) for r in records if len(r) > 4 * _MODE_LAGS]
    if sum(len(u) for u, _ in signals) < _LEAST_SAMPLES * _MODE_LAGS:
        return False
    for output in range(records[0].y.shape[1]):
        poles = _one_step_poles(signals, output, _MODE_LAGS, 0)
        logs = np.log(poles[np.imag(poles) > 0])
        slow = np.imag(logs) <= 2 * np.pi / _LEAST_PERIOD
        if (slow & (abs(np.real(logs)) < _LIGHT * abs(logs))).any():
            return True
    return False


# Several excitation levels and periodic records.


# Levels are this ratio apart, and each has at least so many records.
_APART, _FEWEST = 1.2, 2


@_cached
def _period(records: tuple[Trajectory, ...]) -> int | None:
    return find_period(records)


@_cached
def _noise(records: tuple[Trajectory, ...]) -> float | None:
    period = find_period(records)
    outputs = range(records[0].y.shape[1])
    found = [frequency_response(records, k, period) for k in outputs]
    levels = [one.levels.noise for one in found if one is not None]
    known = [level for level in levels if level is not None]
    return sum(known) / len(known) if len(known) == len(outputs) else None


def periodic(facts: Facts) -> bool:
    """Return whether all inputs of all records have one period, and whole records are simulated."""
    return facts.horizon is None and _period(facts) is not None


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
    return _noise(facts) if periodic(facts) else None


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


@_cached
def relation(records: tuple[Trajectory, ...]) -> Relation:
    """Relation of inputs and outputs in the training records."""
    most = max(_MOST_SAMPLES // len(records), 20 * _OWN_LAGS)
    reach = min(_FAR, min(most, max(map(len, records))) // 4)
    usable = [r[:most] for r in records if min(most, len(r)) > reach + 2 * _OWN_LAGS]
    inputs, outputs = range(records[0].u.shape[1]), range(records[0].y.shape[1])
    of_outputs = [_innovations([r.y[:, k] for r in usable]) for k in outputs]
    of_inputs = [_innovations([r.u[:, j] for r in usable]) for j in inputs]
    of_squares = [
        _innovations([(r.u[:, j] - r.u[:, j].mean()) ** 2 for r in usable]) for j in inputs
    ]
    known = [y for y in of_outputs if y is not None]
    ahead = [(y, u) for y in known for u in (*of_inputs, *of_squares) if u is not None]
    back = [(u, y) for u in of_inputs if u is not None for y in known]
    lag, effect = _strongest(ahead, range(reach + 1))
    _, feedback = _strongest(back, range(1, 2 * _OWN_LAGS + 1))
    # Slow effects are hidden by the noise of single samples, and seen in means of blocks.
    blocks = (1, max(1, sum(map(len, usable)) // _BLOCKS))
    signals = [(r.u, r.y) for r in usable]
    poles: list[float] = []
    for k in outputs if usable else ():
        # A model of too high an order has poles of its own: the lesser of two orders counts. The
        # present input is left out: in a loop it holds the present output.
        each = [_one_step_poles(signals, k, order, 1) for order in (2, 4)]
        poles.append(min(float(abs(found).max(initial=0.0)) for found in each))
    return Relation(
        effect=effect,
        delay=lag,
        feedback=feedback if feedback >= _LEAST_BACK else 0.0,
        pole=max(poles, default=0.0),
        reach=reach,
        length=max(map(len, records)),
        gain=max((_input_gain(usable, k, size) for k in outputs for size in blocks), default=0.0),
    )


def _innovations(signals: Sequence[Array]) -> tuple[Array, ...] | None:
    """Return the normalised innovation of each record's signal; None where it is close to zero."""
    size = float(np.concatenate(signals).std()) if signals else 0.0
    if size <= 0:
        return None
    scaled = [signal / size for signal in signals]
    pasts = [
        np.column_stack(
            [*_lagged(s, range(1, _OWN_LAGS + 1), _OWN_LAGS), np.ones(len(s) - _OWN_LAGS)]
        )
        for s in scaled
    ]
    response = np.concatenate([s[_OWN_LAGS:] for s in scaled])
    theta = np.linalg.lstsq(np.concatenate(pasts), response, rcond=1e-10)[0]
    new = [s[_OWN_LAGS:] - past @ theta for s, past in zip(scaled, pasts, strict=True)]
    left = float(np.concatenate(new).std())
    return tuple(n / left for n in new) if left > _PREDICTABLE else None


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


def _input_gain(records: Sequence[Trajectory], output: int, size: int) -> float:
    """Return the share of the one-step error of block means that the inputs take away."""
    own: list[Array] = []
    driven: list[Array] = []
    responses: list[Array] = []
    for record in records:
        y = _block_means(record.y[:, output : output + 1], size)[:, 0]
        u = _block_means(record.u, size)
        rows = len(y) - _BLOCK_LAGS
        if rows < 2:
            continue
        past = _lagged(y, range(1, _BLOCK_LAGS + 1), _BLOCK_LAGS)
        inputs = np.hstack([u, (u - u.mean(axis=0)) ** 2])
        late = _lagged(inputs, range(_BLOCK_LAGS + 1), _BLOCK_LAGS)
        own.append(np.column_stack([*past, np.ones(rows)]))
        driven.append(np.column_stack([*past, *late, np.ones(rows)]))
        responses.append(y[_BLOCK_LAGS:])
    if not responses:
        return 0.0
    response = np.concatenate(responses)
    without = _left_out_error(np.concatenate(own), response)
    return 1.0 - _left_out_error(np.concatenate(driven), response) / max(without, 1e-300)


def _left_out_error(x: Array, y: Array) -> float:
    """Root mean square error of each half by a linear model of the other."""
    spread = np.where(x.std(axis=0) > 0, x.std(axis=0), 1.0)
    x, half, total = x / spread, len(y) // 2, 0.0
    for fitted, left in ((slice(half), slice(half, None)), (slice(half, None), slice(half))):
        theta = np.linalg.lstsq(x[fitted], y[fitted], rcond=1e-8)[0]
        total += float(((y[left] - x[left] @ theta) ** 2).sum())
    return (total / len(y)) ** 0.5


# Dry friction, hysteresis and backlash.
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


@_cached
def switching(records: tuple[Trajectory, ...]) -> Switching:
    """The switching term that explains most of the training records' one-step error."""
    most = max(_SWITCHING_SAMPLES // len(records), 50 * _LAGS)
    usable = [r[:most] for r in records if len(r) > 20 * _LAGS]
    best = Switching(0.0, "velocity", 0)
    for output in range(records[0].y.shape[1]) if usable else ():
        for found in _switching_terms(usable, output):
            best = max(best, found, key=lambda s: s.share)
    return best


def _switching_terms(records: Sequence[Trajectory], output: int) -> Iterator[Switching]:
    u, y = np.concatenate([r.u for r in records]), np.concatenate([r.y[:, output] for r in records])
    size, spread = y.std() or 1.0, np.where(u.std(axis=0) > 0, u.std(axis=0), 1.0)
    mean, level = y.mean() / size, u.mean(axis=0) / spread
    outputs, inputs = [r.y[:, output] / size for r in records], [r.u / spread for r in records]
    # Lags of the output and of the inputs, and their first products.
    smooth: list[Array] = []
    for v, w in zip(outputs, inputs, strict=True):
        past, now = _late(v, 1) - mean, _late(w, 1) - level
        lags = [_late(v, k) for k in range(1, _LAGS + 1)] + [_late(w, k) for k in range(_LAGS)]
        bent = [past**2, past**3, now**2, now**3, past * now, past**2 * now, past * now**2]
        smooth.append(np.hstack([np.ones((len(past), 1)), *lags, *bent]))
    basis = np.linalg.qr(np.concatenate(smooth))[0]
    response = np.concatenate([v[_LAGS:] for v in outputs])
    error = response - basis @ (basis.T @ response)
    pace = np.concatenate([np.diff(v) for v in outputs]).std() or 1.0
    directions = [np.tanh(np.diff(v, prepend=v[0]) / (_FINE * pace)) for v in outputs]
    terms: list[tuple[Cause, int, list[Array]]] = [
        ("velocity", output, [_late(np.sign(v), 1) for v in outputs]),
        ("displacement", output, [_late(d, 1) for d in directions]),
    ]
    for reach in _OUTPUT_REACH:
        stops = [_moved_with_stop(v, reach) for v in outputs]
        terms.append(("displacement", output, [_late(s, 1) for s in stops]))
    for j in range(u.shape[1]):
        for reach in _INPUT_REACH:
            stops = [_moved_with_stop(w[:, j], reach) for w in inputs]
            terms.append(("input", j, [np.hstack([_late(s, 0), _late(s, 1)]) for s in stops]))
    for cause, signal, parts in terms:
        term = np.concatenate(parts)
        term = term - basis @ (basis.T @ term)
        gain = np.linalg.lstsq(term, error, rcond=None)[0]
        left = float(((error - term @ gain) ** 2).sum() / max(float((error**2).sum()), 1e-300))
        yield Switching(1.0 - left, cause, signal)


def _moved_with_stop(signal: Array, reach: float) -> Array:
    """The stop operator (T,): it follows the signal's changes (T,) within `reach` of zero, in
    units of it."""
    state, found = 0.0, np.empty(len(signal))
    for k, change in enumerate(np.diff(signal, prepend=signal[0])):
        state = min(max(state + change, -reach), reach)
        found[k] = state / reach
    return found


def _late(values: Array, lag: int) -> Array:
    """Columns (T - lags, n) that lag behind the samples from the number of lags on."""
    columns = values[:, None] if values.ndim == 1 else values
    return columns[_LAGS - lag : len(columns) - lag]


# Variable transport delays set by an input: a flow in a pipe, the speed of a belt.


# Share of the squared one-step error under the best constant delay that may be left, and the least
# delay in samples: a shorter one is as good as constant.
_LARGEST_RATIO, _LEAST_DELAY = 0.6, 2.0
# Least deviation of a pace from its mean, as a share of it, and how many inputs are looked at.
_LEAST_CHANGE, _MOST_INPUTS = 0.05, 4


@_cached
def transport(records: tuple[Trajectory, ...]) -> FoundTransport | None:
    """The pipe that the training records show, at the pace of one of the inputs; None without."""
    u = np.concatenate([r.u for r in records])
    moving = u.std(axis=0) > _LEAST_CHANGE * np.abs(u.mean(axis=0))
    paces = [j for j in range(u.shape[1]) if u[:, j].min() > 0.0 and moving[j]]
    each = [find_transport(records, j) for j in paces[:_MOST_INPUTS]]
    likely = [f for f in each if f.ratio < _LARGEST_RATIO and f.delay > _LEAST_DELAY]
    return min(likely, key=lambda f: f.ratio, default=None)


_STORAGE = re.compile(
    r"tanks?|vessels?|reservoirs?|basins?|storages?|levels?|volumes?|overflows?|spills?|fill(s|ed)?"
)
_UNSIGNED = re.compile(
    r"magnitude|absolute (value|speed)|unsigned|rectifie[ds]|(without|no|loses its|lost its) sign"
)


def _described(facts: Facts, pattern: re.Pattern[str]) -> bool:
    """Return whether description, notes, strategies or names of signals and states match."""
    states = facts.physics.states if facts.physics else ()
    names = " ".join((*(s.name for s in (*facts.inputs, *facts.outputs)), *states))
    text = f"{facts.description} {facts.notes} {facts.strategies} {names}".lower()
    return re.search(rf"(?<![a-z])({pattern.pattern})(?![a-z])", text) is not None


def has_storage(facts: Facts) -> bool:
    """Return whether the user's words tell of something that fills and can overflow."""
    return _described(facts, _STORAGE)


def sign_lost(facts: Facts) -> float:
    """Return how likely the outputs lack their sign: 1 where the user's words say so, 0.5 where
    every output only touches zero, 0 where one is negative."""
    y = np.concatenate([r.y for r in facts.records])
    low, high = np.quantile(y, (0.05, 0.95), axis=0)
    if (y.min(axis=0) < -0.05 * high).any() or (high <= 0).any():
        return 0.0
    return 1.0 if _described(facts, _UNSIGNED) else 0.5 * bool((low < 0.05 * high).all())


def plateau_share(facts: Facts) -> float:
    """Largest share over the outputs of samples within 0.5 % of the range from the maximum: a
    signal that stays there is limited by the system or by its sensor."""
    y = np.concatenate([r.y for r in facts.records])
    reach = y.max(axis=0) - 0.005 * (y.max(axis=0) - y.min(axis=0))
    return float((y >= reach).mean(axis=0).max())
