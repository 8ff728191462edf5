"""Picture of linear models: frequency response, step response, poles and zeros."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from asia.data.trajectory import Array, Signal
from asia.lowering.linear import LinearModel, corner_frequencies, settling_samples
from asia.report.drawing.style import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    QUIET,
    RED,
    figure_legend,
    picture_width,
    plain,
    quiet_grid,
)

_COLOURS = (BLUE, ORANGE, GREEN, RED, INK)
_MOST_PAIRS = 4


def draw_linear(
    points: Sequence[tuple[str, LinearModel, Sequence[LinearModel]]],
    inputs: Sequence[Signal],
    outputs: Sequence[Signal],
) -> Figure:
    """A row for each pair of output and input (four at most): gain, phase and step response of
    every operating point, with bands between the fold models; poles and zeros below."""
    pairs = [(i, j) for i in range(len(outputs)) for j in range(len(inputs))][:_MOST_PAIRS]
    rows = len(pairs) + 1
    figure = Figure(figsize=(1.35 * picture_width(), 1.0 + 2.0 * rows), layout="constrained")
    axes = figure.subplots(rows, 3, squeeze=False)
    samples = max(settling_samples(model) for _, model, _ in points)
    low = min(float(corner_frequencies(model)[0]) for _, model, _ in points)
    for colour, (name, model, folds) in zip(_COLOURS, points, strict=False):
        high = 0.5 / model.sampling_time
        frequencies = np.geomspace(low, 0.98 * high, 300)
        response, steps = model.response(frequencies), model.step_response(samples)
        others = [one.response(frequencies) for one in folds]
        other_steps = [one.step_response(samples) for one in folds]
        t = model.sampling_time * np.arange(samples)
        for row, (i, j) in enumerate(pairs):
            gain, phase, step = axes[row]

            def curve(values: Any, i: int = i, j: int = j) -> Array:
                return values[:, i, j]

            def angle(values: Any) -> Array:
                return np.degrees(np.unwrap(np.angle(values)))

            gain.loglog(frequencies, np.abs(curve(response)), color=colour, label=plain(name))
            phase.semilogx(frequencies, angle(curve(response)), color=colour)
            step.step(t, curve(steps), color=colour, where="post")
            if others:
                sizes = np.array([np.abs(curve(one)) for one in others])
                turns = np.array([angle(curve(one)) for one in others])
                ways = np.array([curve(one) for one in other_steps])
                for axis, x, band in ((gain, frequencies, sizes), (phase, frequencies, turns),
                                      (step, t, ways)):  # fmt: skip
                    axis.fill_between(
                        x, band.min(axis=0), band.max(axis=0), color=colour, alpha=0.25, lw=0
                    )
        plane = axes[-1][0]
        for one, alpha in ((model, 1.0), *((fold, 0.3) for fold in folds)):
            plane.plot(one.poles.real, one.poles.imag, "x", color=colour, alpha=alpha)
            plane.plot(
                one.zeros.real, one.zeros.imag, "o", color=colour, alpha=alpha, fillstyle="none"
            )
    for row, (i, j) in enumerate(pairs):
        gain, phase, step = axes[row]
        out, into = outputs[i], inputs[j]
        unit = f" [{out.unit or '1'}/{into.unit or '1'}]" if out.unit or into.unit else ""
        gain.set_title(plain(f"{out.name} by {into.name}: gain{unit}"))
        phase.set_title("phase [degrees]")
        step.set_title("response to a unit step")
        gain.set_xlabel("frequency [Hz]")
        phase.set_xlabel("frequency [Hz]")
        step.set_xlabel("time [s]")
        for axis in axes[row]:
            quiet_grid(axis)
        gain.yaxis.set_major_formatter("{x:g}")
        for axis in (gain, phase):
            axis.xaxis.set_major_formatter("{x:g}")
    plane = axes[-1][0]
    turn = np.linspace(0, 2 * np.pi, 200)
    plane.plot(np.cos(turn), np.sin(turn), color=QUIET, lw=0.7)
    plane.set_aspect("equal", adjustable="datalim")
    plane.set_title("poles (x) and zeros (o)")
    quiet_grid(plane)
    for axis in axes[-1][1:]:
        axis.set_axis_off()
    figure_legend(figure, axes[0][0].get_lines(), 3)
    return figure


def draw_frequency_response(
    frequency: Array,
    measured: NDArray[np.complex128],
    deviation: Array | None,
    models: Sequence[tuple[LinearModel, float]],
    inputs: Sequence[Signal],
    outputs: Sequence[Signal],
) -> Figure:
    """A row for each pair of output and input (four at most): measured and modelled gain and phase,
    and the residual with the standard deviation of the measurement.

    Args:
        frequency: (F,) in Hz
        measured: (F, ny, nu)
        deviation: (F, ny, nu), where it is known
        models: models with their delays in s: the whole one, then those of the folds
    """
    pairs = [(i, j) for i in range(len(outputs)) for j in range(len(inputs))][:_MOST_PAIRS]
    figure = Figure(figsize=(1.35 * picture_width(), 1.0 + 2.3 * len(pairs)), layout="constrained")
    axes = figure.subplots(len(pairs), 3, squeeze=False)
    grid = np.unique(np.concatenate([np.geomspace(max(frequency[0], 1e-6 * frequency[-1]),
                                                  frequency[-1], 600), frequency]))  # fmt: skip

    def responses(at: Array) -> list[NDArray[np.complex128]]:
        return [model.response(at) * np.exp(-2j * np.pi * at * delay)[:, None, None]
                for model, delay in models]  # fmt: skip

    fine, same = responses(grid), responses(frequency)[0]
    for row, (i, j) in enumerate(pairs):
        gain, phase, rest = axes[row]
        gain.loglog(frequency, np.abs(measured[:, i, j]), ".", color=INK, ms=2.5, label="measured")
        angle = np.degrees(np.unwrap(np.angle(measured[:, i, j])))
        phase.semilogx(frequency, angle, ".", color=INK, ms=2.5)
        for k, one in enumerate(fine):
            curve = one[:, i, j]
            style = {"color": ORANGE, "lw": 1.0 if k == 0 else 0.6, "alpha": 1.0 if k == 0 else 0.4}
            label = ("model", "models of the folds")[min(k, 1)] if k < 2 else None
            gain.loglog(grid, np.abs(curve), label=label, **style)
            turned = np.degrees(np.unwrap(np.angle(curve)))
            # The same turn as the measured phase.
            turned += 360.0 * np.round(np.mean(np.interp(frequency, grid, -turned) + angle) / 360.0)
            phase.semilogx(grid, turned, **style)
        apart = np.abs(measured[:, i, j] - same[:, i, j])
        rest.loglog(frequency, apart, ".", color=BLUE, ms=2.5, label="residual")
        if deviation is not None:
            rest.loglog(frequency, deviation[:, i, j], color=QUIET, lw=0.9,
                        label="standard deviation of the measurement")  # fmt: skip
        gain.set_title(plain(f"{outputs[i].name} by {inputs[j].name}: gain"))
        phase.set_title("phase [degrees]")
        rest.set_title("residual")
        for axis in axes[row]:
            axis.set_xlabel("frequency [Hz]")
            axis.xaxis.set_major_formatter("{x:g}")
            quiet_grid(axis)
        for axis in (gain, rest):
            axis.yaxis.set_major_formatter("{x:g}")
    lines = [*axes[0][0].get_lines()[:3], *axes[0][2].get_lines()]
    figure_legend(figure, lines, 3)
    return figure
