"""Checks of the model's response: gain, frequency response, long runs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asia._statement import fit_note
from asia.data.trajectory import Array
from asia.judge.scoring.checks.check import ALARM_RATE, Cause, Check, CheckCurve, Verdict
from asia.judge.scoring.checks.residual import groups
from asia.judge.scoring.checks.validation_data import (
    LinearResponse,
    ValidationData,
    listed,
    percent,
)

# Check of the sign of the gain from each input.


# An input's part of the output, over the output's deviation, below which its sign cannot fail.
_LEAST_PART = 0.15
# Parts of the records that are left out in turn.
_PARTS = 10


def check_gain(data: ValidationData) -> Check:
    """The sign of the gain from each input to each output, in the data and in the simulation, where
    the data have an interval of it that excludes zero."""
    found, title = data.simulations, "direction of gain"
    agree, untested, opposite = list[str](), list[str](), list[str]()
    pairs = len(found.inputs) * len(found.outputs)
    for output, label in enumerate(found.outputs):
        columns = groups(found, output)
        x = np.concatenate(columns.inputs)
        measured, simulated = (
            _gains(x, np.concatenate(y), len(found.inputs), pairs)
            for y in (
                [b.complete_y[columns.reach :, output] for b in found.blocks],
                [b.y_hat[columns.reach :, output] for b in found.blocks],
            )
        )
        for number, name in enumerate(found.inputs):
            own, of_model = measured[number], simulated[number]
            words = f"{name} to {label} {own.low:.3g} to {own.high:.3g}"
            signs = own.sign * of_model.sign
            if own.sign * of_model.value > 0:
                agree.append(words)
            elif signs < 0 and min(own.part, of_model.part) >= _LEAST_PART:
                opposite.append(f"{words}, in the model {of_model.value:.3g}")
            else:
                untested.append(words)
    if opposite:
        sentence = f"the gain has the opposite sign of the data ({opposite[0]}): {Cause.SIGN}"
        return Check(title, Verdict.FAIL, sentence, Cause.SIGN, 2.0)
    known = f"the gain has the sign of the data ({'; '.join(agree)})" if agree else ""
    if not untested:
        return Check(title, Verdict.PASS, known)
    rest = f"not tested: the records do not determine the sign of the gain ({'; '.join(untested)})"
    return Check(title, Verdict.SHOWN, "; ".join(filter(None, (rest, known))))


@dataclass(frozen=True)
class _Gain:
    """Gain of one input within the lags of the columns, with its interval."""

    value: float
    low: float
    high: float
    part: float
    """Deviation of the input's part of the output over that of the output."""

    @property
    def sign(self) -> float:
        """Sign of the gain; 0 where the interval contains zero."""
        return float(np.sign(self.value)) if self.low * self.high > 0 else 0.0


def _gains(x: Array, y: Array, inputs: int, pairs: int) -> list[_Gain]:
    """Gains from each input, its columns every `inputs`-th, with intervals by the delete-a-group
    jackknife over contiguous parts, so that dependent errors widen them."""
    from scipy.special import stdtrit

    mean, size = x.mean(axis=0), x.std(axis=0)
    size[size == 0.0] = 1.0
    z, e = (x - mean) / size, y - y.mean()
    parts = np.array_split(np.arange(len(z)), _PARTS)
    grams, products = [z[p].T @ z[p] for p in parts], [z[p].T @ e[p] for p in parts]
    ridge = 1e-4 * len(z) * np.eye(z.shape[1])
    gram, product = sum(grams) + ridge, sum(products)
    whole = np.linalg.solve(gram, product) / size
    without = [
        np.linalg.solve(gram - one, product - two) / size
        for one, two in zip(grams, products, strict=True)
    ]
    factor = float(stdtrit(_PARTS - 1, 1.0 - ALARM_RATE / (2 * pairs)))
    found: list[_Gain] = []
    for number in range(inputs):
        own = slice(number, None, inputs)
        value = float(whole[own].sum())
        apart = np.array([one[own].sum() for one in without]) - value
        wide = factor * float(np.sqrt((_PARTS - 1) / _PARTS * (apart @ apart)))
        part = float(((x[:, own] - mean[own]) @ whole[own]).std() / max(float(y.std()), 1e-300))
        found.append(_Gain(value, value - wide, value + wide, part))
    return found


# The model as a linear one around operating points, from small steps of a simulator that may be
# anything.

SMALL = 1e-3
# With more outputs than these the sentence would be a table.
_MOST_GAINS = 3


