"""The correlation of each input with each output, by lag."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from asia.problem.advice.data import InputDelay
from asia.problem.load import Problem
from asia.report._drawing.style import BLUE, INK, ORANGE, entitle, picture_width, plain, quiet_grid

_MOST = 4
# Lags beyond the delay that are shown.
_AFTER = 20


def draw_delays(problem: Problem, found: Sequence[InputDelay]) -> Figure:
    """A panel for each output and input, of at most four of each; only the first lags."""
    outputs = list(dict.fromkeys(a.output for a in found))[:_MOST]
    inputs = list(dict.fromkeys(a.given for a in found))[:_MOST]
    figure = Figure(figsize=(picture_width(), 0.9 + 1.5 * len(outputs)), layout="constrained")
    grid = figure.subplots(len(outputs), len(inputs), squeeze=False, sharex=True)
    lags = 1 + _AFTER + max((a.delay.lag or 0) for a in found)
    for answer in found:
        if answer.output not in outputs or answer.given not in inputs:
            continue
        axes = grid[outputs.index(answer.output), inputs.index(answer.given)]
        values = answer.delay.correlation[:lags]
        axes.vlines(np.arange(len(values)), 0.0, values, color=BLUE, lw=1.5)
        axes.axhspan(-answer.delay.band, answer.delay.band, color=INK, alpha=0.15, lw=0.0)
        lag = answer.delay.lag
        if lag is not None:
            axes.plot([lag], [answer.delay.correlation[lag]], "o", ms=4.0, color=ORANGE)
        quiet_grid(axes)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    for axes, name in zip(grid[:, 0], outputs, strict=True):
        axes.set_ylabel(plain(name, 14))
    for axes, name in zip(grid[0], inputs, strict=True):
        axes.set_title(plain(name, 20))
    figure.supxlabel("lag [samples]; grey: 99 % band; dot: the delay")
    entitle(figure, f"{plain(problem.name, 30)}: correlation of inputs with outputs, whitened")
    return figure
