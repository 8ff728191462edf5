"""Residual analysis: correlations, diagnostics, signed residuals over parts of the data."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from asia.data.trajectory import Array, Signal
from asia.errors import CandidateError, Reason

_LAGS = 40
QUANTILE = 2.5758293035489004


def pooled(parts: Sequence[Array]) -> Array:
    """All samples of all cases, one below the other; a single one, which may be long, as it is."""
    return parts[0] if len(parts) == 1 else np.concatenate(list(parts), axis=0)


def cross_correlation(a: Sequence[Array], b: Sequence[Array], most: int) -> Array:
    """Correlation of a(t) with b(t - lag) for lags -most..most, (2 most + 1,).

    Args:
        a, b: one (H,) array a block; each block is centred, products never join two blocks
    """
    total = np.zeros(2 * most + 1)
    energy_a = energy_b = 0.0
    # Blocks of one length together: windows come in hundreds.
    for length in dict.fromkeys(len(x) for x in a):
        x = np.stack([x for x in a if len(x) == length])
        y = np.stack([y for x, y in zip(a, b, strict=True) if len(x) == length])
        x, y = x - x.mean(axis=1, keepdims=True), y - y.mean(axis=1, keepdims=True)
        energy_a += float(np.sum(x * x))
        energy_b += float(np.sum(y * y))
        reach = min(most, length - 1)
        for lag in range(-reach, reach + 1):
            early = y[:, max(0, -lag) : length - max(0, lag)]
            late = x[:, max(0, lag) : length - max(0, -lag)]
            total[most + lag] += float(np.sum(late * early))
    floor = np.finfo(np.float64).tiny
    return total / np.sqrt(max(energy_a * energy_b, floor))


def white_band(samples: int) -> float:
    """99 % band of the autocorrelation of white residuals (Ljung, System Identification, 16.6)."""
    return QUANTILE / np.sqrt(samples)


def independent_band(residual: Sequence[Array], u: Sequence[Array], most: int) -> float:
    """99 % band of the cross-correlation when residual and input are independent, both coloured:
    the variance is sum_k R_e(k) R_u(k) / N (Ljung, System Identification, 16.6), here with
    Bartlett weights, which keep it positive, over lags up to `most`."""
    samples = sum(len(r) for r in residual)
    weights = 1.0 - np.abs(np.arange(-most, most + 1)) / (most + 1)
    products = cross_correlation(residual, residual, most) * cross_correlation(u, u, most)
    return float(QUANTILE * np.sqrt(max(float(weights @ products), 0.0) / samples))


@dataclass(frozen=True)
class Correlation:
    """Correlation of a residual with a signal, over all blocks together."""

    lags: tuple[int, ...]
    """Lags in samples; positive where the signal is earlier."""
    values: Array
    """One a lag."""
    band: float
    """Band that holds 99 % of the correlations of white noise."""


def with_own_past(e: Sequence[Array]) -> Correlation:
    """Return the autocorrelation of residuals, one (H,) array a block, at lags 0 .. 40, fewer in
    short blocks."""
    lags = _longest(e)
    values = cross_correlation(e, e, lags)[lags:]
    return Correlation(tuple(range(lags + 1)), values, white_band(sum(len(r) for r in e)))


def with_input(e: Sequence[Array], u: Sequence[Array]) -> Correlation:
    """Return the cross-correlation of residuals with an input, one (H,) array a block each, at lags
    -40 .. 40, fewer in short blocks."""
    lags = _longest(e)
    far = max(lags, min(4 * lags, min(len(r) for r in e) - 1))
    values = cross_correlation(e, u, lags)
    return Correlation(tuple(range(-lags, lags + 1)), values, independent_band(e, u, far))


def _longest(e: Sequence[Array]) -> int:
    return max(1, min(_LAGS, min(len(r) for r in e) // 4))


# Diagnostics of training residuals; agents may see these, and no validation or test output is
# used.

Samples = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Diagnostics:
    """Residual analysis of one fold's training simulation, worst channel of each.

    train_error: the normalised metric on the training records. bias: |mean residual| / scale.
    whiteness: largest |autocorrelation| at lags 1..20, over all pairs of samples inside one record
    or window. input_correlation: largest |cross-correlation| of residual and past inputs, lags
    0..20, likewise. top_error and bottom_error: RMS
    residual where the output lies in its highest / lowest tenth, over the RMS residual.
    start_error: RMS residual in the first 5 % of the records, over the RMS residual. curvature:
    |correlation| of the residual with the squared centred output. All are 0 where there is none.
    """

    train_error: float = 0.0
    bias: float = 0.0
    whiteness: float = 0.0
    input_correlation: float = 0.0
    top_error: float = 0.0
    bottom_error: float = 0.0
    start_error: float = 0.0
    curvature: float = 0.0


def diagnose(
    u: Sequence[Array], y: Sequence[Array], y_hat: Sequence[Array], scale: Array, train_error: float
) -> Diagnostics:
    """Residual analysis of simulated training records, one (H, n) array a record or window. Raises
    CandidateError when the residual is too large to analyse."""
    with np.errstate(over="ignore", invalid="ignore"):
        residual = [a - b for a, b in zip(y, y_hat, strict=True)]
        for one in residual:
            one /= scale
        e, out = pooled(residual), pooled(y)
        rms = np.sqrt(np.mean(e**2, axis=0)) + 1e-300
        starts = np.concatenate([r[: max(1, len(r) // 20)] for r in residual])
        place = np.concatenate([np.arange(len(r)) for r in residual]) if len(residual) > 1 else None
        del residual
        centred, inputs = e - e.mean(axis=0), pooled(u)
        inputs = inputs - inputs.mean(axis=0)
        own_past = [
            float(np.abs(_products(late, early)).max())
            for late, early in _pairs(centred, centred, place, 1)
        ]
        past_inputs = [
            float(np.abs(_unit(late).T @ _unit(early)).max())
            for late, early in _pairs(centred, inputs, place, 0)
        ]
        bend = (out - out.mean(axis=0)) ** 2
        top, bottom = np.quantile(out, 0.9, axis=0), np.quantile(out, 0.1, axis=0)
        found = Diagnostics(
            train_error=train_error,
            bias=float(np.max(np.abs(e.mean(axis=0)))),
            whiteness=max(own_past, default=0.0),
            input_correlation=max(past_inputs, default=0.0),
            top_error=float(np.max(_rms_where(e, out >= top) / rms)),
            bottom_error=float(np.max(_rms_where(e, out <= bottom) / rms)),
            start_error=float(np.max(np.sqrt(np.mean(starts**2, axis=0)) / rms)),
            curvature=float(np.max(np.abs(_products(centred, bend - bend.mean(axis=0))))),
        )
    if not all(math.isfinite(value) for value in astuple(found)):
        raise CandidateError(Reason.NOT_FINITE, "the simulation of the training data diverged")
    return found


def _rms_where(e: Array, chosen: Mask) -> Array:
    weight = chosen.astype(np.float64)
    return np.sqrt((e**2 * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1.0))


def _unit(x: Array) -> Array:
    return x / np.maximum(np.sqrt((x**2).sum(axis=0)), 1e-300)


def _products(a: Array, b: Array) -> Array:
    found = _unit(a)
    found *= _unit(b)
    return found.sum(axis=0)


def _pairs(
    a: Array, b: Array, place: Samples | None, first_lag: int
) -> Iterator[tuple[Array, Array]]:
    """Iterate over the lags that have enough pairs, with the samples a(t) and b(t - lag) of one
    record; place: each sample's number within its record, None where there is but one."""
    for lag in range(first_lag, 21):
        if place is None:
            if len(a) - lag < 3:
                return
            yield a[lag:], b[: len(b) - lag]
            continue
        late = np.flatnonzero(place >= lag)
        if len(late) < 3:
            return
        yield a[late], b[late - lag]