def impulse_response(up: Array, down: Array, size: float) -> Array:
    """Estimate the impulse response.

    Args:
        up, down: simulations (n, ny) whose input is `size` above and below the operating point
            from the first sample on
    """
    step = (up - down) / (2.0 * size)
    return np.diff(step, axis=0, prepend=np.zeros((1, step.shape[1])))


def frequency_response_of(impulse: Array, omega: Array) -> NDArray[np.complex128]:
    """H(e^jw) (F, ny) of an impulse response (n, ny); omega (F,) in rad per sample."""
    angles = np.outer(omega, np.arange(len(impulse)))
    return np.asarray(np.exp(-1j * angles) @ impulse, np.complex128)


def check_responses(data: ValidationData) -> Check:
    """Static gains and step responses: shown."""
    name, axes = "static gain", ("time [s]", "change for a step of 1")
    outputs = data.simulations.outputs
    if not data.linear_responses:
        reason = "does not apply: the response of the model to small input steps is not finite"
        return Check(name, Verdict.ABSENT, reason)
    curves: list[CheckCurve] = []
    words: list[str] = []
    for one in data.linear_responses:
        times = np.arange(len(one.impulse), dtype=np.float64) * data.simulations.sampling_time
        for k, output in enumerate(outputs):
            curves.append(
                CheckCurve(f"{one.input} to {output}, {one.point}", times, one.step[:, k])
            )
        if not one.settled:
            words.append(
                f"{one.input} at {one.point}: no static gain, the response does not settle"
            )
            continue
        gains = [
            f"{value:.3g} on {output}"
            for value, output in zip(one.step[-1].tolist(), outputs, strict=True)
        ]
        if len(outputs) > _MOST_GAINS:
            gains = [f"of {len(outputs)} outputs in the curves"]
        words.append(f"{one.input} at {one.point}: static gain {listed(gains)}")
    words += filter(None, [fit_note(data.fit)])
    return Check(name, Verdict.SHOWN, "; ".join(words), curves=tuple(curves), axes=axes)


# The residual by frequency, and the model's frequency response against that of the data.

_LONGEST, _SHORTEST = 256, 16
_COHERENT = 0.8
# Below it the gain of the data is mostly noise, and is not drawn.
_DRAWN = 0.5
# Relative difference of the gains, and the part of the residual at the frequencies with as much, in
# standard deviations of the output, from which it counts: of a frequency at which the output has
# next to no power, the records say nothing that matters.
_DOUBTS, _FAILS = (0.25, 0.005), (0.5, 0.02)
_CHANCE = 1e-4
_TOO_SHORT = (
    "does not apply: the simulations are too short for a spectrum, which needs "
    f"{_SHORTEST} samples of eight windows or more, or {4 * _SHORTEST} of fewer"
)


@dataclass(frozen=True)
class Spectra:
    """Power of one input, an output and its residual by frequency, by Welch's method: each line's
    part of the variance."""

    frequency: Array
    """(F,) in Hz."""
    input: Array
    """(F,)."""
    output: Array
    """(F,)."""
    residual: Array
    """(F,)."""
    output_cross: NDArray[np.complex128]
    """Cross-spectrum of output and input (F,)."""
    residual_cross: NDArray[np.complex128]
    """Cross-spectrum of residual and input (F,)."""
    segments: int
    """Independent segments."""


