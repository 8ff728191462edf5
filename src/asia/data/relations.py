"""Relations between signals in records: transport, integrals, copies."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from asia.data.trajectory import Array, Trajectory, is_constant

# Test samples that duplicate training samples or lie outside the training input range.


_RUN = 10


def shared_samples(test: Sequence[Trajectory], train: Sequence[Trajectory]) -> int:
    """Samples of the test records inside runs of ten that also occur in a training record."""
    own = [_run_hashes(record) for record in test]
    # Test records are the shorter ones: every training record is looked up in them, one by one.
    wanted = (
        np.sort(np.concatenate([hashes for hashes, _ in own])) if own else np.zeros(0, np.uint64)
    )
    if wanted.size == 0:
        return 0
    copied = np.zeros(0, np.uint64)
    for record in train:
        hashes = _run_hashes(record)[0]
        copied = np.concatenate([copied, hashes[_is_in(hashes, wanted)]])
    copied = np.sort(copied)
    count = 0
    for record, (hashes, moves) in zip(test, own, strict=True):
        inside = np.zeros(len(record), dtype=bool)
        for start in np.flatnonzero(_is_in(hashes, copied) & moves):
            inside[start : start + _RUN] = True
        count += int(inside.sum())
    return count


def samples_outside(test: Sequence[Trajectory], train: Sequence[Trajectory]) -> tuple[int, ...]:
    """Count the test samples of each input that exceed the training range by more than a hundredth
    of it."""
    u = [record.u for record in train]
    low = np.min([values.min(axis=0) for values in u], axis=0)
    high = np.max([values.max(axis=0) for values in u], axis=0)
    edge = 0.01 * (high - low)
    outside = [((r.u < low - edge) | (r.u > high + edge)).sum(axis=0) for r in test]
    return tuple(int(count) for count in np.sum(outside, axis=0))


def _is_in(values: NDArray[np.uint64], ordered: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Return which values occur in the sorted array `ordered`."""
    if ordered.size == 0:
        return np.zeros(values.shape, dtype=bool)
    places = np.searchsorted(ordered, values)
    places[places == ordered.size] = 0
    return ordered[places] == values


def _run_hashes(record: Trajectory) -> tuple[NDArray[np.uint64], NDArray[np.bool_]]:
    """A hash of each run of ten rows, and whether anything moves in it: two records at rest look
    the same without being copies."""
    rows = np.concatenate([record.u, record.y], axis=1)
    bits = rows.view(np.uint64)
    if len(rows) < _RUN:
        return np.zeros(0, np.uint64), np.zeros(0, np.bool_)
    odd = np.random.default_rng(0).integers(1, 2**63, size=(bits.shape[1] + 1,), dtype=np.uint64)
    odd |= np.uint64(1)
    row = ((bits ^ (bits >> np.uint64(32))) * odd[:-1]).sum(axis=1, dtype=np.uint64)
    row ^= row >> np.uint64(29)
    count = len(rows) - _RUN + 1
    hashes = np.zeros(count, np.uint64)
    changes = np.zeros(count, np.int64)
    step = np.any(rows[1:] != rows[:-1], axis=1)
    for k in range(_RUN):
        hashes = hashes * odd[-1] + row[k : k + count]
        if k < _RUN - 1:
            changes += step[k : k + count]
    return hashes, changes > 0


# Relation between the increments of outputs and the integrals of others.


# A rate integrates to its output but for noise, delay and a gain near one.
LEAST_CORRELATION = 0.6
LARGEST_GAIN = 1.5


@dataclass(frozen=True)
class Motion:
    """Correlation and least-squares gain (ny, ny) of each output's increment (rows) on the
    integral of each output (columns)."""

    correlation: Array
    gain: Array


def motion(records: Sequence[Trajectory], span: int) -> Motion:
    """Compare increments with integrals over `span` samples in all records.

    Integrals use Euler steps: the rate at a sample moves the output of the next sample.
    """
    moves: list[Array] = []
    sums: list[Array] = []
    for t in records:
        total = np.cumsum(t.y * t.sampling_time, axis=0)
        sums.append(total[span - 1 : -1] - np.pad(total, ((1, 0), (0, 0)))[: len(t) - span])
        moves.append(t.y[span:] - t.y[:-span])
    moved, integrals = np.concatenate(moves), np.concatenate(sums)
    energy = np.maximum((moved**2).sum(axis=0), 1e-300)
    effect = np.maximum((integrals**2).sum(axis=0), 1e-300)
    products = moved.T @ integrals
    return Motion(products / np.sqrt(energy[:, None] * effect), products / effect)


# Transport delays through a pipe or along a belt whose pace is an input.
#
# A signal that leaves at a time entered when the integral of the pace was smaller by the volume of
# the pipe: integral of the pace from entry to now = volume (plug flow). A slow pace means a long
# delay.


