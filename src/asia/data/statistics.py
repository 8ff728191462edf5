"""Statistics of records: delay and feedback of each pair of signals, integrators, resonances,
drift, noise of periods, levels and switching. Checks, verdicts, process models and
agents read them here, and estimate none themselves.

Every test says how often it errs: its level holds for the family of all signals, pairs and lags of
the records (Holm, Scandinavian Journal of Statistics 6, 1979). No result depends on the units of
the signals.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from asia._progress import tracked
from asia._statement import LEAST_FIT
from asia.data.frequency import find_period, frequency_response
from asia.data.process import OutputTransfer, fit_transfer, once_for_records
from asia.data.trajectory import Array, Signal, Trajectory, deviations, is_constant
from asia.errors import UserError


def _lagged(values: Array, lags: range, most: int) -> list[Array]:
    """Samples of a signal from number `most` on, late by each of the lags."""
    return [values[most - k : len(values) - k] for k in lags]


def _block_means(values: Array, size: int) -> Array:
    """Means (blocks, n) of blocks of so many samples."""
    blocks = len(values) // size
    return values[: blocks * size].reshape(blocks, size, -1).mean(axis=1)


# Delay from each input to each output.


FALSE_ALARMS = 0.01
"""Chance of a false alarm in all records, over every pair of signals and lag."""
# Samples that correlations take; most pairs of signals for which transfer functions are fitted;
# least samples of a record.
_MOST_SAMPLES, _MOST_PAIRS, _SHORTEST = 20_000, 12, 64
# Order of the filter that whitens an input, and the share of its deviation below which what is left
# of a predictable input says nothing.
_WHITENING, _PREDICTABLE = 20, 1e-3


@dataclass(frozen=True)
class Delay:
    """Delay from an input to an output.

    Attributes:
        lag: samples until the output responds, 0 for a direct feedthrough; None where no effect is
            seen. interval: its 95 % interval in samples; None where the lag is the first
            significant correlation. correlation: (lags,) of the whitened input with the output,
            from 0 on, the effects of other inputs taken out; band: what chance exceeds in one of
            a hundred files.
    """

    lag: int | None
    interval: tuple[int, int] | None
    correlation: Array
    band: float


@once_for_records
def transfers(records: tuple[Trajectory, ...]) -> tuple[OutputTransfer | None, ...]:
    """Transfer functions of lags to each output; None where the records are too short for them, or
    have too many signals."""
    found: list[OutputTransfer | None] = []
    (nu, ny) = records[0].u.shape[1], records[0].y.shape[1]
    for output in tracked(range(ny), "output"):
        try:
            found.append(fit_transfer(records, output) if nu * ny <= _MOST_PAIRS else None)
        except (UserError, np.linalg.LinAlgError):
            found.append(None)
    return tuple(found)


@once_for_records
def delays(records: tuple[Trajectory, ...]) -> tuple[tuple[Delay | None, ...], ...]:
    """Delay to each output (rows) from each input (columns); None where a signal does not move or
    the records are short.

    It is the number of leading coefficients of the response that do not exceed their error. Where a
    transfer function of lags leaves errors that are independent of the inputs, the coefficients are
    judged beside it; elsewhere by the correlation of the whitened input with the output (Box and
    Jenkins, Time Series Analysis, section 11.2).
    """
    used = _usable(records)
    nu, ny = records[0].u.shape[1], records[0].y.shape[1]
    if not used:
        return ((None,) * nu,) * ny
    known = transfers(records)
    return tuple(tuple(_delay(used, j, i, known[i], nu * ny) for j in range(nu)) for i in range(ny))


def _usable(records: Sequence[Trajectory]) -> dict[int, Trajectory]:
    """Whole records, by their number, up to a number of samples, at least the start of one."""
    kept: dict[int, Trajectory] = {}
    for number, record in enumerate(records):
        left = _MOST_SAMPLES - sum(map(len, kept.values()))
        if min(left, len(record)) >= _SHORTEST:
            kept[number] = record[: min(left, len(record))]
    return kept


def _delay(
    records: dict[int, Trajectory],
    channel: int,
    output: int,
    transfer: OutputTransfer | None,
    pairs: int,
) -> Delay | None:
    u = [r.u[:, channel] for r in records.values()]
    y = [r.y[:, output] for r in records.values()]
    if is_constant(np.concatenate(u)) or is_constant(np.concatenate(y)):
        return None
    own = None
    if transfer is not None and transfer.adequate:
        own = transfer.inputs[channel]
        # The effects of the other inputs are taken out.
        parts = _contributions(transfer, records)
        parts = [np.delete(one, channel, axis=1).sum(axis=1) for one in parts]
        y = [one - part for one, part in zip(y, parts, strict=True)]
    longest, shortest = max(map(len, u)), min(map(len, u))
    lags = max(min(max(100, longest // 6), shortest - 3 * _WHITENING), 1)
    correlation, chance = _correlation(u, y, lags)
    band = NormalDist().inv_cdf(1.0 - FALSE_ALARMS / (2.0 * len(correlation) * pairs))
    hits = np.flatnonzero(np.abs(correlation) > band * chance)
    shown = band * float(np.median(chance))
    if own is None:
        return Delay(int(hits[0]) if hits.size else None, None, correlation, shown)
    if not own.acts:
        return Delay(None, None, correlation, shown)
    ends = [math.floor(end + 1e-6) + 1 for end in (own.delay.low, own.delay.high - 2e-6)]
    interval = min(ends[0], own.first), max(ends[1], own.first)
    return Delay(own.first, interval, correlation, shown)


def _contributions(transfer: OutputTransfer, records: dict[int, Trajectory]) -> list[Array]:
    """Simulated parts (T, nu) of all inputs; 0 in records that the fit did not take."""
    found: list[Array] = []
    for number, record in records.items():
        whole = np.zeros((len(record), len(transfer.contributions)))
        if number < len(transfer.errors):
            part = np.stack([one[number] for one in transfer.contributions], axis=1)[: len(record)]
            whole[: len(part)] = part
            whole[len(part) :] = part[-1]
        found.append(whole)
    return found


def _correlation(u: Sequence[Array], y: Sequence[Array], lags: int) -> tuple[Array, Array]:
    """Correlations (lags + 1,) of an input, whitened by its past, with the output after the same
    filter, and the deviation of each by chance."""
    order = min(_WHITENING, min(map(len, u)) // 8)
    both = np.concatenate(u)
    centred = [(v - both.mean()) / float((both - both.mean()).std()) for v in u]
    rows = np.concatenate([np.lib.stride_tricks.sliding_window_view(v, order + 1) for v in centred])
    weights = np.concatenate(
        [[1.0], -np.linalg.lstsq(rows[:, :-1][:, ::-1], rows[:, -1], rcond=1e-8)[0]]
    )
    mean, size = float(np.concatenate(y).mean()), float(np.concatenate(y).std())
    pairs = [
        tuple(np.convolve(v, weights)[order : len(v)] for v in (a, (b - mean) / size))
        for a, b in zip(centred, y, strict=True)
    ]
    products, squares = np.zeros(lags + 1), np.zeros(lags + 1)
    energy = [float(sum(p[k] @ p[k] for p in pairs)) for k in (0, 1)]
    for a, b in pairs:
        for k in range(min(lags, len(a) - 1) + 1):
            one = a[: len(a) - k] * b[k:]
            products[k] += one.sum()
            squares[k] += one @ one
    norm = max(math.sqrt(energy[0] * energy[1]), 1e-300)
    # Held inputs are new at few samples: their correlations by chance are the larger.
    least = norm / math.sqrt(max(sum(len(a) for a, _ in pairs), 1))
    return products / norm, np.maximum(np.sqrt(squares), least) / norm


# Feedback of outputs on inputs, and drift of outputs, by the innovations of predictors.


# Lags of outputs and inputs in a predictor, lags of feedback that are tested, and far ones that
# tell the deviation by chance; correlation below which feedback does not matter.
_OWN_LAGS, _INPUT_LAGS, _BACK, _FAR_LAGS, _LEAST = 10, 20, 20, 200, 0.05
# Median sizes of an input's news at which they are clipped.
_CLIPPED = 4.0
# Deviations of a trend by chance that a drift exceeds.
_TREND = 5.0


@dataclass(frozen=True)
class Predictor:
    """Innovations of an output, given past outputs and inputs.

    Attributes:
        innovations: (T - lags,) of each record; trend: rise of the output over the longest record
            by drift, over its error by chance.
    """

    innovations: tuple[Array, ...]
    trend: float


@once_for_records
def feedback(records: tuple[Trajectory, ...]) -> Array:
    """Chance (nu, ny) of such a correlation of an input with past disturbances of an output in an
    open loop; nan where it was not tested. Below 0.01 the input follows the output: that is the
    chance of one false alarm over all pairs.

    In an open loop the innovations of the outputs are independent of the inputs, whatever these are
    (Ljung, System Identification, 2nd ed., section 13.4). Inputs are whitened by the past of all
    inputs, so that what a linear predictor leaves of the plant does not matter either.
    """
    return _feedback(records)[0]


@once_for_records
def _feedback(records: tuple[Trajectory, ...]) -> tuple[Array, Array]:
    """Chances (nu, ny) and correlations (nu, ny) of feedback."""
    used = _usable(records)
    nu, ny = records[0].u.shape[1], records[0].y.shape[1]
    chances, sizes = np.full((nu, ny), np.nan), np.zeros((nu, ny))
    if not used:
        return chances, sizes
    news = _all_news(used)
    for i in range(ny):
        predictor = _predictor(records, i)
        if predictor is None:
            continue
        for j, new in enumerate(news):
            if new is None:
                continue
            # Rare jumps of an input hide what it follows between them.
            both = np.concatenate(new)
            clip = max(_CLIPPED * float(np.median(np.abs(both))), _PREDICTABLE)
            tests = [
                _strength(made, predictor.innovations)
                for made in (new, [np.clip(a, -clip, clip) for a in new])
            ]
            chances[j, i] = min(len(tests) * min(chance for chance, _ in tests), 1.0)
            sizes[j, i] = max(size for _, size in tests)
    tested = np.isfinite(chances)
    chances[tested] = np.where(sizes[tested] < _LEAST, 1.0, _holm(chances[tested]))
    return chances, np.where(chances < FALSE_ALARMS, sizes, 0.0)


def _all_news(records: dict[int, Trajectory]) -> list[list[Array] | None]:
    """`_news` of every input."""
    used = list(records.values())
    lengths, nu = [len(r) for r in used], used[0].u.shape[1]
    order = max(min(_INPUT_LAGS, sum(lengths) // (12 * (nu + 1)), min(lengths) // 4), 1)
    return [_news(used, j, order) for j in range(nu)]


@once_for_records
def at_once(records: tuple[Trajectory, ...]) -> Array:
    """Chance (nu, ny) of such a correlation of an output with an input in the same sample, both
    given their past; nan where it was not tested.

    An input that is held from its sample on cannot act there: below 0.01, the chance of one false
    alarm over all pairs, it moves between samples, or there is a direct feedthrough, or the input
    is computed from that output.
    """
    used = _usable(records)
    chances = np.full((records[0].u.shape[1], records[0].y.shape[1]), np.nan)
    news = _all_news(used) if used else []
    for i in range(chances.shape[1]):
        predictor = _predictor(records, i)
        for j, new in enumerate(news):
            if predictor is not None and new is not None:
                pairs = _side_by_side(new, predictor.innovations)
                chances[j, i] = 2.0 * NormalDist().cdf(-abs(_studentised(pairs, 0)))
    tested = np.isfinite(chances)
    chances[tested] = _holm(chances[tested])
    return chances


def _side_by_side(news: Sequence[Array], innovations: Sequence[Array]) -> list[tuple[Array, Array]]:
    """An input's news and innovations of the same samples, by record."""
    return [
        (a[-min(len(a), len(e)) :], e[-min(len(a), len(e)) :])
        for a, e in zip(news, innovations, strict=True)
    ]