def spectra(
    u: Sequence[Array], y: Sequence[Array], e: Sequence[Array], sampling_time: float
) -> Spectra | None:
    """Hann windows, half overlapping, none across two blocks; None where blocks are too short.

    The constant and the lines next to it are left out.

    Args:
        u, y, e: (H,) a block
    """
    shortest = min(len(x) for x in u)
    length = min(_LONGEST, shortest if len(u) > 7 else shortest // 4)
    if length < _SHORTEST:
        return None
    window = np.hanning(length + 1)[:-1]
    window *= np.sqrt(2.0 / (length * np.sum(window**2)))
    lines = [np.zeros((0, length // 2 + 1), np.complex128)] * 3
    for parts in zip(u, y, e, strict=True):
        starts = range(0, len(parts[0]) - length + 1, length // 2)
        for k, x in enumerate(parts):
            cut = np.stack([x[s : s + length] for s in starts])
            cut = cut - cut.mean(axis=1, keepdims=True)
            lines[k] = np.concatenate([lines[k], np.fft.rfft(cut * window)])
    a, b, c = (x[:, 2:-1] for x in lines)
    power = [np.mean(np.abs(x) ** 2, axis=0) for x in (a, b, c)]
    frequency = np.asarray(np.fft.rfftfreq(length, sampling_time)[2:-1], np.float64)
    count = max(2, len(a) * 9 // 16)
    cross = [np.mean(x * a.conj(), axis=0) for x in (b, c)]
    return Spectra(frequency, power[0], power[1], power[2], cross[0], cross[1], count)


def check_spectrum(data: ValidationData) -> Check:
    """Show the spectrum of the residual against the output and the noise; it is not judged."""
    found, noise = data.simulations, data.noise()
    curves: list[CheckCurve] = []
    words: list[str] = []
    for k, name in enumerate(found.outputs):
        y, e = [b.complete_y[:, k] for b in found.blocks], found.residuals(k)
        one = spectra(y, y, e, found.sampling_time)
        if one is None:
            continue
        curves += [
            CheckCurve(f"{name}, output", one.frequency, np.sqrt(one.output)),
            CheckCurve(f"{name}, residual", one.frequency, np.sqrt(one.residual)),
        ]
        above = one.frequency[one.residual > 0.5 * one.output]
        part = float(np.sqrt(one.residual.sum() / max(float(one.output.sum()), 1e-300)))
        floor = noise[k]
        line = f"{name}: RMS residual {percent(part)} of the RMS output"
        line += "" if floor is None else f", noise {percent(floor)}"
        if len(above):
            line += f"; from {above[0]:.3g} Hz its power is above half that of the output"
        words.append(line)
    if not words:
        return Check("error spectrum", Verdict.ABSENT, _TOO_SHORT)
    sentence = "; ".join(words)
    return Check("error spectrum", Verdict.SHOWN, sentence, curves=tuple(curves),
                 axes=("frequency [Hz]", "amplitude"))  # fmt: skip


def check_frequency_response(data: ValidationData) -> Check:
    """Gain of the data against gain of the simulation, input by input, where the coherence is high
    enough; the linearised model is drawn with them."""
    found, linear = data.simulations, data.linear_responses
    title, axes = "frequency response", ("frequency [Hz]", "gain")
    drawn: list[CheckCurve] = []
    worst: tuple[_Deviation, str] | None = None
    for number, name in enumerate(found.inputs):
        for k, output in enumerate(found.outputs):
            y, e = [b.complete_y[:, k] for b in found.blocks], found.residuals(k)
            one = spectra(found.input(number), y, e, found.sampling_time)
            if one is None:
                continue
            pair = f"{name} to {output}"
            drawn += _drawn(one, linear, pair, name, k, found.sampling_time)
            largest = _deviation(one, float(found.deviation[k]))
            if largest is not None and (worst is None or largest.order > worst[0].order):
                worst = largest, pair
    if not drawn:
        return Check(title, Verdict.ABSENT, _TOO_SHORT)
    curves = tuple(drawn)
    if worst is None:
        sentence = f"the coherence of every input and output is at most {_COHERENT:g}"
        return Check(title, Verdict.SHOWN, sentence, curves=curves, axes=axes)
    one, pair = worst
    if one.size == 0.0:
        sentence = (
            "the gain of the simulation agrees with the data within statistical error where the "
            f"coherence is above {_COHERENT:g}"
        )
        return Check(title, Verdict.PASS, sentence, curves=curves, axes=axes)
    words = (
        f"{pair} at {one.frequency:.3g} Hz deviates by {percent(one.size)} from the data "
        f"(coherence {one.coherence:.2f})"
    )
    if one.verdict is Verdict.PASS:
        return Check(title, Verdict.PASS, f"where it costs most, {words}", curves=curves, axes=axes)
    sentence = (
        f"{words}; such frequencies hold {percent(one.part)} of the output's standard deviation: "
        "a mode, a delay or a gain that depends on the operating point is missing"
    )
    return Check(title, one.verdict, sentence, None, 0.04, curves, axes)


@dataclass(frozen=True)
class _Deviation:
    """Largest deviation of the gain of a simulation from that of the data, beyond chance."""

    verdict: Verdict
    size: float
    """Relative difference of the gains at `frequency`; 0 where all are equal within chance."""
    part: float
    """Part of the residual at all frequencies that deviate as much, in standard deviations of the
    output."""
    frequency: float
    """Frequency of the largest part, Hz."""
    coherence: float

    @property
    def order(self) -> tuple[int, float]:
        """The verdict, then the size."""
        return (Verdict.PASS, Verdict.DOUBT, Verdict.FAIL).index(self.verdict), self.size


def _deviation(one: Spectra, deviation: float) -> _Deviation | None:
    """Compare the two gains of a pair; None where no frequency is coherent.

    Args:
        deviation: standard deviation of the output
    """
    coherence = _coherence(one)
    judged = (coherence >= _COHERENT) & (one.input > 1e-6 * one.input.max())
    if not judged.any():
        return None
    # What the input explains of the residual, as a part of the variance of the output.
    power = np.abs(one.residual_cross) ** 2 / np.maximum(one.input, 1e-300)
    explained = power / np.maximum(one.residual, 1e-300)
    power = power / max(deviation, 1e-300) ** 2
    least = 1.0 - (_CHANCE / len(judged)) ** (1.0 / (one.segments - 1))
    size = np.abs(one.residual_cross) / np.maximum(np.abs(one.output_cross), 1e-300)
    # Within chance, the two are taken as equal.
    size = np.where(judged & (explained > least), size, 0.0)
    limits = ((Verdict.FAIL, *_FAILS), (Verdict.DOUBT, *_DOUBTS), (Verdict.PASS, 1e-300, 0.0))
    parts = [float(np.sqrt(np.sum(power[size >= far]))) for _, far, _ in limits]
    verdict, far, part = next(
        (verdict, far, part)
        for (verdict, far, large), part in zip(limits, parts, strict=True)
        if part >= large
    )
    place = int(np.argmax(np.where(size >= far, power, -1.0)))
    return _Deviation(
        verdict, float(size[place]), part, float(one.frequency[place]), float(coherence[place])
    )


def _coherence(one: Spectra) -> Array:
    return np.abs(one.output_cross) ** 2 / np.maximum(one.input * one.output, 1e-300)


def _drawn(
    one: Spectra, linear: Sequence[LinearResponse], pair: str, name: str, output: int, ts: float
) -> list[CheckCurve]:
    power = np.maximum(one.input, 1e-300)
    model = np.abs(one.output_cross - one.residual_cross) / power
    clear = _coherence(one) >= _DRAWN
    words = f", coherence above {_DRAWN:g}"
    if not clear.any():
        clear, words = np.ones_like(clear), ""
    frequency = one.frequency[clear]
    curves = [
        CheckCurve(f"{pair}, data{words}", frequency, (np.abs(one.output_cross) / power)[clear]),
        CheckCurve(f"{pair}, simulation{words}", frequency, model[clear]),
    ]
    for response in linear:
        if response.input == name:
            omega = 2.0 * np.pi * one.frequency * ts
            gain = np.abs(frequency_response_of(response.impulse, omega)[:, output])
            curves.append(
                CheckCurve(f"{pair}, linearised at {response.point}", one.frequency, gain)
            )
    return curves


# Check that the model stays bounded far beyond the length of its records.

HORIZONS = 10
_FAR = 5.0
# Growth of the second five horizons over that of the first: an integrator has about 1.
_SPEEDS_UP = 2.0
_MORE = 1.5
_DRAWN_SAMPLES = 2000


def check_long_run(data: ValidationData) -> Check:
    """Check that a simulation over HORIZONS horizons stays bounded."""
    y_hat, lowest, highest = data.long_run(), data.lowest, data.highest
    name, axes = (
        "ten horizons",
        ("horizon", "distance from the middle / half the training range [-]"),
    )
    if y_hat is None:
        sentence = f"over ten horizons the simulation diverges: {Cause.UNSTABLE}"
        return Check(name, Verdict.FAIL, sentence, Cause.UNSTABLE, 3.0)
    half = np.maximum((highest - lowest) / 2.0, 1e-300)
    distance = np.max(np.abs(y_hat - (highest + lowest) / 2.0) / half, axis=1)
    peaks = np.array([part.max() for part in np.array_split(distance, HORIZONS)])
    step = max(1, len(distance) // _DRAWN_SAMPLES)
    times = np.arange(len(distance))[::step] * HORIZONS / len(distance)
    curves = (CheckCurve("distance from the middle", times, distance[::step]),)
    last = float(peaks[-1])
    early, late = float(peaks[4] - peaks[0]), float(peaks[-1] - peaks[4])
    faster = late > _SPEEDS_UP * max(early, 0.05)
    if faster and last > _MORE * float(peaks[0]):
        words = f"over ten horizons the simulation grows exponentially, to {last:.3g} times"
        verdict = Verdict.FAIL if last > _FAR else Verdict.DOUBT
        return Check(name, verdict, f"{words} half the training range: {Cause.UNSTABLE}",
                     Cause.UNSTABLE, 3.0, curves, axes)  # fmt: skip
    if last > _FAR:
        sentence = (
            "over ten horizons the simulation grows steadily, as that of an integrator, to "
            f"{last:.3g} times half the training range"
        )
        return Check(name, Verdict.DOUBT, sentence, None, 0.3, curves, axes)
    sentence = (
        "the simulation stays bounded: in the last of ten horizons it is at most "
        f"{last:.2g} times half the training range from the middle of that range"
    )
    return Check(name, Verdict.PASS, sentence, curves=curves, axes=axes)