# Mean signed residuals over parts of the data: regions where a model is too high or too low.

BINS = 5
"""Parts of equal width into which the range of a signal is cut."""
_TIME_PARTS = ("first", "middle", "last")
_LONGEST_MEMORY = 200
_FEWEST_SAMPLES = 10
_STANDARD_ERRORS = 3.0
_SMALLEST_MEAN = 0.3
_SMALLEST_SHARE = 0.02
_CLEAR_ERRORS = 1.5
_START = 20
_MOST_OF_IT = 0.8
_STEP = 0.25
_MOST_STEPS = 0.1
_TURN = 0.1


class PartKind(StrEnum):
    """Property that the samples of a part share."""

    OUTPUT = "output"
    """The simulated output lies in one part of its range."""
    INPUT = "input"
    """An input lies in one part of its range."""
    TIME = "time"
    """The first, middle or last third of their record or window."""
    CHANGE = "change"
    """The simulated output falls (part 0) or rises (part 1) fast."""
    STEP = "step"
    """Samples after a step of an input down (part 0) or up (part 1)."""
    TURN = "turn"
    """Samples after a minimum (part 0) or a maximum (part 1) of the simulated output."""
    START = "start"
    """The first twentieth of a record or window, where the initial state still acts; the parts of
    every other kind but TIME and ALL leave them out."""
    ALL = "all"
    """All samples."""


