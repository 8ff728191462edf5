"""The residual by frequency, and the model's frequency response against that of the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asia.data import Array
from asia.scoring.dossier.check import Check, CheckCurve, Verdict
from asia.scoring.dossier.records import SimulatedBlocks, percent
from asia.scoring.dossier.response import LinearResponse, frequency_response_of

_LONGEST, _SHORTEST = 256, 16
_COHERENT = 0.8
# Below it the gain of the data is mostly noise, and is not drawn.
_DRAWN = 0.5
_OFF, _FAR_OFF = 0.25, 0.5
_CHANCE = 1e-4
_TOO_SHORT = (
    "does not apply: the simulations are too short for a spectrum, which needs "
    f"{_SHORTEST} samples of eight windows or more, or {4 * _SHORTEST} of fewer"
)

# Relative difference, frequency, coherence, and which input and output.
_Worst = tuple[float, str, float, str]


@dataclass(frozen=True)
class Spectra:
    """Spectral densities of one input, an output and its residual, by Welch's method."""

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


def check_spectrum(found: SimulatedBlocks, noise: Sequence[float | None]) -> Check:
    """Show the spectrum of the residual against the output and the noise; it is not judged.

    Args:
        noise: noise of each output over its standard deviation, None where it is not known
    """
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
        line = f"{name}: residual {percent(part)} of the output"
        line += "" if floor is None else f", noise {percent(floor)}"
        if len(above):
            line += f", above half its power from {above[0]:.3g} Hz on"
        words.append(line)
    if not words:
        return Check("error spectrum", Verdict.ABSENT, _TOO_SHORT)
    sentence = "; ".join(words)
    return Check("error spectrum", Verdict.SHOWN, sentence, curves=tuple(curves),
                 axes=("frequency [Hz]", "amplitude"))  # fmt: skip


def check_frequency_response(found: SimulatedBlocks, linear: Sequence[LinearResponse]) -> Check:
    """Gain of the data against gain of the simulation, input by input, where the coherence is high
    enough; the linearised model is drawn with them."""
    curves: list[CheckCurve] = []
    worst: _Worst | None = None
    for number, name in enumerate(found.inputs):
        for k, output in enumerate(found.outputs):
            y, e = [b.complete_y[:, k] for b in found.blocks], found.residuals(k)
            one = spectra(found.input(number), y, e, found.sampling_time)
            if one is None:
                continue
            pair = f"{name} to {output}"
            curves += _drawn(one, linear, pair, name, k, found.sampling_time)
            off = _off(one)
            if off is not None and (worst is None or off[0] > worst[0]):
                worst = (*off, pair)
    title, axes = "frequency response", ("frequency [Hz]", "gain")
    if not curves:
        return Check(title, Verdict.ABSENT, _TOO_SHORT)
    return _judged(worst, title, tuple(curves), axes)


def _judged(
    worst: _Worst | None, title: str, curves: tuple[CheckCurve, ...],
    axes: tuple[str, str],
) -> Check:  # fmt: skip
    if worst is None:
        sentence = f"the coherence of every input and output is at most {_COHERENT:g}"
        return Check(title, Verdict.SHOWN, sentence, curves=curves, axes=axes)
    size, frequency, coherence, pair = worst
    if size == 0.0:
        sentence = (
            "the gain of the simulation agrees with the data within statistical error where the "
            "coherence "
            f"is above {_COHERENT:g}"
        )
        return Check(title, Verdict.PASS, sentence, curves=curves, axes=axes)
    words = (
        f"{pair} at {frequency} Hz deviates by {percent(size)} from the data (coherence "
        f"{coherence:.2f})"
    )
    if size < _OFF:
        return Check(title, Verdict.PASS, f"at most, {words}", curves=curves, axes=axes)
    verdict = Verdict.FAIL if size >= _FAR_OFF else Verdict.DOUBT
    return Check(title, verdict, words, None, 0.04, curves, axes)


def _off(one: Spectra) -> tuple[float, str, float] | None:
    """The largest relative difference of the two gains beyond chance, the frequency, and the
    coherence there; None where no line is coherent."""
    coherence = _coherence(one)
    judged = (coherence >= _COHERENT) & (one.input > 1e-6 * one.input.max())
    if not judged.any():
        return None
    explained = np.abs(one.residual_cross) ** 2 / np.maximum(one.input * one.residual, 1e-300)
    least = 1.0 - (_CHANCE / len(judged)) ** (1.0 / (one.segments - 1))
    size = np.abs(one.residual_cross) / np.maximum(np.abs(one.output_cross), 1e-300)
    # Within chance, the two are taken as equal.
    size = np.where(judged & (explained > least), size, 0.0)
    place = int(np.argmax(np.where(judged, size, -1.0)))
    return float(size[place]), f"{one.frequency[place]:.3g}", float(coherence[place])


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
