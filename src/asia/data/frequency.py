"""Frequency content of records: periods, best linear approximation, noise and distortion. And
measured frequency responses."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asia.data.trajectory import Array, Signal, Trajectory, is_constant
from asia.errors import UserError

ComplexArray: TypeAlias = NDArray[np.complex128]

# Measured frequency responses.

_LEAST_FREQUENCIES = 8


@dataclass(frozen=True, eq=False)
class FrequencyRecord:
    """Measured frequency response."""

    name: str
    frequency: Array
    """(F,) in Hz, rising."""
    response: ComplexArray
    """(F, ny, nu)."""
    variance: Array | None
    """Variance (F, ny, nu) of the response, of its real and imaginary part together; None where it
    is not known."""
    sampling_time: float
    """In s; 0 for a response in continuous time."""
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]

    def of_channels(
        self, inputs: Sequence[Signal], outputs: Sequence[Signal], sampling_time: float
    ) -> FrequencyRecord:
        """Return the response with the channels of a problem, up to half its sampling frequency.

        The names decide; where none of them is known, the order does.

        Raises:
            UserError: for other channels, another sampling time, and fewer than 8 frequencies.
        """
        places: list[list[int]] = []
        sides = ("outputs", self.outputs, outputs), ("inputs", self.inputs, inputs)
        for what, own, wanted in sides:
            names, expected = [s.name for s in own], [s.name for s in wanted]
            unknown = not set(names) & set(expected)
            if len(names) != len(expected) or (set(names) != set(expected) and not unknown):
                raise UserError(
                    f"frequency response {self.name} has the {what} {', '.join(names)}, expected "
                    f"{', '.join(expected)}"
                )
            places.append(list(range(len(own))) if unknown else [names.index(n) for n in expected])
        own_time = self.sampling_time
        if own_time and abs(own_time - sampling_time) > 1e-6 * sampling_time:
            raise UserError(
                f"frequency response {self.name} is sampled every {own_time:g} s, the records "
                f"every {sampling_time:g} s: give the response in continuous time, or resample the "
                "records"
            )
        seen = self.frequency <= 0.5 / sampling_time * (1.0 + 1e-9)
        if seen.sum() < _LEAST_FREQUENCIES:
            raise UserError(
                f"frequency response {self.name} has {int(seen.sum())} frequencies up to half the "
                f"sampling frequency of the records, {0.5 / sampling_time:g} Hz: expected at least "
                f"{_LEAST_FREQUENCIES}"
            )
        rows, columns = (np.array(one) for one in places)
        chosen = np.flatnonzero(seen)[:, None, None], rows[:, None], columns
        return replace(
            self, frequency=self.frequency[seen], response=self.response[chosen],
            variance=None if self.variance is None else self.variance[chosen],
            inputs=tuple(inputs), outputs=tuple(outputs),
        )  # fmt: skip

    @property
    def digest(self) -> str:
        """Hex sha256 over sampling time, frequencies, response and variance."""
        digest = hashlib.sha256(repr((self.sampling_time, self.response.shape)).encode())
        parts = (self.frequency, self.response, self.variance)
        for values in (one for one in parts if one is not None):
            digest.update(np.ascontiguousarray(values).data)
        return digest.hexdigest()


# Periods of the inputs.


# A period is where the input is alike again, after it was not alike in between.
_ALIKE, _UNLIKE = 0.98, 0.5


def find_period(records: Sequence[Trajectory]) -> int | None:
    """Samples of the period that all inputs of all records have, each at least twice in every
    record; None where there is none."""
    return common_period([r.u for r in records])


def common_period(inputs: Sequence[Array]) -> int | None:
    """The same of inputs (T, nu), one array a record."""
    found = {_period(u) for u in inputs}
    return found.pop() if len(found) == 1 else None


def _period(u: Array) -> int | None:
    likeness = _likeness(u)
    unlike = np.flatnonzero(likeness < _UNLIKE)
    if not len(unlike):
        return None
    first = max(int(unlike[0]), 16)
    alike = np.flatnonzero(likeness[first:] >= _ALIKE)
    if not len(alike):
        return None
    start = first + int(alike[0])
    # The best of the lags around it, up to where the input is unlike itself again.
    after = unlike[unlike > start]
    stop = int(after[0]) if len(after) else len(likeness)
    return start + int(np.argmax(likeness[start:stop]))


def _likeness(u: Array) -> Array:
    """1 minus half the mean squared change over each lag from 0 to half the record, in variances:
    1 where the input is the same again, the least over the inputs that move."""
    length, lags = len(u), len(u) // 2 + 1
    size = 2 ** int(np.ceil(np.log2(2 * max(length, 1))))
    rows = [np.ones(lags)]
    for values in u.T:
        if is_constant(values):
            continue
        v = values - values.mean()
        variance = float(v @ v) / length
        product = np.fft.irfft(abs(np.fft.rfft(v, size)) ** 2, size)[:lags]
        squares = np.concatenate([[0.0], np.cumsum(v**2)])
        count = length - np.arange(lags)
        both = squares[count] + squares[length] - squares[length - count]
        rows.append(1.0 - (both - 2.0 * product) / (2.0 * count * variance))
    return np.min(rows, axis=0) if len(rows) > 1 else np.zeros(lags)


# Best linear approximation, noise and distortion of an output, from periods or without.


Spectrum = NDArray[np.complex128]

# Degree of the local polynomials.
_DEGREE = 2


@dataclass(frozen=True)
class Levels:
    """Parts of one output, as standard deviations over that of the output."""

    noise: float | None
    """Variation between periods; None where that is not known."""
    odd: float | None
    """Odd-degree distortion; None where it cannot be separated."""
    even: float | None
    """Even-degree distortion; None where it cannot be separated."""
    distortion: float | None
    """Distortion of any degree; None where it cannot be separated from noise."""
    both: float
    """Noise and distortion together: the residual of the best linear model."""


@dataclass(frozen=True)
class FrequencyResponse:
    """Frequency response and noise levels of one output; amplitudes are those of lines of the
    record."""

    frequency: Array
    """(F,) in Hz."""
    gain: Spectrum
    """Best linear approximation (F, nu), NaN at lines that are not excited."""
    output: Array
    """Amplitude of the output (F,)."""
    rest: Array
    """Amplitude (F,) of the residual of the best linear model, NaN where it is not known."""
    noise: Array
    """Amplitude (F,) of the noise, NaN where it is not known."""
    levels: Levels
    """Levels over all frequencies."""
    periods: int
    """Periods of a record that were used; 0 where there is no period."""
    period: int | None
    """Period in samples."""


def frequency_response(
    records: Sequence[Trajectory], output: int, period: int | None
) -> FrequencyResponse | None:
    """Estimate the frequency response of one output.

    Whole periods are used where there is a period, else local polynomials, which take leakage into
    account. Lines that the input leaves out separate odd from even distortion; at excited lines,
    records with other realisations of the input do.

    Returns:
        the response, or None where the records are too short or the output is constant
    """
    if np.concatenate([r.y[:, output] for r in records]).std() <= 0:
        return None
    if period is not None and min(len(r) for r in records) >= 2 * period:
        return _of_periods(records, output, period)
    return _of_records(records, output)


def _of_periods(records: Sequence[Trajectory], output: int, period: int) -> FrequencyResponse:
    y = [_whole_periods(r.y[:, output : output + 1], period)[..., 0] for r in records]
    # The first periods are left out where they are further from the last than twice what the last
    # two are from each other.
    settled: list[int] = []
    for v in y:
        apart = [float(((one - v[-1]) ** 2).mean()) for one in v[:-1]]
        kept = 0
        while kept < len(apart) - 1 and apart[kept] > 2.0 * apart[-1]:
            kept += 1
        settled.append(len(v) - kept)
    count = min(settled)
    y = [v[-count:] for v in y]
    u = [_whole_periods(r.u, period)[-count:] for r in records]
    # Amplitudes such that their squares sum to the variance, the mean apart.
    lines = slice(1, period // 2 + (period % 2))
    scale = np.sqrt(2.0) / period
    y_lines = np.array([scale * np.fft.rfft(v.mean(axis=0))[lines] for v in y])
    u_lines = np.array([scale * np.fft.rfft(v.mean(axis=0), axis=0)[lines] for v in u])
    rests = np.array([v - v.mean(axis=0) for v in y])
    noise_power = (abs(scale * np.fft.rfft(rests, axis=-1)[..., lines]) ** 2).sum(axis=1) / (
        count - 1
    )
    floor = noise_power.mean(axis=0)
    size = abs(u_lines).max(axis=(0, 2))
    # Input lines far below the largest one are not excited.
    excited = size > 1e-3 * size.max()
    gain, left, known = _approximated(u_lines, y_lines, excited, floor / count)
    variance = float(np.mean([v.mean(axis=0).var() for v in y])) + float(floor.sum())
    levels = _levels(left, known, excited, floor, variance)
    power = (abs(y_lines) ** 2).mean(axis=0)
    rest = np.where(known, left + floor, np.nan)
    return FrequencyResponse(
        frequency=np.arange(lines.start, lines.stop) / (period * records[0].sampling_time),
        gain=gain,
        output=np.sqrt(power),
        rest=np.sqrt(rest),
        noise=np.sqrt(floor),
        levels=levels,
        periods=count,
        period=period,
    )


def _whole_periods(values: Array, period: int) -> Array:
    """(periods, N, n): the whole periods at the end of a record."""
    periods = len(values) // period
    return values[len(values) - periods * period :].reshape(periods, period, -1)


def _approximated(
    u: Spectrum, y: Spectrum, excited: NDArray[np.bool_], floor: Array
) -> tuple[Spectrum, Array, NDArray[np.bool_]]:
    """Fit the gain at excited lines.

    Args:
        u, y: spectra of the inputs (M, F, nu) and outputs (M, F)
        floor: power (F,) of the noise in the outputs

    Returns:
        gain (F, nu), power (F,) of the residual without the noise, and where it is known
    """
    count, lines, nu = u.shape
    gain = np.full((lines, nu), np.nan, complex)
    left = (abs(y) ** 2).mean(axis=0)
    known = ~excited
    for k in np.flatnonzero(excited):
        found: Any = np.linalg.lstsq(u[:, k], y[:, k], rcond=1e-6)
        if count < nu or found[2] < nu:
            continue
        gain[k] = found[0]
        if count > nu:
            left[k] = (abs(y[:, k] - u[:, k] @ found[0]) ** 2).sum() / (count - nu)
            known[k] = True
    left = np.where(known, left - floor, np.nan)
    return gain, left, known


def _levels(
    left: Array, known: NDArray[np.bool_], excited: NDArray[np.bool_], floor: Array, variance: float
) -> Levels:
    """Compute the levels from powers (F,) by line; the first line is the first harmonic."""
    number = np.arange(1, len(left) + 1)
    odd, inside = number % 2 == 1, number <= number[excited].max()
    noise = float(floor.sum())

    def power(lines: NDArray[np.bool_]) -> float | None:
        """Return the power over some lines; unknown lines count as the mean of the known ones."""
        missing = lines & ~known
        total = float(left[lines & known].sum())
        if missing.any():
            like = lines & known & inside
            if like.sum() < 2:
                return None
            total += float(missing.sum()) * float(left[like].mean())
        return max(total, 0.0)

    separate = not excited[~odd].any()
    parts = [power(odd), power(~odd)] if separate else [None, None]
    whole = power(np.ones(len(left), bool))
    if parts[0] is not None and parts[1] is not None:
        whole = parts[0] + parts[1]
    relative = [None if p is None else float(np.sqrt(p / variance)) for p in (*parts, whole)]
    rest = float(np.sqrt((noise + (whole or 0.0)) / variance))
    return Levels(float(np.sqrt(noise / variance)), relative[0], relative[1], relative[2], rest)


def _of_records(records: Sequence[Trajectory], output: int) -> FrequencyResponse | None:
    """Local polynomial method: near a frequency, response and leakage are smooth polynomials. Of a
    system whose time constants are near the length of the records it leaves too much."""
    nu = records[0].u.shape[1]
    longest = min(max(len(r) for r in records), 65_536)
    # Records much shorter than the others tell nothing of their frequencies.
    length = min([len(r) for r in records if 2 * len(r) >= longest] + [longest])
    segments = [r for r in records if len(r) >= length][:20]
    terms = (_DEGREE + 1) * (nu + 1)
    reach = terms // 2 + 3
    if length < 8 * reach:
        return None
    scale, lines = np.sqrt(2.0) / length, slice(1, (length + 1) // 2)
    gains: list[Spectrum] = []
    powers: list[Array] = []
    rests: list[Array] = []
    for r in segments:
        u = scale * np.fft.rfft(r.u[:length] - r.u[:length].mean(axis=0), axis=0)[lines]
        y = scale * np.fft.rfft(r.y[:length, output] - r.y[:length, output].mean())[lines]
        gain, rest = _local_fit(u, y, reach)
        gains.append(gain)
        powers.append(abs(y) ** 2)
        rests.append(rest)
    power, rest = np.mean(powers, axis=0), np.mean(rests, axis=0)
    both = float(np.sqrt(rest.sum() / max(float(power.sum()), 1e-300)))
    return FrequencyResponse(
        frequency=np.arange(1, lines.stop) / (length * records[0].sampling_time),
        gain=np.mean(gains, axis=0),
        output=np.sqrt(power),
        rest=np.sqrt(rest),
        noise=np.full(len(power), np.nan),
        levels=Levels(None, None, None, None, min(both, 1.0)),
        periods=0,
        period=None,
    )


def _local_fit(u: Spectrum, y: Spectrum, reach: int) -> tuple[Spectrum, Array]:
    """Lines of inputs (F, nu) and of an output (F,) -> gain (F, nu), and the power (F,) that a
    polynomial response with leakage leaves at `reach` lines to either side."""
    count, nu = u.shape
    gain, rest = np.empty((count, nu), complex), np.empty(count)
    width = 2 * reach + 1
    # So many lines at a time, to save memory.
    size_of_block = 4096
    for first in range(0, count, size_of_block):
        middle = np.arange(first, min(first + size_of_block, count))
        start = np.clip(middle - reach, 0, count - width)
        rows = start[:, None] + np.arange(width)
        place = (rows - middle[:, None]) / reach
        powers = place[..., None] ** np.arange(_DEGREE + 1)
        signals = np.concatenate([u[rows], np.ones((*rows.shape, 1), complex)], axis=-1)
        # Inputs of very different size, and lines without any, keep the fit well posed.
        size = np.sqrt((abs(signals) ** 2).mean(axis=1, keepdims=True))
        signals = signals / np.where(size > 0, size, 1.0)
        terms = signals[..., :, None] * powers[..., None, :]
        terms = terms.reshape(*rows.shape, -1)
        q, r = np.linalg.qr(terms)
        target = y[rows][..., None]
        found = np.swapaxes(q.conj(), -1, -2) @ target
        left = target - q @ found
        freedom = width - terms.shape[-1]
        rest[middle] = (abs(left[..., 0]) ** 2).sum(axis=1) / freedom
        tiny = 1e-12 * abs(np.diagonal(r, axis1=-2, axis2=-1)).max(axis=1)
        theta = np.linalg.solve(r + tiny[:, None, None] * np.eye(r.shape[-1]), found)[..., 0]
        theta = theta.reshape(len(middle), nu + 1, _DEGREE + 1)[:, :nu, 0]
        gain[middle] = theta / np.where(size[:, 0, :nu] > 0, size[:, 0, :nu], 1.0)
    return gain, rest
