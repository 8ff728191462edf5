"""Style and layout of pictures."""

import textwrap
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from threading import RLock
from typing import Any, Final

import numpy as np
from matplotlib import rcParams, style
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.ticker import LogLocator, NullFormatter
from matplotlib.transforms import Bbox, offset_copy

from asia.data.trajectory import Array, Signal
from asia.problem.metrics import find_metric

# Okabe and Ito's colours: distinguishable with colour blindness, and different in grey print.
INK: Final = "#222222"
QUIET: Final = "#6b6b6b"
FAINT: Final = "#a8a8a8"
BLUE: Final = "#0072b2"
ORANGE: Final = "#e69f00"
GREEN: Final = "#009e73"
RED: Final = "#d1330a"
SHADE: Final = "#e9e9e9"
GRID: Final = "#e3e3e3"
SERIES: Final = (BLUE, ORANGE, GREEN, RED, INK)
"""Colours of the lines of one panel."""
DASHES: Final = ("-", "--", ":")
"""Dashes of further lines with the same colours."""

_WIDTH: Final = 7.2
DPI: Final = 150
_NARROW: Final = 5.0
_FONT: Final = "DejaVu Sans"
# Tick labels and one line of x label, in points.
_BELOW_AXES: Final = 31.0

_STYLE: Final[dict[str, Any]] = {
    "font.family": _FONT,
    "font.size": 8.5,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.titlepad": 5.0,
    "axes.labelsize": 8.5,
    "axes.labelcolor": INK,
    "axes.edgecolor": QUIET,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.formatter.limits": (-4, 5),
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "text.color": INK,
    "text.parse_math": False,
    "figure.dpi": DPI,
    "figure.titlesize": 10.0,
    "savefig.dpi": DPI,
    "pdf.fonttype": 42,
    # The ids of an SVG come from a fixed salt.
    "svg.hashsalt": "asia",
    "svg.fonttype": "none",
}


# Matplotlib has one set of settings for all threads.
_SETTINGS = RLock()


@contextmanager
def drawing(width: float = _WIDTH) -> Generator[None]:
    """Matplotlib's defaults and our style inside, the caller's settings again outside. width: in
    inches, of a picture with one column of panels; of less than 5 the texts are smaller."""
    small = {key: value - 1.5 for key, value in _STYLE.items() if key.endswith("size")}
    narrow = small if width < _NARROW else {}
    with (
        _SETTINGS,
        style.context(["default", {**_STYLE, **narrow, "figure.figsize": (width, width)}]),
    ):
        yield


def picture_width() -> float:
    """The width of a picture with one column of panels, in inches."""
    return float(rcParams["figure.figsize"][0])


def plain(text: str, limit: int = 60) -> str:
    """`text` on one line of at most `limit` characters, without what the font cannot draw."""
    font = get_font(findfont(FontProperties(family=_FONT)))
    line = " ".join(text.split())
    line = "".join(c if font.get_char_index(ord(c)) else "?" for c in line)
    return line if len(line) <= limit else line[: limit - 1].rstrip() + "…"


def names_that_fit(
    names: Sequence[str], times: Sequence[Array], characters: int
) -> tuple[str, ...]:
    """Names of the segments of an axis, each cut to its part of the width; "" where a part is too
    short for a few characters.

    Args:
        times: time of each sample, or the ends, of each segment
        characters: how many fit over the whole axis
    """
    share = characters / max(float(times[-1][-1] - times[0][0]), 1e-300)
    rooms = [int(share * (time[-1] - time[0])) for time in times]
    return tuple(
        plain(name, room) if room >= min(len(name), 4) else ""
        for name, room in zip(names, rooms, strict=True)
    )


def axis_label(signal: Signal) -> str:
    """Name and unit for an axis an inch long: at most 16 characters a line."""
    name, unit = plain(signal.name, 30), plain(signal.unit, 12)
    wrapped = textwrap.wrap(name.replace("_", "_ "), 16) or [""]
    lines = [line.replace("_ ", "_") for line in wrapped]
    if not unit:
        return "\n".join(lines)
    joined = f"{lines[-1]} [{unit}]"
    last = [joined] if len(joined) <= 17 else [lines[-1], f"[{unit}]"]
    return "\n".join([*lines[:-1], *last])


def number(value: float) -> str:
    """Three significant digits."""
    return f"{value:.3g}"


def quantity(value: float, unit: str) -> str:
    """A number with its unit."""
    return f"{number(value)} {plain(unit, 16)}".rstrip()


def shown(*counts: tuple[int, int, str], why: str = "shown") -> str:
    """` (2 of 3 outputs shown)` for what a picture leaves out, empty when it holds all; a count is
    (number shown, number in all, of what)."""
    cut = [f"{some} of {total} {what}" for some, total, what in counts if some < total]
    return f" ({', '.join(cut)} {why})" if cut else ""


def headline(text: str, width: float) -> str:
    """`text` as the title of a figure `width` inches wide, on as many lines as it needs."""
    return textwrap.fill(text, int(11.5 * width))


def entitle(figure: Figure, title: str) -> None:
    """The title above all panels, from the left edge on."""
    text = headline(title, figure.get_figwidth())
    figure.suptitle(text, x=0.01, ha="left", fontweight="bold")


