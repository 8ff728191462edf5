"""Figures of controlled loops, monitored records and proposed experiments."""

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
    SHADE,
    axis_label,
    entitle,
    figure_legend,
    picture_width,
    plain,
    quiet_grid,
)

_COLOURS = (BLUE, ORANGE, GREEN, RED, INK)


def draw_control(
    responses: Sequence[tuple[str, Array, Array]],
    noisy: tuple[Array, Array] | None,
    sampling_time: float,
    setpoint: float,
    limits: tuple[float, float],
    names: tuple[str, str],
) -> Figure:
    """Output above, input below.

    Args:
        responses: name of the model, outputs (T,), inputs (T,); the first one is the model to use
        noisy: outputs and inputs of the first one with measurement noise
        names: labels of output and input
    """
    figure = Figure(figsize=(picture_width(), 4.6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    t = sampling_time * np.arange(len(responses[0][1]))
    if noisy is not None:
        above.plot(t, noisy[0], color=QUIET, lw=0.7, label="with measurement noise")
        below.step(t, noisy[1], color=QUIET, lw=0.7, where="post")
    for number, (name, y, u) in reversed(list(enumerate(responses))):
        colour, width = _COLOURS[number % len(_COLOURS)], 1.8 if number == 0 else 1.0
        above.plot(t, y, color=colour, lw=width, label=plain(name))
        below.step(t, u, color=colour, lw=width, where="post")
    above.axhline(setpoint, color=INK, lw=0.8, ls="--")
    for limit in limits:
        if np.isfinite(limit):
            below.axhline(limit, color=INK, lw=0.8, ls=":")
    above.set_ylabel(plain(names[0]))
    below.set_ylabel(plain(names[1]))
    below.set_xlabel("time [s]")
    for axis in (above, below):
        quiet_grid(axis)
    figure_legend(figure, above.get_lines()[:-1], 4)
    return figure


# Points of a line in a picture of a monitored record.
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


def draw_experiment(
    columns: Sequence[tuple[str, Array, Array, Array, Array]],
    signals: tuple[Sequence[Signal], Sequence[Signal]],
    sampling_time: float,
    limits: tuple[Array, Array],
    keep: Array,
) -> Figure:
    """Inputs above, expected outputs below, a column a record.

    Args:
        columns: title, inputs (H, nu), simulations (M, H, ny), least and largest expected output
            (H, ny) of each record; the proposed one first
        signals: inputs and outputs
        limits: least and largest input, (nu,) each
        keep: least and largest permitted output, (2, ny)
    """
    inputs, outputs = signals
    rows = len(inputs) + len(outputs)
    figure = Figure(figsize=(picture_width(), 0.8 + 1.5 * rows), layout="constrained")
    axes = figure.subplots(rows, len(columns), sharex=True, sharey="row", squeeze=False)
    t = sampling_time * np.arange(len(columns[0][1]))
    for c, (title, u, y, lower, upper) in enumerate(columns):
        axes[0, c].set_title(title)
        for j, signal in enumerate(inputs):
            axis = axes[j, c]
            axis.step(t, u[:, j], color=_COLOURS[c % len(_COLOURS)], lw=1.0, where="post")
            for limit in (limits[0][j], limits[1][j]):
                axis.axhline(limit, color=INK, lw=0.8, ls=":")
            if c == 0:
                axis.set_ylabel(axis_label(signal))
        for i, signal in enumerate(outputs):
            axis = axes[len(inputs) + i, c]
            axis.fill_between(
                t, lower[:, i], upper[:, i], color=SHADE, lw=0, label="expected range"
            )
            for one in y[1:]:
                axis.plot(t, one[:, i], color=_COLOURS[c % len(_COLOURS)], lw=0.5, alpha=0.5)
            axis.plot(t, y[0][:, i], color=INK, lw=0.9, label="models")
            for limit in keep[:, i]:
                if np.isfinite(limit):
                    axis.axhline(limit, color=INK, lw=1.0, ls="--", label="limit of the output")
            if c == 0:
                axis.set_ylabel(axis_label(signal))
        axes[-1, c].set_xlabel("Time [s]")
    for axis in axes.reshape(-1):
        quiet_grid(axis)
    entitle(figure, "Proposed experiment, and records of equal energy")
    # Of the two limits of an output one is named.
    named = dict(zip(*reversed(axes[-1, 0].get_legend_handles_labels()), strict=True))
    figure_legend(figure, list(named.values()), 3)
    return figure