class Evidence(StrEnum):
    """Significance of a mean residual."""

    CLEAR = "clear"
    """More than 1.5 standard errors, and 2 % of the squared residual: worth a look."""
    CHANCE = "may be chance"
    """Between 1 and 1.5 standard errors, and 2 % of the squared residual."""
    NONE = "none"
    """Less."""


def evidence_of_mean(mean: float, error: float, share: float) -> Evidence:
    """The one rule by which residuals are listed.

    Args:
        share: of the squared residual that would be gone without `mean`
    """
    if share <= _SMALLEST_SHARE or abs(mean) <= error:
        return Evidence.NONE
    return Evidence.CLEAR if abs(mean) > _CLEAR_ERRORS * error else Evidence.CHANCE


@dataclass(frozen=True)
class SignedResidual:
    """The mean residual of one output over one part of the data."""

    output: int
    kind: PartKind
    signal: int
    """Index of the input for INPUT and STEP, else of the output."""
    part: int
    """Number of the part, from 0."""
    low: float | None
    """Lower limit of this part, in the unit of the signal; None for the lowest part, and where
    there is no range."""
    high: float | None
    """Upper limit of this part; None for the highest part, and where there is no range."""
    mean: float
    """Mean of measured minus simulated output in the given standard deviations: above 0 the model
    is too low."""
    error: float
    """Standard error of `mean`; samples that follow each other are not counted as independent."""
    samples: int
    share: float
    """The share of the squared residual of this output that would be gone without `mean`."""
    gain: float
    """The same in squared standard deviations, over all samples, by which outputs compare."""
    notable: bool
    """Whether `mean` is more than three standard errors and three tenths of the RMS residual; along
    time eight tenths are enough."""

    def words(self, inputs: Sequence[Signal], outputs: Sequence[Signal]) -> str:
        """`tank2_level above 8 V: the model is too low by 0.21 ± 0.05 s.d.`"""
        signals = inputs if self.kind in (PartKind.INPUT, PartKind.STEP) else outputs
        name, own = signals[self.signal].name, outputs[self.output].name
        unit = signals[self.signal].unit
        unit = f" {unit}" if unit and unit != "-" else ""
        match self.kind:
            case PartKind.TIME:
                where = f"{_TIME_PARTS[self.part]} third of the simulation"
            case PartKind.START:
                where = "start, the first 5 % of a simulation"
            case PartKind.ALL:
                where = "mean over all samples"
            case PartKind.CHANGE:
                where = f"while {name} {('falls', 'rises')[self.part]} fast"
            case PartKind.STEP:
                where = f"after {name} steps {('down', 'up')[self.part]}"
            case PartKind.TURN:
                where = f"after a {('minimum', 'maximum')[self.part]} of {name}"
            case PartKind.OUTPUT | PartKind.INPUT:
                if self.low is None:
                    where = f"{name} below {self.high:g}{unit}"
                elif self.high is None:
                    where = f"{name} above {self.low:g}{unit}"
                else:
                    where = f"{name} {self.low:g} to {self.high:g}{unit}"
        apart = self.kind in (PartKind.TIME, PartKind.START, PartKind.ALL)
        whose = "the model" if name == own and not apart else f"the simulated {own}"
        return f"{where}: {whose} is too {'low' if self.mean > 0 else 'high'} by {self.size}"

    @property
    def evidence(self) -> Evidence:
        """Whether it is worth a look, by the rule of `evidence_of_mean`."""
        return evidence_of_mean(self.mean, self.error, self.share)

    @property
    def size(self) -> str:
        """`0.21 ± 0.05 s.d.`; an insignificant one is marked, `0.04 ± 0.03 s.d. (1.4 standard
        errors: may be chance)`."""
        words = f"{abs(self.mean):.2g} ± {self.error:.1g} s.d."
        if self.evidence is not Evidence.CHANCE:
            return words
        return f"{words} ({abs(self.mean) / self.error:.1f} standard errors: {Evidence.CHANCE})"


