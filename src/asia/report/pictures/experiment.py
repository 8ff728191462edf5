"""Picture of a proposed experiment beside an APRBS and a multisine of equal energy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from asia.data.trajectory import Array, Signal
from asia.report.drawing.style import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    SHADE,
    axis_label,
    entitle,
    figure_legend,
    picture_width,
    quiet_grid,
)

_COLOURS = (BLUE, ORANGE, GREEN)


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