def figure_legend(figure: Figure, handles: Sequence[Artist], columns: int, **settings: Any) -> None:
    """Put the legend below all panels, in as many of `columns` columns as the figure is wide."""
    names = [str(handle.get_label()) for handle in handles]
    settings = {"loc": "outside lower center", **settings}
    for count in range(min(columns, len(names)), 0, -1):
        legend = figure.legend(handles, names, ncols=count, **settings)
        if count == 1 or legend.get_window_extent().width < figure.bbox.width:
            return
        legend.remove()


def panel_legend(axes: Axes, width: float, **settings: Any) -> float:
    """Put the legend of a panel below its x label, in as many columns as `width` inches hold;
    return its height in inches."""
    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    below = offset_copy(axes.transAxes, figure, y=-_BELOW_AXES, units="points")
    settings = {"alignment": "left", "borderaxespad": 0.0, "bbox_transform": below, **settings}
    box = Bbox.null()
    for columns in range(len(axes.get_legend_handles_labels()[1]), 0, -1):
        legend = axes.legend(loc="upper left", bbox_to_anchor=(0.0, 0.0), ncols=columns, **settings)
        box = legend.get_window_extent()
        if box.width < width * figure.dpi:
            break
    return box.height / figure.dpi


def v_axis_label(metric: str) -> str:
    """Text for an axis of V; metric: its name."""
    found = find_metric(metric)
    return f"Cross-validated {plain(found.v_label, 40)}, V [{plain(found.v_unit, 12)}]"


def plot_line(axes: Axes, time: Array, values: Array, columns: int, **settings: Any) -> None:
    """Plot a line with a gap at each NaN and a dot for a value between two gaps; of a long one the
    least and the greatest value of each of so many columns."""
    known = np.concatenate([[False], ~np.isnan(values), [False]])
    single = known[1:-1] & ~known[:-2] & ~known[2:]
    if single.any():
        color = settings["color"]
        axes.plot(time[single], values[single], ".", ms=2.5, mec=color, mfc=color)
    axes.plot(*thinned(time, values, columns), **settings)


def fill_band(axes: Axes, time: Array, edges: tuple[Array, Array], columns: int,
              **settings: Any) -> None:  # fmt: skip
    """Fill the area between two edges, thinned as `plot_line` does."""
    there, back = (thinned(time, edge, columns) for edge in edges)
    around = (np.concatenate([a, b[::-1]]) for a, b in zip(there, back, strict=True))
    axes.fill(*around, **settings)


def thinned(time: Array, values: Array, columns: int) -> tuple[Array, Array]:
    """Return times and values: all of a short line; of a long one the least and the greatest of
    each column."""
    if len(values) <= 2 * columns:
        return time, values
    ends = np.linspace(0, len(values), columns + 1).astype(int).tolist()
    chosen: list[int] = []
    for first, last in pairwise(ends):
        part = values[first:last]
        if np.isnan(part).all():
            chosen.append(first)
        else:
            chosen += sorted({first + int(np.nanargmin(part)), first + int(np.nanargmax(part))})
    return time[chosen], values[chosen]


def quiet_grid(axes: Axes) -> None:
    """Faint horizontal lines behind the data."""
    axes.grid(visible=True, axis="y")


def label_decades(axis: Axis) -> None:
    """Plain numbers on a logarithmic axis, also inside a short range."""
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 30.0 * low else (1.0,)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


# Columns of panels, each a plot above a strip, with axes in line and room for every text.


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
    lines = [max(c.title_lines for c in row) for row in rows]
    heads = [_ABOVE_TITLE + _TITLE_LINE * count if count else 0.0 for count in lines]
    above = _ABOVE + (_HEAD_LINE * (title.count("\n") + 1) if title else 0.0)
    height = above + _FOOT + sum(heads) + len(rows) * (_PLOT + _BETWEEN + _STRIP + _TICKS)
    figure.set_size_inches(width, height)
    share = width / columns
    margins = [0.0] * columns
    for _ in range(2):  # the second pass places with the margins that the first one measured
        top = height - above
        for row, head in zip(rows, heads, strict=True):
            top -= head
            for column, cell in enumerate(row):
                left, size = share * column + margins[column], share - margins[column] - _EDGE
                low = top - _PLOT
                for axes, tall in ((cell.plot, _PLOT), (cell.strip, _STRIP)):
                    box = (left / width, low / height, size / width, tall / height)
                    axes.set_position(box)
                    low = low - _BETWEEN - _STRIP
            top -= _PLOT + _BETWEEN + _STRIP + _TICKS
        figure.draw_without_rendering()
        for column in range(columns):
            # The y labels stand in line, left of the widest tick label.
            every = [a for c in cells[column::columns] for a in (c.plot, c.strip)]
            wide = [t.get_window_extent().width for a in every for t in a.get_yticklabels()]
            ticks = max(wide) / figure.dpi
            names = max(a.yaxis.label.get_window_extent().width for a in every) / figure.dpi
            size = share - margins[column] - _EDGE
            for axes in every:
                axes.yaxis.set_label_coords(-(ticks + _TICK_GAP) / size, 0.5)
            margins[column] = _EDGE + names + ticks + _TICK_GAP
    x, y = _EDGE / width, 1.0 - _ABOVE / height
    figure.suptitle(title, x=x, y=y, ha="left", va="top", fontweight="bold")