@dataclass(frozen=True)
class Ranges:
    """The edges between the parts of each signal's range, so that folds share their parts."""

    inputs: tuple[tuple[float, ...], ...]
    """BINS - 1 edges an input."""
    outputs: tuple[tuple[float, ...], ...]
    """BINS - 1 edges an output."""


def ranges_of(u: Sequence[Array], y: Sequence[Array]) -> Ranges:
    """The ranges of signals in records of (H, nu) and (H, ny), their outermost hundredths left
    out."""
    return Ranges(_edges(pooled(u)), _edges(pooled(y)))


def signed_residuals(
    u: Sequence[Array],
    y: Sequence[Array],
    y_hat: Sequence[Array],
    scale: Array,
    ranges: Ranges | None = None,
) -> tuple[SignedResidual, ...]:
    """Compute the mean residual of each output over parts of the data.

    Parts lie along the simulated value, along each input, along time, where the output rises or
    falls, after steps of the inputs and after the output's turning points. Those without enough
    samples are left out. The range of an output is that of its simulation, not of its measurement:
    with noise, the highest measured samples lie above the best possible model.

    Args:
        u, y, y_hat: inputs, measured and simulated outputs, one (H, n) array a record or window
        scale: (ny,), divisor of the residuals, such as the standard deviations of the outputs
        ranges: limits of the parts, None for those of `u` and `y`

    Returns:
        the residuals, the largest `gain` first
    """
    ranges = ranges or ranges_of(u, y)
    records = _Records(u, y, y_hat, scale)
    found: list[SignedResidual] = []
    for output in range(len(scale)):
        residual = records.residual[:, output]
        memory = records.memory(residual, 0.1)
        square = float((residual**2).mean())
        for kind, signal, part, low, high, chosen in _parts(records, output, ranges):
            samples = int(chosen.sum())
            partial = kind is PartKind.ALL or samples < len(residual)
            if samples < _FEWEST_SAMPLES or not partial or square <= 0:
                continue
            mean = float(residual[chosen].mean())
            error = float(np.sqrt(square / records.segments(chosen, memory)))
            # A drift over a whole record looks like noise with a long memory: along time a mean
            # that is most of the residual counts too.
            least, rms = _STANDARD_ERRORS * error, float(np.sqrt(square))
            if kind is PartKind.TIME:
                least = min(least, _MOST_OF_IT * rms)
            notable = abs(mean) > max(least, _SMALLEST_MEAN * rms)
            gain = samples / len(residual) * mean**2
            found.append(
                SignedResidual(
                    output, kind, signal, part, low, high, mean, error, samples, gain / square,
                    gain, notable,
                )
            )  # fmt: skip
    return tuple(sorted(found, key=lambda one: -one.gain))


