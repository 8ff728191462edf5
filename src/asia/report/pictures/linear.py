"""Picture of linear models: frequency response, step response, poles and zeros."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

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
