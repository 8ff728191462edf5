"""Pictures of `asia check` in the frequency domain: output, noise and the residual of a linear
model.
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from asia.data import Array
from asia.data.frequency.response import FrequencyResponse
from asia.problem.load import Problem
from asia.report._drawing.style import (
    BLUE,
    INK,
    ORANGE,
    entitle,
    figure_legend,
    picture_width,
    plain,
    quiet_grid,
)

_MOST_OUTPUTS = 4
_DEEPEST = 1e-9


def draw_responses(problem: Problem, found: tuple[FrequencyResponse | None, ...]) -> Figure:
    """Draw one panel for each output; amplitudes in dB of the output's standard deviation."""
    shown = [
        (signal, one) for signal, one in zip(problem.outputs, found, strict=True) if one is not None
    ][:_MOST_OUTPUTS]
    figure = Figure(figsize=(picture_width(), 0.9 + 2.2 * len(shown)), layout="constrained")
    grid = figure.subplots(len(shown), 1, squeeze=False, sharex=True)[:, 0]
    for axes, (signal, one) in zip(grid, shown, strict=True):
        size = float(np.sqrt((one.output**2).sum()))
        for values, color, label in (
            (one.output, BLUE, "output"),
            (one.rest, ORANGE, "left by the best linear model"),
            (one.noise, INK, "noise"),
        ):
            if np.isfinite(values).any():
                axes.plot(
                    one.frequency, _decibels(values / size), ".", ms=2.0, color=color, label=label
                )
        axes.set_ylabel(f"{plain(signal.name, 20)} [dB]")
        quiet_grid(axes)
    grid[-1].set_xlabel("frequency [Hz]")
    grid[0].set_xscale("log")
    # Text is drawn as it is here, without formulas.
    grid[-1].xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    period = shown[0][1].period
    how = f"period of {period} samples" if period is not None else "no period"
    entitle(figure, f"{plain(problem.name, 30)}: levels by frequency, {how}")
    figure_legend(figure, grid[0].get_legend_handles_labels()[0], 3, markerscale=4)
    return figure


def _decibels(values: Array) -> Array:
    return 20.0 * np.log10(np.maximum(values, _DEEPEST))
