"""Several searches on one problem: V against experiments, each side of the comparison a colour."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from asia.report._comparison import ArmCurves, ArmsPicture, ComparedValue
from asia.report._drawing.style import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    QUIET,
    entitle,
    figure_legend,
    number,
    picture_width,
    plain,
    quiet_grid,
    v_axis_label,
)
from asia.report._pictures.progress import log_values

_HEIGHT = 4.2
_LOG_FROM = 6.0
_COLOURS: Final = (BLUE, ORANGE, GREEN, QUIET)
_DASHES = ((5.0, 2.5), (1.2, 1.8), (7.0, 2.0, 1.2, 2.0), (2.5, 1.5))


def draw_arms(picture: ArmsPicture) -> Figure:
    """A point each experiment, best so far as a step line: thin for each seed, thick for their
    median, between the lowest and the highest. Points far above are clipped to triangles on the
    edge."""
    sides, levels = picture.sides, picture.levels
    figure = Figure(figsize=(picture_width(), _HEIGHT), layout="constrained")
    axes = figure.add_subplot()
    length = max((len(c.values) for s in sides for c in s.curves), default=1)
    _scale(axes, sides, levels, length)
    for index, side in enumerate(sides):
        shift = 0.12 * (index - (len(sides) - 1) / 2)
        _side(axes, side, _COLOURS[index % len(_COLOURS)], length, shift)
    for index, level in enumerate(levels):
        _level(axes, level, _DASHES[index % len(_DASHES)])
    axes.set_xlabel("Experiment")
    axes.set_ylabel(v_axis_label(picture.metric))
    entitle(figure, picture.title)
    handles = axes.get_legend_handles_labels()[0]
    figure_legend(figure, handles, 2, fontsize=7.5, handletextpad=0.6)
    return figure


def _scale(
    axes: Axes, sides: Sequence[ArmCurves], levels: Sequence[ComparedValue], length: int
) -> None:
    steps = [c.best_so_far(length) for s in sides for c in s.curves]
    values = np.concatenate([*steps, np.array([level.value for level in levels])])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    axes.set_xlim(0.4, length + 0.6)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=16, min_n_ticks=1))
    if high > _LOG_FROM * low > 0:
        log_values(axes, low, high)
    else:
        axes.set_ylim(0.0, high * 1.15)
    quiet_grid(axes)


def _side(axes: Axes, side: ArmCurves, colour: str, length: int, shift: float) -> None:
    top = axes.get_ylim()[1]
    at = np.arange(1, length + 1)
    for curve in side.curves:
        points = [(n, v) for n, v in enumerate(curve.values, start=1) if v is not None]
        for inside, marker in ((True, "o"), (False, "^")):
            chosen = [(n, v) for n, v in points if (v <= top) == inside]
            if not chosen:  # nothing, unclipped, would take up room at the figure's corner
                continue
            axes.plot(
                [n + shift for n, _ in chosen],
                [min(v, top) for _, v in chosen],
                marker,
                mfc="white",
                mec=colour,
                ms=3.8,
                mew=0.9,
                alpha=0.8,
                clip_on=inside,
                zorder=3,
            )
    best = np.array([c.best_so_far(length) for c in side.curves]).reshape(-1, length)
    shown = np.isfinite(best).all(axis=0)
    if not shown.any():
        return
    several = len(best) > 1
    if several:
        low, high = best[:, shown].min(axis=0), best[:, shown].max(axis=0)
        axes.fill_between(at[shown], low, high, step="post", color=colour, alpha=0.13, lw=0)
        for one in best:
            axes.step(at, one, where="post", color=colour, lw=0.6, alpha=0.7, zorder=4)
    middle = np.median(best[:, shown], axis=0)
    label = f"{plain(side.label, 44)}: {number(float(middle[-1]))}"
    label += f", median of {len(best)} seeds" if several else ""
    ends = np.append(at[shown], length + 0.4), np.append(middle, middle[-1])
    axes.step(*ends, where="post", color=colour, lw=2.0, zorder=5, label=label)


def _level(axes: Axes, level: ComparedValue, dashes: tuple[float, ...]) -> None:
    label = f"{plain(level.label, 44)}: {number(level.value)}"
    axes.axhline(level.value, color=INK, lw=0.9, dashes=dashes, zorder=2, label=label)
