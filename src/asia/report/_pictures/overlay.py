"""Measured against simulated outputs, the error in a strip below."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from asia.data import Array, Signal
from asia.report._drawing.layout import PlotWithStrip, arrange
from asia.report._drawing.style import (
    BLUE,
    FAINT,
    INK,
    ORANGE,
    QUIET,
    SHADE,
    axis_label,
    figure_legend,
    headline,
    picture_width,
    plain,
    quiet_grid,
)
from asia.report._drawing.time import Stretch, TimeAxis, last_sample, lay_out, time_unit

MOST_PANELS = 8
_SINGLE_COLUMN = 3
_MANY_SAMPLES = 20_000
_BAND = 0.2


@dataclass(frozen=True)
class Piece:
    """One segment of a record.

    Attributes:
        measured, simulated: outputs (H,).
        other: a second simulation (H,).
        start: index of its first sample in the record.
        skip: number of first samples that do not count.
        band: lower and upper edges (H,) of the output bands.
    """

    name: str
    start: int
    measured: Array
    simulated: Array
    other: Array | None = None
    skip: int = 0
    band: tuple[Array, Array] | None = None


@dataclass(frozen=True)
class Heading:
    """Title of a panel: what it shows, and its error in words."""

    what: str
    error: str

    def lines(self, width: int) -> str:
        """Return the text, on one line if `width` characters hold it."""
        line = f"{self.what}:  {self.error}"
        return line if len(line) <= width else f"{self.what}\n{self.error}"


@dataclass(frozen=True)
class Panel:
    """One output over one or several segments."""

    heading: Heading
    signal: Signal
    pieces: tuple[Piece, ...]


@dataclass(frozen=True)
class Words:
    """Title of the picture, names of the curves and of the bands, and what the pieces of a panel
    are."""

    title: str
    simulated: str
    other: str = ""
    pieces: str = "records"
    band: str = ""


def draw_overlay(panels: Sequence[Panel], sampling_time: float, words: Words) -> Figure:
    """A panel each, in two columns when there are many. sampling_time in seconds."""
    columns = 1 if len(panels) <= _SINGLE_COLUMN else 2
    width = picture_width() if columns == 1 else 1.45 * picture_width()
    figure = Figure()
    cells: list[PlotWithStrip] = []
    for index, (panel, axis) in enumerate(
        zip(panels, _time_axes(panels, sampling_time, words.pieces), strict=True)
    ):
        plot = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        strip = figure.add_axes((0.0, 0.0, 1.0, 1.0), sharex=plot)
        _curves(plot, panel, axis, 90 if columns == 1 else 72)
        _errors(strip, panel, axis)
        title = panel.heading.lines(80 if columns == 1 else 56)
        plot.set_title(title)
        plot.tick_params(axis="x", labelbottom=False, length=0)
        if index >= len(panels) - columns:
            strip.set_xlabel(axis.label)
        cells.append(PlotWithStrip(plot, strip, title.count("\n") + 1))
    _legend(figure, panels, words)
    arrange(figure, cells, columns, width, headline(words.title, width))
    return figure


def _time_axes(panels: Sequence[Panel], sampling_time: float, pieces: str) -> list[TimeAxis]:
    segments = [[Stretch(p.start, len(p.measured)) for p in panel.pieces] for panel in panels]
    unit = time_unit(sampling_time * max(last_sample(s) for s in segments))
    return [lay_out(s, sampling_time, unit, pieces) for s in segments]


def _curves(axes: Axes, panel: Panel, axis: TimeAxis, characters: int) -> None:
    raster = sum(len(p.measured) for p in panel.pieces) > _MANY_SAMPLES
    for piece, time in zip(panel.pieces, axis.times, strict=True):
        if piece.band is not None:
            axes.fill_between(time, *piece.band, color=BLUE, alpha=_BAND, lw=0, rasterized=raster)
        axes.plot(time, piece.measured, color=FAINT, lw=2.6, rasterized=raster)
        if piece.other is not None:
            axes.plot(time, piece.other, color=ORANGE, lw=0.9, dashes=(4, 1.5), rasterized=raster)
        axes.plot(time, piece.simulated, color=BLUE, lw=1.1, rasterized=raster)
    axes.set_ylabel(axis_label(panel.signal))
    _dress(axes, panel, axis)
    if len(panel.pieces) > 1:
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + 0.15 * (high - low))
        for piece, time in zip(panel.pieces, axis.times, strict=True):
            _name_piece(axes, piece.name, time, characters // len(panel.pieces))


def _name_piece(axes: Axes, name: str, time: Array, room: int) -> None:
    axes.annotate(
        plain(name, max(room, 4)),
        xy=(float(time[0]), 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(2.0, -1.0),
        textcoords="offset points",
        va="top",
        fontsize=7.0,
        color=QUIET,
    )


def _errors(axes: Axes, panel: Panel, axis: TimeAxis) -> None:
    raster = sum(len(p.measured) for p in panel.pieces) > _MANY_SAMPLES
    axes.axhline(0.0, color=QUIET, lw=0.7)
    for piece, time in zip(panel.pieces, axis.times, strict=True):
        if piece.other is not None:
            error = piece.measured - piece.other
            axes.plot(time, error, color=ORANGE, lw=0.7, dashes=(4, 1.5), rasterized=raster)
        if piece.band is not None:
            low, high = (edge - piece.simulated for edge in piece.band)
            axes.fill_between(time, low, high, color=BLUE, alpha=_BAND, lw=0, rasterized=raster)
        axes.plot(time, piece.measured - piece.simulated, color=BLUE, lw=0.9, rasterized=raster)
    unit = plain(panel.signal.unit, 8)
    axes.set_ylabel(f"error\n[{unit}]" if unit else "error", fontsize=7.5)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=3, symmetric=True))
    _dress(axes, panel, axis)


def _dress(axes: Axes, panel: Panel, axis: TimeAxis) -> None:
    quiet_grid(axes)
    axes.set_xlim(*axis.limits)
    for seam in axis.seams:
        axes.axvline(seam, color=QUIET, lw=0.8, dashes=(2, 2))
    for piece, time in zip(panel.pieces, axis.times, strict=True):
        if piece.skip > 0:
            axes.axvspan(time[0], time[min(piece.skip, len(time) - 1)], color=SHADE, lw=0, zorder=0)


def _legend(figure: Figure, panels: Sequence[Panel], words: Words) -> None:
    pieces = [piece for panel in panels for piece in panel.pieces]
    axes = figure.axes[0]
    handles = [
        axes.plot([], [], color=FAINT, lw=2.6, label="measured")[0],
        axes.plot([], [], color=BLUE, lw=1.1, label=words.simulated)[0],
    ]
    if any(p.other is not None for p in pieces):
        handles += axes.plot([], [], color=ORANGE, lw=0.9, dashes=(4, 1.5), label=words.other)
    shaded: list[Artist] = []
    if any(p.band is not None for p in pieces):
        shaded += axes.fill([np.nan], [np.nan], color=BLUE, alpha=_BAND, lw=0, label=words.band)
    if any(p.skip for p in pieces):
        shaded += axes.fill([np.nan], [np.nan], color=SHADE, label="left out of the error")
    columns = 3 if len(handles) + len(shaded) > 4 else 4
    figure_legend(
        figure, [*handles, *shaded], columns, loc="lower center", borderaxespad=0.3, labelcolor=INK
    )