def _strength(news: Sequence[Array], innovations: Sequence[Array]) -> tuple[float, float]:
    """Chance of the largest correlation of an input's news with earlier innovations, and that
    correlation."""
    pairs = _side_by_side(news, innovations)
    longest, samples = max(len(a) for a, _ in pairs), sum(len(a) for a, _ in pairs)
    near = min(_BACK, longest // 4)
    most = min(near + _FAR_LAGS, longest // 2)
    back = np.abs([_studentised(pairs, k) for k in range(1, most + 1)])
    # Far lags show the deviation that a plant with more than a predictor leaves.
    far = float(np.median(back[near:])) / 0.6745 if most > near + 20 else 1.0
    largest = float(back[:near].max(initial=0.0))
    chance = min(2.0 * near * NormalDist().cdf(-largest / max(far, 1.0)), 1.0)
    return chance, largest / math.sqrt(samples)


def _holm(chances: Array) -> Array:
    """Chances for the family of tests, by Holm's method."""
    order = np.argsort(chances)
    found = np.empty(len(chances))
    found[order] = np.maximum.accumulate(
        np.minimum(chances[order] * (len(chances) - np.arange(len(chances))), 1.0)
    )
    return found


def _studentised(pairs: Sequence[tuple[Array, Array]], lag: int) -> float:
    """Sum of products of a and b, `lag` samples earlier, over its deviation by chance."""
    products = [a[lag:] * b[: len(b) - lag] for a, b in pairs if len(a) > lag]
    both = np.concatenate(products) if products else np.zeros(0)
    both = both[np.isfinite(both)]
    size = float(np.sqrt(both @ both))
    return float(both.sum()) / size if size > 0 else 0.0


def _news(records: Sequence[Trajectory], channel: int, order: int) -> list[Array] | None:
    """What the past of all inputs does not say of an input, by record; None where that is nothing,
    as for a few sines."""
    u = np.concatenate([r.u for r in records])
    if is_constant(u[:, channel]):
        return None
    mean, size = u.mean(axis=0), deviations(u)
    scaled = [(r.u - mean) / size for r in records]
    pasts = [
        np.hstack([*_lagged(v, range(1, order + 1), order), np.ones((len(v) - order, 1))])
        for v in scaled
    ]
    response = np.concatenate([v[order:, channel] for v in scaled])
    theta = np.linalg.lstsq(np.concatenate(pasts), response, rcond=1e-10)[0]
    new = [v[order:, channel] - past @ theta for v, past in zip(scaled, pasts, strict=True)]
    return new if float(np.concatenate(new).std()) > _PREDICTABLE else None


def _predictor(records: tuple[Trajectory, ...], output: int) -> Predictor | None:
    """Predictor of an output from past outputs, inputs, their products, the transfer function and
    time; None where the output does not move, or the records are short."""
    used = _usable(records)
    if not used:
        return None
    y = np.concatenate([r.y for r in used.values()])
    if is_constant(y[:, output]):
        return None
    u = np.concatenate([r.u for r in used.values()])
    u_mean, u_size, y_mean, y_size = u.mean(axis=0), deviations(u), y.mean(axis=0), deviations(y)
    nu, ny = u.shape[1], y.shape[1]
    lengths = [len(r) for r in used.values()]
    samples = sum(lengths)
    own = min(_OWN_LAGS, samples // (12 * ny))
    late = min(_INPUT_LAGS, samples // (12 * (nu + 1)))
    first = max(own, late, 1)
    if min(lengths) < first + 20:
        return None
    transfer = transfers(records)[output]
    parts = [] if transfer is None else _contributions(transfer, used)
    longest = max(lengths)
    blocks: list[Array] = []
    targets: list[Array] = []
    for k, r in enumerate(used.values()):
        v, w = (r.u - u_mean) / u_size, (r.y - y_mean) / y_size
        last, before = w[first - 1 : len(w) - 1, output : output + 1], v[first - 1 : len(v) - 1]
        columns = [
            *_lagged(w, range(1, own + 1), first),
            *_lagged(v, range(1, late + 1), first),
            before**2, before * last, last**2,
            np.ones((len(v) - first, 1)),
            np.linspace(0.0, len(v) / longest, len(v))[first:, None],
        ]  # fmt: skip
        if parts:
            columns.append(parts[k][first:] / y_size[output])
        blocks.append(np.hstack(columns))
        target = w[first:, output].copy()
        if r.missing is not None:
            target[r.missing[first:, output]] = np.nan
        targets.append(target)
    x, target = np.concatenate(blocks), np.concatenate(targets)
    seen = np.isfinite(target)
    scale = np.maximum(np.linalg.norm(x[seen], axis=0), 1e-300)
    normal = np.linalg.pinv((x[seen] / scale).T @ (x[seen] / scale), rcond=1e-10)
    theta = normal @ ((x[seen] / scale).T @ target[seen]) / scale
    errors = target - x @ theta
    place = own * ny + late * nu + 2 * nu + 2
    freedom = max(int(seen.sum()) - x.shape[1], 1)
    deviation = float(np.sqrt(np.nansum(errors**2) / freedom)) or 1.0
    wide = deviation * math.sqrt(max(float(normal[place, place]), 1e-300)) / scale[place]
    ends = np.cumsum([len(t) for t in targets])[:-1]
    return Predictor(
        tuple(e / deviation for e in np.split(errors, ends)), float(theta[place] / wide)
    )


@once_for_records
def drifts(records: tuple[Trajectory, ...]) -> tuple[float, ...]:
    """Rise of each output over the longest record by drift, in its unit; 0 without.

    A drift is a straight line that neither inputs nor past outputs explain, and that explains more
    than half of the output's variance. The rise of an output that integrates is no drift.
    """
    longest = max(records, key=len)
    found = [0.0] * longest.y.shape[1]
    if len(longest) < _SHORTEST:
        return tuple(found)
    time = np.arange(len(longest)) - (len(longest) - 1) / 2
    still = integrating(records)
    for output, values in enumerate(longest.y.T):
        if is_constant(values) or output in still:
            continue
        y = values - values.mean()
        slope = float(time @ y / (time @ time))
        if slope**2 * float(time @ time) <= 0.5 * float(y @ y):
            continue
        predictor = _predictor(records, output)
        if predictor is None or abs(predictor.trend) > _TREND:
            found[output] = slope * (len(longest) - 1)
    return tuple(found)


# Integrating outputs and resonances.


# Blocks of all records, lags of the model of their means, and the least pole that counts: a time
# constant of a fifth of the records.
_BLOCKS, _BLOCK_LAGS, _LEAST_POLE, _LARGEST_POLE = 240, 3, 0.975, 1.05
_LEAST_SAMPLES = 60


@once_for_records
def integrating(records: tuple[Trajectory, ...]) -> tuple[int, ...]:
    """Numbers of the outputs that drift with the sum of the inputs and do not come back."""
    return tuple(i for i in range(records[0].y.shape[1]) if _integrates(records, i))


def _integrates(records: tuple[Trajectory, ...], output: int) -> bool:
    transfer = transfers(records)[output]
    if transfer is not None and transfer.adequate and transfer.fit >= LEAST_FIT:
        return any(one is not None and one.structure.integrator for one in transfer.inputs)
    size = max(1, sum(len(r) for r in records) // _BLOCKS)
    means = [
        (_block_means(r.u, size), _block_means(r.y, size))
        for r in records
        if len(r) // size > 4 * _BLOCK_LAGS
    ]
    if sum(len(u) for u, _ in means) < _LEAST_SAMPLES:
        return False
    # A ramp beside the inputs is drift.
    means = [(np.column_stack([u, np.arange(float(len(u)))]), y) for u, y in means]
    poles = _one_step_poles(means, output, _BLOCK_LAGS, 0)
    real = np.real(poles)[abs(np.imag(poles)) < 0.02]
    return bool(_LEAST_POLE < float(real.max(initial=0.0)) < _LARGEST_POLE)


def _one_step_poles(
    signals: Sequence[tuple[Array, Array]], output: int, order: int, first: int
) -> NDArray[Any]:
    """Poles of a linear one-step model of an output, with the inputs from lag `first` on."""
    u = np.concatenate([one for one, _ in signals])
    y = np.concatenate([one[:, output] for _, one in signals])
    if is_constant(y):
        return np.zeros(0)
    mean, size = u.mean(axis=0), deviations(u)
    level, spread = float(y.mean()), float(y.std())
    scaled = [((one - mean) / size, (two[:, output] - level) / spread) for one, two in signals]
    x = np.concatenate([
        np.column_stack([
            *_lagged(y, range(1, order + 1), order),
            *_lagged(u, range(first, order + 1), order),
            np.ones(len(y) - order),
        ])
        for u, y in scaled
    ])  # fmt: skip
    response = np.concatenate([y[order:] for _, y in scaled])
    theta = np.linalg.lstsq(x, response, rcond=1e-10)[0]
    return np.roots([1.0, *-theta[:order]])


# Lightly damped modes of a one-step model: lags, largest damping ratio, least samples a period.
# Noise alone makes modes near the Nyquist frequency.
_MODE_LAGS, _LIGHT, _LEAST_PERIOD = 8, 0.1, 3.0


@once_for_records
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


@once_for_records
def period(records: tuple[Trajectory, ...]) -> int | None:
    """Period of the inputs in samples; None without one."""
    return find_period(records)


@once_for_records
def noise_of_periods(records: tuple[Trajectory, ...]) -> float | None:
    """Noise floor of V from the variation between periods: standard deviation of the noise over
    that of the output, mean over the outputs. None without periods."""
    period = find_period(records)
    outputs = range(records[0].y.shape[1])
    found = [frequency_response(records, k, period) for k in outputs]
    levels = [one.levels.noise for one in found if one is not None]
    known = [level for level in levels if level is not None]
    return sum(known) / len(known) if len(known) == len(outputs) else None


def several_levels(records: Sequence[Trajectory]) -> bool:
    """Return whether the inputs come in levels that are clearly apart, several records a level."""
    scale = deviations(np.concatenate([r.u for r in records]))
    sizes = np.sort([np.sqrt(((r.u / scale) ** 2).mean()) for r in records])
    cuts = np.flatnonzero(sizes[1:] > _APART * sizes[:-1]) + 1
    return len(cuts) > 0 and min(map(len, np.split(sizes, cuts))) >= _FEWEST


# Effect of the inputs, size of a feedback, and instability.


# A mode that grows this much over the records.
_GROWTH = 100.0


@once_for_records
def acts(records: tuple[Trajectory, ...]) -> bool:
    """Return whether an input, or its square, has an effect on an output."""
    squared = tuple(replace(r, u=(r.u - r.u.mean(axis=0)) ** 2) for r in records)
    found = (d for part in (records, squared) for row in delays(part) for d in row)
    return any(d is not None and d.lag is not None for d in found)


@once_for_records
def feedback_size(records: tuple[Trajectory, ...]) -> float:
    """Greatest correlation of an input with past disturbances of outputs; 0 where it may be chance,
    or where the inputs are too regular to tell."""
    return float(_feedback(records)[1].max(initial=0.0))


@once_for_records
def largest_pole(records: tuple[Trajectory, ...]) -> float:
    """Greatest modulus of the poles of a linear one-step model; 0 for short records."""
    most = max(_MOST_SAMPLES // len(records), 20 * _OWN_LAGS)
    signals = [(r.u[:most], r.y[:most]) for r in records if len(r) > 6 * _OWN_LAGS]
    poles: list[float] = []
    for k in range(records[0].y.shape[1]) if signals else ():
        # A model of too high an order has poles of its own: the lesser of two orders counts. The
        # present input is left out: in a loop it holds the present output.
        each = [_one_step_poles(signals, k, order, 1) for order in (2, 4)]
        poles.append(min(float(abs(found).max(initial=0.0)) for found in each))
    return max(poles, default=0.0)


def unstable(records: Sequence[Trajectory]) -> bool:
    """Return whether a growing mode makes a free simulation of the longest record diverge."""
    return largest_pole(records) ** max(map(len, records)) > _GROWTH


@once_for_records
def needs_loop(records: tuple[Trajectory, ...]) -> bool:
    """Return whether the plant is unstable in the records and in both of their halves: only a loop
    keeps it within bounds."""
    if min(map(len, records)) < 2 * _SHORTEST:
        return False
    halves = [r[: len(r) // 2] for r in records], [r[len(r) // 2 :] for r in records]
    return all(unstable(part) for part in (records, *halves))


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


@once_for_records
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


# Limits that an output is driven against.


# Samples of the shortest rest: fewer at a limit may be the top of a motion.
_SHORTEST_REST = 3


@once_for_records
def limit_shares(records: tuple[Trajectory, ...]) -> tuple[tuple[float, float], ...]:
    """Share of the samples of each output at its least and at its greatest value, reached more than
    once and held while inputs move. A signal at rest, or a frozen one, is at no limit."""
    spread = np.concatenate([r.u for r in records]).std(axis=0)
    found: list[tuple[float, float]] = []
    for j in range(records[0].y.shape[1]):
        values = np.concatenate([r.y[r.measured[:, j], j] for r in records])
        low, high = float(values.min(initial=np.inf)), float(values.max(initial=-np.inf))
        near, shares = 1e-6 * (high - low), list[float]()
        for sign, end in ((1.0, low), (-1.0, high)):
            held: list[int] = []
            for r in records:
                at = (sign * (r.y[:, j] - end) <= near) & r.measured[:, j]
                edges = np.flatnonzero(np.diff(np.concatenate([[False], at, [False]])))
                for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
                    u = r.u[first : first + max(2 * (last - first) // 3, 1)]
                    moves = (u.std(axis=0) > 0.3 * spread)[spread > 0].any()
                    if moves or last - first < _SHORTEST_REST:
                        held.append(last - first)
            shares.append(sum(held) / max(len(values), 1) if len(held) > 1 else 0.0)
        found.append((shares[0], shares[1]))
    return tuple(found)


# Share of repeated samples from which an input is a staircase: one that is drawn anew at every
# sample from two levels repeats half of them.
_REPEATED = 1.0 / 3.0


def staircases(records: Sequence[Trajectory]) -> tuple[bool, ...]:
    """Return for each input whether it is constant over several samples at a time, as only an input
    that is held between samples is."""
    steps = np.concatenate([np.diff(r.u, axis=0) for r in records])
    return tuple(bool(share >= _REPEATED) for share in (steps == 0.0).mean(axis=0))


def undecided_inputs(inputs: Sequence[Signal], records: Sequence[Trajectory]) -> tuple[Signal, ...]:
    """Inputs whose behaviour between samples neither the problem file nor a staircase in the
    records decides."""
    return tuple(
        signal
        for signal, stairs in zip(inputs, staircases(records), strict=True)
        if signal.intersample is None and signal.role != "time_step" and not stairs
    )


def plateau_share(records: Sequence[Trajectory]) -> float:
    """Largest share over the outputs of samples within 0.5 % of the range from the maximum: a
    signal that stays there is limited by the system or by its sensor."""
    y = np.concatenate([r.y for r in records])
    reach = y.max(axis=0) - 0.005 * (y.max(axis=0) - y.min(axis=0))
    return float((y >= reach).mean(axis=0).max())