# The longest delay that is looked for, in samples at the mean pace.
_LONGEST = 30


@dataclass(frozen=True)
class Transport:
    """A pipe whose pace is an input."""

    pace: int
    """Number of that input, whose values are positive."""
    volume: float
    """Volume of the pipe: unit of the input times samples."""
    slowest: float = 0.0
    """Lower limit of the pace in a simulation, so that nothing stays in the pipe for longer than
    `longest` samples."""

    @property
    def least_pace(self) -> float:
        """Lower limit of the pace, above 0 so that the transport never stops."""
        return max(self.slowest, 1e-4 * self.volume)

    @property
    def longest(self) -> int:
        """Samples after which all has left the pipe, at every pace."""
        return int(np.ceil(self.volume / self.least_pace))

    def carried(self, u: Array) -> Array:
        """Inputs u (T, nu), physical units, held between samples and backwards before the first ->
        (T, nu + 1): the inputs as they leave the pipe, means over each sample, and the pace."""
        pace = np.maximum(u[:, self.pace], self.least_pace)
        before = int(np.ceil(self.volume / pace[0])) + 1
        held = np.concatenate([np.repeat(u[:1], before, axis=0), u])
        passed = _sums(np.concatenate([np.repeat(pace[:1], before), pace])[:, None])[:, 0]
        time = np.arange(len(passed), dtype=float)
        entry = np.interp(passed[before:] - self.volume, passed, time)
        sums = _sums(held)
        amounts = np.stack([np.interp(entry, time, s) for s in sums.T], axis=1)
        leaving = np.diff(amounts, axis=0) / np.diff(entry)[:, None]
        return np.hstack([leaving, u[:, self.pace, None]])


def find_transport(records: Sequence[Trajectory], pace: int) -> Transport:
    """Volume of the pipe by the error of a one-step model with products of its signals. Raises
    ValueError where the input takes values that are not positive."""
    least = min(float(r.u[:, pace].min()) for r in records)
    if least <= 0.0:
        raise ValueError(f"input {pace} cannot be a pace: it has values that are not positive")
    mean = float(np.concatenate([r.u[:, pace] for r in records]).mean())
    delays = np.geomspace(1.0, float(_LONGEST), 31)
    # The first samples of each record that is longer than the longest delay.
    most = max(4000 // len(records), 4 * _LONGEST)
    parts = [
        Trajectory(r.u[:most], r.y[:most], r.sampling_time, r.name)
        for r in records
        if len(r) > 2 * _LONGEST
    ]
    errors = [
        _one_step_error([Transport(pace, mean * d).carried(r.u) for r in parts], parts)
        for d in delays
    ]
    return Transport(pace, mean * float(delays[int(np.argmin(errors))]), 0.5 * least)


def _sums(values: Array) -> Array:
    """Return the cumulative sums (T + 1, c) of (T, c): the amount before each sample."""
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])


def _one_step_error(inputs: Sequence[Array], records: Sequence[Trajectory]) -> float:
    """Mean squared error, in variances of the outputs, of a model quadratic in lagged signals;
    infinite with too few samples for it."""
    if not records:
        return float("inf")
    # Outputs, the two outputs before, and the inputs now and before, from where every delay is
    # known.
    first = _LONGEST
    lagged: list[Array] = []
    for v, r in zip(inputs, records, strict=True):
        before = [r.y[first - k : len(r) - k] for k in range(3)]
        lagged.append(np.hstack([*before, v[first:], v[first - 1 : len(r) - 1]]))
    rows = np.concatenate(lagged)
    ny = records[0].y.shape[1]
    spread = rows.std(axis=0)
    rows = (rows - rows.mean(axis=0)) / np.where(spread > 0.0, spread, 1.0)
    y, x = rows[:, :ny], rows[:, ny:]
    columns = x.shape[1] * (x.shape[1] + 3) // 2 + 1
    if columns > 0.2 * len(x):
        return float("inf")
    products = [x[:, i] * x[:, j] for i, j in combinations_with_replacement(range(x.shape[1]), 2)]
    terms = np.column_stack([np.ones(len(x)), x, *products])
    gram = terms.T @ terms + 1e-9 * len(x) * np.eye(columns)
    left = y - terms @ np.linalg.solve(gram, terms.T @ y)
    return float((left**2).mean())


# Segments of the inputs that occur again elsewhere, mirrored or scaled too.

Parts = Sequence[tuple[int, range]]
"""Number of a record, and samples in it."""

# Least correlation of a segment with its copy, the share of its variance in which a copy differs at
# least (an exact copy proves no more), and the probability of a false alarm.
_COPIED, _APART, _CHANCE = 0.98, 0.01, 1e-6
_MOST_SEGMENTS, _MOST_PRODUCTS = 48, 4_000_000