class _Records:
    """Samples of all records, one below the other."""

    def __init__(
        self, u: Sequence[Array], y: Sequence[Array], y_hat: Sequence[Array], scale: Array
    ) -> None:
        self.u, self.y_hat = pooled(u), pooled(y_hat)
        self.scale = np.asarray(scale, dtype=np.float64)
        self.residual = pooled(y) - self.y_hat
        self.residual /= self.scale
        lengths = [len(one) for one in y]
        small = np.int32
        self.place = np.concatenate([np.arange(n, dtype=small) for n in lengths])
        """The number of each sample within its record."""
        self.after = np.concatenate([np.arange(n, dtype=small)[::-1] for n in lengths])
        """How many samples of its record follow it."""
        begun = [np.arange(n, dtype=small) >= max(1, n // _START) for n in lengths]
        self.begun = np.concatenate(begun)
        """Whether a sample lies behind the start of its record."""
        third = [(np.arange(n) * 3 // n).astype(np.int8) for n in lengths]
        self.third = np.concatenate(third)
        self.alone = len(lengths) == 1

    def shifted(self, x: Array, lag: int) -> Array:
        """x(t - lag) within the records; the nearest sample of the record beyond its ends."""
        here = np.arange(len(x), dtype=np.int32)
        here -= np.clip(np.int32(lag), -self.after, self.place)
        return x[here]

    def follows(self, events: Mask, length: int) -> Mask:
        """Return whether one of the samples t, t - 1 ... t - length + 1 of the record is an
        event."""
        here = np.arange(len(events), dtype=np.int32)
        last = np.maximum.accumulate(np.where(events, here, np.int32(-1)))
        since = here - last
        return (last >= 0) & (since < length) & (since <= self.place)

    def segments(self, chosen: Mask, length: int) -> int:
        """Count the segments of `length` samples that the chosen samples fall into, at least 1: as
        many of them count as independent where the residual has a memory of `length` samples."""
        if self.alone:
            begins = self.place // length
        else:
            begins = np.cumsum(self.place == 0) * len(self.place) + self.place // length
        return max(1, len(np.unique(begins[chosen])))

    def memory(self, x: Array, least: float) -> int:
        """Samples until the autocorrelation of x falls below `least`, 1 .. 200."""
        centred = x - x.mean()
        power = float((centred**2).mean())
        for lag in range(1, _LONGEST_MEMORY):
            if self.alone:
                if power <= 0 or len(x) - lag < _FEWEST_SAMPLES:
                    return lag
                if float((centred[lag:] * centred[:-lag]).mean()) < least * power:
                    return lag
                continue
            late = self.place >= lag
            if power <= 0 or late.sum() < _FEWEST_SAMPLES:
                return lag
            early = centred[np.flatnonzero(late) - lag]
            if float((centred[late] * early).mean()) < least * power:
                return lag
        return _LONGEST_MEMORY


_Part = tuple[PartKind, int, int, float | None, float | None, Mask]


def _parts(records: _Records, output: int, ranges: Ranges) -> Iterator[_Part]:
    begun, simulated = records.begun, records.y_hat[:, output]
    for part, low, high, chosen in _cut(simulated, ranges.outputs[output]):
        yield PartKind.OUTPUT, output, part, low, high, chosen & begun
    for i, edges in enumerate(ranges.inputs):
        for part, low, high, chosen in _cut(records.u[:, i], edges):
            yield PartKind.INPUT, i, part, low, high, chosen & begun
    time = records.memory(simulated, 0.5)
    change = simulated - records.shifted(simulated, 1)
    fast = 0.5 * np.sqrt((change**2).mean())
    near = max(1, time // 2)
    before, after = (simulated - records.shifted(simulated, lag) for lag in (near, -near))
    least = _TURN * records.scale[output]
    for part, way in enumerate((-1.0, 1.0)):
        yield PartKind.CHANGE, output, part, None, None, (way * change > fast) & begun
        turns = (way * before > least) & (way * after > least)
        yield PartKind.TURN, output, part, None, None, records.follows(turns, near) & begun
    for i in range(records.u.shape[1]):
        u = records.u[:, i]
        change = u - records.shifted(u, 1)
        # An input that moves all the time has no steps.
        large = np.abs(change) > _STEP * max(float(np.ptp(u)), 1e-300)
        large &= large.mean() <= _MOST_STEPS
        for part, steps in enumerate((large & (change < 0), large & (change > 0))):
            yield PartKind.STEP, i, part, None, None, records.follows(steps, time) & begun
    yield PartKind.START, output, 0, None, None, ~begun
    yield PartKind.ALL, output, 0, None, None, np.ones(len(records.place), dtype=np.bool_)
    for part in range(len(_TIME_PARTS)):
        yield PartKind.TIME, output, part, None, None, records.third == part


def _cut(
    x: Array, edges: Sequence[float]
) -> Iterator[tuple[int, float | None, float | None, Mask]]:
    part_of = np.searchsorted(np.asarray(edges), x, side="right")
    for part, (low, high) in enumerate(zip((None, *edges), (*edges, None), strict=True)):
        yield part, low, high, part_of == part


def _edges(x: Array) -> tuple[tuple[float, ...], ...]:
    """Inner edges of parts of equal width, rounded to two digits of that width. A range is that of
    all but the outermost hundredths."""
    low, high = np.quantile(x, 0.01, axis=0), np.quantile(x, 0.99, axis=0)
    found: list[tuple[float, ...]] = []
    for first, last in zip(low.tolist(), high.tolist(), strict=True):
        width = (last - first) / BINS
        if width <= 0:
            found.append(())
            continue
        digits = 1 - int(np.floor(np.log10(width)))
        found.append(tuple(round(first + k * width, digits) for k in range(1, BINS)))
    return tuple(found)
