"""Picture of the error of windows over the number of samples since their start."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from asia.data import Array
from asia.report._drawing.style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    QUIET,
    RED,
    entitle,
    figure_legend,
    picture_width,
    plain,
    quiet_grid,
)

_COLUMNS = 2
_MANY_COLUMNS = 4
_FEW = 4
_NOTE_LINE = 0.125
MOST_PANELS = 16
_COLOURS: Final = (BLUE, ORANGE, GREEN, RED, QUIET, FAINT)
_MARK_COLOURS: Final = (QUIET, GREEN, RED, INK)
_MARKERS: Final = ("o", "s", "^", "D", "v", "P")


@dataclass(frozen=True)
class ErrorCurve:
    """Error after each sample of the window, (H,)."""

    label: str
    values: Array


@dataclass(frozen=True)
class Marks:
    """Published errors: (horizon in samples, error)."""

    label: str
    points: tuple[tuple[int, float], ...]


@dataclass(frozen=True)
class Growth:
    """Error growth of one output or group; `title` names it, `label` the axis."""

    title: str
    label: str
    lines: tuple[ErrorCurve, ...]
    marks: tuple[Marks, ...] = ()


def draw_growth(
    panels: Sequence[Growth], sampling_time: float, title: str, caption: str = ""
) -> Figure:
    """A panel each, the same lines and marks in all of them. sampling_time in seconds."""
    columns = _COLUMNS if len(panels) <= _FEW else _MANY_COLUMNS
    rows = -(-len(panels) // columns)
    width = picture_width() if columns == _COLUMNS else 1.3 * picture_width()
    each = 2.2 if columns == _COLUMNS else 1.55
    note = textwrap.wrap(caption, int(16 * width))
    below = _NOTE_LINE * len(note)
    figure = Figure(figsize=(width, 1.0 + rows * each + below), layout="constrained")
    grid = figure.add_gridspec(rows + 1, columns, height_ratios=[each] * rows + [below + 0.01])
    first: Axes | None = None
    last = max(len(line.values) for line in panels[0].lines)
    span = f"{sampling_time * 1000:g} ms" if sampling_time < 1 else f"{sampling_time:g} s"
    for index, panel in enumerate(panels):
        axes = figure.add_subplot(grid[index // columns, index % columns], sharex=first)
        first = first or axes
        _panel(axes, panel)
        axes.set_xlim(0, last * 1.04)
        if index + columns >= len(panels):
            axes.set_xlabel(
                f"Samples after the start, {span} each" if columns == _COLUMNS else "Samples"
            )
        else:
            axes.tick_params(labelbottom=False)
    if note:
        place = figure.add_subplot(grid[rows, :])
        place.set_axis_off()
        place.text(0.0, 1.0, "\n".join(note), va="top", fontsize=6.5, color=QUIET)
    if first is not None:
        figure_legend(figure, first.get_legend_handles_labels()[0], 3)
    entitle(figure, title)
    return figure


def _panel(axes: Axes, panel: Growth) -> None:
    for index, line in enumerate(panel.lines):
        at = np.arange(1, len(line.values) + 1)
        dashes = (4, 1.5) if index and panel.marks else (1, 0)
        axes.plot(
            at,
            line.values,
            color=_COLOURS[index % len(_COLOURS)],
            lw=1.6,
            dashes=dashes,
            label=plain(line.label, 44),
        )
    for index, marks in enumerate(panel.marks):
        axes.plot(
            [h for h, _ in marks.points],
            [v for _, v in marks.points],
            _MARKERS[index % len(_MARKERS)],
            mfc="white",
            mec=_MARK_COLOURS[index % len(_MARK_COLOURS)],
            mew=1.2,
            ms=5.0,
            label=plain(marks.label, 44),
        )
    axes.set_title(plain(panel.title, 30))
    axes.set_ylabel(plain(panel.label, 24))
    if panel.marks:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_minor_locator(NullLocator())
    else:
        axes.set_ylim(bottom=0.0)
    quiet_grid(axes)
