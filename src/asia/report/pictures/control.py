"""Picture of a controlled loop: responses of all models to a step of the set point."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from asia.data.trajectory import Array
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