@dataclass(frozen=True)
class Repetition:
    """Held-out segment of the inputs that also occurs in training samples of its fold."""

    fold: int
    """Number of the fold, 0-based."""
    record: int
    start: int
    """First sample of the segment in its record, 0-based."""
    other: int
    """Number of the record with the copy."""
    other_start: int
    length: int
    gain: float
    """Segment over copy, of the first input that moves."""


def find_repetition(
    inputs: Sequence[Array], folds: Sequence[tuple[Parts, Parts]]
) -> Repetition | None:
    """Find a held-out segment of the inputs that the training samples of its fold repeat.

    Segments are tested that are rich enough not to be alike by chance, evenly spread over the
    held-out samples. Of several repetitions one with the most frequent shift is returned.

    Args:
        inputs: (T, nu), one array a record.
        folds: held-out and training parts of each fold.
    """
    whole = np.concatenate(inputs)
    moving = [not is_constant(v) for v in whole.T]
    z = whole[:, moving]
    if not z.shape[1] or not folds:
        return None
    z = (z - z.mean(axis=0)) / z.std(axis=0)
    # Few levels agree exactly by chance.
    apart = np.array([max(_APART, len(np.unique(v)) ** -2.0) for v in z.T])
    samples = len(z)
    first = np.cumsum([0, *map(len, inputs)])
    number = np.repeat(np.arange(len(inputs)), np.diff(first))
    size = 1 << (2 * samples - 1).bit_length()
    spectrum = np.fft.rfft(z, size, axis=0)
    zero = np.zeros((1, z.shape[1]))
    sums, squares = (np.concatenate([zero, np.cumsum(v, axis=0)]) for v in (z, z**2))
    most = int(np.clip(_MOST_PRODUCTS // z.size, len(folds), _MOST_SEGMENTS))
    found: list[Repetition] = []
    for k, (held_out, train) in enumerate(folds):
        trains = np.zeros(samples + 1, int)
        for record, part in train:
            trains[first[record] + part.start + 1 : first[record] + part.stop + 1] = 1
        trains = np.cumsum(trains)
        # Places in all held-out samples of the fold.
        edges = [(int(first[i]) + p.start, int(first[i]) + p.stop) for i, p in held_out if p]
        places = np.concatenate([np.zeros(0, int), *(np.arange(*edge) for edge in edges)])
        evenly = np.linspace(0, len(places) - 1, max(most // len(folds), 1)).astype(int)
        for place in np.unique(places[evenly]) if len(places) else ():
            low, high = next(edge for edge in edges if edge[0] <= place < edge[1])
            for length in (64, 128, 256, 512, 1024):
                # A segment that would end beyond the held-out part begins earlier.
                begin = min(int(place), high - length)
                if begin < low:
                    break
                x = z[begin : begin + length] - z[begin : begin + length].mean(axis=0)
                # Frequencies that hold the power, and samples that hold the changes.
                power = np.abs(np.fft.rfft(x, axis=0)) ** 2
                both = (2.0, power), (1.0, np.diff(x, axis=0) ** 2)
                freedom = np.min([
                    c * p.sum(axis=0) ** 2 / np.maximum((p**2).sum(axis=0), 1e-300) for c, p in both
                ], axis=0)  # fmt: skip
                exponent = freedom / 2.0 - 1.0
                richest = int(np.argmin(apart**exponent))
                if apart[richest] ** exponent[richest] * samples * most > _CHANCE:
                    continue
                count = samples - length + 1
                product = np.fft.irfft(
                    spectrum * np.fft.rfft(x, size, axis=0).conj(), size, axis=0
                )[:count]
                mean = (sums[length:] - sums[:-length]) / length
                variance = (squares[length:] - squares[:-length]) / length - mean**2
                own = (x**2).mean(axis=0)
                still = variance < 1e-9
                scale = np.sqrt(np.where(still, 1.0, variance) * np.where(own < 1e-9, 1.0, own))
                alike = np.where(still | (own < 1e-9), 0.0, np.abs(product) / length / scale)
                alike[still & (own < 1e-9)] = 1.0
                alike = alike.min(axis=1)
                usable = trains[length:] - trains[:-length] == length
                usable &= number[:count] == number[length - 1 :]
                alike[~usable] = 0.0
                at = int(np.argmax(alike))
                rest = max(1.0 - float(alike[at]) ** 2, float(apart[richest]))
                chance = rest ** float(exponent[richest]) * samples * most
                if alike[at] > _COPIED and chance < _CHANCE:
                    channel = int(np.argmax(own))
                    gain = float(own[channel] * length / product[at, channel])
                    i, j = int(number[begin]), int(number[at])
                    start, other = begin - int(first[i]), at - int(first[j])
                    found.append(Repetition(k, i, start, j, other, length, gain))
                break
    if not found:
        return None
    shifts = [(r.record == r.other, abs(r.start - r.other_start)) for r in found]
    return found[max(range(len(found)), key=lambda n: shifts.count(shifts[n]))]
