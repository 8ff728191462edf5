"""Columns of panels, each a plot above a strip, with axes in line and room for every text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure

# Heights and gaps in inches.
_HEAD_LINE = 0.17
_ABOVE = 0.08
_FOOT = 0.6
_TITLE_LINE = 0.155
_ABOVE_TITLE = 0.16
_PLOT = 1.3
_BETWEEN = 0.08
_STRIP = 0.44
_TICKS = 0.2
_TICK_GAP = 0.1
_EDGE = 0.1


@dataclass(frozen=True)
class PlotWithStrip:
    """A plot, the strip below it, and the lines of the plot's title."""

    plot: Axes
    strip: Axes
    title_lines: int


def arrange(
    figure: Figure, cells: Sequence[PlotWithStrip], columns: int, width: float, title: str
) -> None:
    """Give `figure` its height and all axes their places; width in inches. Cells fill rows from
    the left; the left margin of each column is what its labels need. `title` goes above all."""
    rows = [cells[i : i + columns] for i in range(0, len(cells), columns)]
    heads = [_ABOVE_TITLE + _TITLE_LINE * max(c.title_lines for c in row) for row in rows]
    above = _ABOVE + _HEAD_LINE * (title.count("\n") + 1)
    height = above + _FOOT + sum(heads) + len(rows) * (_PLOT + _BETWEEN + _STRIP + _TICKS)
    figure.set_size_inches(width, height)
    share = width / columns
    margins = [0.0] * columns
    for _ in range(2):  # the second pass places with the margins that the first one measured
        top = height - above
        for row, head in zip(rows, heads, strict=True):
            top -= head
            for column, cell in enumerate(row):
                left = share * column + margins[column]
                size = share - margins[column] - _EDGE
                _put(cell.plot, (left, top - _PLOT, size, _PLOT), (width, height))
                low = top - _PLOT - _BETWEEN - _STRIP
                _put(cell.strip, (left, low, size, _STRIP), (width, height))
            top -= _PLOT + _BETWEEN + _STRIP + _TICKS
        figure.draw_without_rendering()
        for column in range(columns):
            axes = [a for c in cells[column::columns] for a in (c.plot, c.strip)]
            margins[column] = _align(axes, figure.dpi, share - margins[column] - _EDGE)

    _entitle(figure, title, width, height)


def _entitle(figure: Figure, title: str, width: float, height: float) -> None:
    place = {"x": _EDGE / width, "y": 1.0 - _ABOVE / height}
    figure.suptitle(title, ha="left", va="top", fontweight="bold", **place)


def _put(axes: Axes, box: tuple[float, float, float, float], figure: tuple[float, float]) -> None:
    left, low, width, height = box
    axes.set_position((left / figure[0], low / figure[1], width / figure[0], height / figure[1]))


def _align(axes: Sequence[Axes], dpi: float, width: float) -> float:
    """Put the y labels in line, left of the widest tick label; the margin in inches they need."""
    ticks = max(t.get_window_extent().width for a in axes for t in a.get_yticklabels()) / dpi
    names = max(a.yaxis.label.get_window_extent().width for a in axes) / dpi
    for a in axes:
        a.yaxis.set_label_coords(-(ticks + _TICK_GAP) / width, 0.5)
    return _EDGE + names + ticks + _TICK_GAP
