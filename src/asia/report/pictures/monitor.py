"""Picture of a monitored record: outputs and their prediction, NIS, Page's test, parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from asia.data.trajectory import Array, Signal
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

# Points of a line in a picture.
_MOST = 4_000


def draw_monitor(
    t: Array,
    outputs: Sequence[tuple[Signal, Array, Array]],
    nis: tuple[Array, float, float],
    statistic: tuple[Array, float],
    parameters: Sequence[tuple[str, float, Array, Array]],
    alarms: Sequence[tuple[float, float]],
) -> Figure:
    """Panels over the time t (T,) in s, with the times without a valid model in red.

    Args:
        outputs: signal, measured (T,) and expected values (T,)
        nis: values (T,) and the ends of their 95 % band
        statistic: values (T,) of Page's test and the threshold
        parameters: name, value in the run, estimates (T,), half width (T,) of their 95 % band
        alarms: first and last times in s
    """
    rows = len(outputs) + 2 + len(parameters)
    figure = Figure(figsize=(picture_width(), 1.0 + 1.35 * rows), layout="constrained")
    axes: list[Any] = list(figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0])
    every = slice(None, None, max(len(t) // _MOST, 1))
    x = t[every]
    for axis, (signal, measured, expected) in zip(axes, outputs, strict=False):
        axis.plot(x, measured[every], color=INK, lw=0.8, label="measured")
        axis.plot(x, expected[every], color=ORANGE, lw=0.8, label="expected one sample ahead")
        axis.set_title(plain(signal.label))
    values, low, high = nis
    axis = axes[len(outputs)]
    axis.semilogy(x, np.maximum(values[every], 1e-3 * low + 1e-12), ".", color=BLUE, ms=1.5)
    axis.axhspan(low, high, color=QUIET, alpha=0.2, lw=0)
    axis.set_ylim(max(0.1 * low, 1e-4), max(10.0 * high, 2.0 * float(np.nanmax(values))))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.set_title("normalised innovation squared (NIS) and its 95 % band")
    sums, threshold = statistic
    axis = axes[len(outputs) + 1]
    axis.plot(x, sums[every], color=BLUE, lw=0.9)
    axis.axhline(threshold, color=RED, lw=0.9, ls="--")
    axis.set_title("Page's test: an alarm above the line")
    for axis, (name, nominal, estimate, wide) in zip(
        axes[len(outputs) + 2 :], parameters, strict=True
    ):
        axis.plot(x, estimate[every], color=GREEN, lw=1.0)
        axis.fill_between(
            x, (estimate - wide)[every], (estimate + wide)[every], color=GREEN, alpha=0.25, lw=0
        )
        axis.axhline(nominal, color=QUIET, lw=0.8, ls=":")
        axis.set_title(f"{plain(name)}: estimate with 95 % band, and value in the run (dotted)")
    for axis in axes:
        for first, last in alarms:
            axis.axvspan(first, last, color=RED, alpha=0.12, lw=0)
        quiet_grid(axis)
    axes[-1].set_xlabel("time [s]")
    figure_legend(figure, axes[0].get_lines()[:2], 2)
    return figure
