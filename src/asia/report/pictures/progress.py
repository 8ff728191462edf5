"""Pictures of a search: V against experiments, of one search or several."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from matplotlib.transforms import blended_transform_factory
from scipy.optimize import isotonic_regression

from asia.judge.scoring.outcome import Score
from asia.ledger.run import Control
from asia.ledger.view import Experiment, SearchView
from asia.report.comparison import ArmCurves, ArmsPicture, ComparedValue
from asia.report.drawing.places import Box, Tag, place
from asia.report.drawing.style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    QUIET,
    RED,
    entitle,
    figure_legend,
    number,
    picture_width,
    plain,
    quiet_grid,
    v_axis_label,
)

# V against experiment number: the picture of a search.


_HEIGHT = 4.3
_LOG_FROM = 6.0
_OFF_SCALE = 4.0
_MOST_TAGS = 12
_TAG_FONT = 7.5
_DASHES = ((5.0, 2.5), (1.2, 1.8), (7.0, 2.0, 1.2, 2.0), (2.5, 1.5))
_REFERENCE_NAMES = {"simulated truth": "noise floor (truth)"}


@dataclass(frozen=True)
class _Point:
    number: int
    value: float
    title: str


@dataclass(frozen=True)
class _Points:
    """Points to draw: kept, discarded and off-scale experiments, those on the guard records,
    numbers of the failed ones, reference models as (name, V), and the number of experiments.
    """

    kept: tuple[_Point, ...]
    discarded: tuple[_Point, ...]
    beyond: tuple[_Point, ...]
    guard: tuple[_Point, ...]
    failed: tuple[int, ...]
    rungs: tuple[tuple[str, float], ...]
    count: int

    @property
    def values(self) -> tuple[float, ...]:
        points = (*self.kept, *self.discarded, *self.guard)
        return (*(p.value for p in points), *(v for _, v in self.rungs))

    @property
    def log(self) -> bool:
        return bool(self.values) and max(self.values) > _LOG_FROM * min(self.values) > 0


def draw_progress(view: SearchView, metric: str, beside: Control | None = None) -> Figure:
    """Draw the progress of a search.

    A point for each experiment, the incumbent as a step line, failures as crosses on the upper
    edge, the last evaluation on the guard records as diamonds, tags at improvements, reference
    models and the control run as thin lines.

    Args:
        view: the search.
        metric: name of the metric.
        beside: the control run.
    """
    search = _gather(view, beside)
    width = picture_width()
    figure = Figure(figsize=(width, min(_HEIGHT, width)), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    _scale(axes, search, metric)
    _entitle(axes, _title(view))
    _mark(axes, search)
    _hand_overs(axes, view)
    labels = [_reference(axes, i, name, value) for i, (name, value) in enumerate(search.rungs)]
    handles = axes.get_legend_handles_labels()[0]
    figure_legend(figure, handles, 4, handletextpad=0.5, columnspacing=2.2)
    canvas.draw()
    figure.set_layout_engine("none")
    _spread(labels, figure.dpi)
    if search.kept:
        _tag(axes, canvas, search)
    return figure


def _gather(view: SearchView, beside: Control | None) -> _Points:
    references = tuple(
        (_REFERENCE_NAMES.get(r.name, plain(r.name, 24)), r.outcome.value)
        for r in view.rungs
        if isinstance(r.outcome, Score)
    )
    if beside is not None and beside.value is not None:
        references = (*references, ("expert, same budget", beside.value))
    scored = [(e, e.score.value) for e in view.finished if e.score]
    bests = {e.number for e in view.bests}
    kept = tuple(_point(e, v) for e, v in scored if e.number in bests)
    others = [_point(e, v) for e, v in scored if e.number not in bests]
    guard = _guarded(view)
    usual = [v for _, v in references] + [p.value for p in kept]
    ceiling = _OFF_SCALE * max(usual, default=float("inf"))
    return _Points(
        kept,
        tuple(p for p in others if p.value <= ceiling),
        tuple(p for p in (*others, *guard) if p.value > ceiling),
        tuple(p for p in guard if p.value <= ceiling),
        tuple(e.number for e in view.finished if e.failure),
        references,
        max((e.number for e in view.finished), default=0),
    )


def _guarded(view: SearchView) -> list[_Point]:
    scores = view.looks[-1].scores if view.looks else ()
    return [
        _Point(s.experiment, s.outcome.value, "guard")
        for s in scores
        if isinstance(s.outcome, Score)
    ]


def _point(e: Experiment, value: float) -> _Point:
    return _Point(e.number, value, e.proposed.title)


def _entitle(axes: Axes, title: str) -> None:
    if (width := picture_width()) < _HEIGHT:
        title = "\n".join(textwrap.fill(line, int(11 * width)) for line in title.splitlines())
        axes.set_title(title, fontweight="bold", fontsize=8.0, pad=8.0)
    else:
        axes.set_title(title, fontweight="bold", fontsize=9.5, pad=11.0)


def _title(view: SearchView) -> str:
    start, best = view.started, view.best
    head = f"{plain(start.problem, 28)}, agent {plain(start.agent, 28)}, seed {start.seed}"
    if best is None or best.score is None:
        return f"{head}: no model yet"
    total = len(view.finished)
    link = ": " if view.v_name == "V" else "\n"
    value = f"{view.v_name} = {number(best.score.value)}"
    use = view.refitted.use if view.refitted else None
    named = f"\nmodel to use: {use}" if use else ""
    return f"{head}{link}best {value} (experiment {best.number} of {total}){named}"


def _scale(axes: Axes, search: _Points, metric: str) -> None:
    axes.set_xlabel("Experiment")
    axes.set_ylabel(v_axis_label(metric))
    axes.set_xlim(0.4, max(search.count, 1) + 0.6)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=16, min_n_ticks=1))
    low, high = min(search.values, default=0.0), max(search.values, default=1.0)
    if search.log:
        log_values(axes, low, high)
    else:
        axes.set_ylim(0.0, high * 1.12 if high > 0 else 1.0)
    quiet_grid(axes)


def log_values(axes: Axes, low: float, high: float) -> None:
    """A log scale of V from below `low` to above `high`, with plain numbers."""
    axes.set_yscale("log")
    axes.set_ylim(low / 1.6, high * 1.35)
    steps = (1.0, 2.0, 5.0) if high / low < 300.0 else (1.0,)
    axes.yaxis.set_major_locator(LogLocator(subs=steps))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axes.yaxis.set_minor_locator(NullLocator())


def _mark(axes: Axes, search: _Points) -> None:
    edge = blended_transform_factory(axes.transData, axes.transAxes)
    if search.kept:
        x, y = [p.number for p in search.kept], [p.value for p in search.kept]
        ends = [*x, search.count], [*y, y[-1]]
        axes.step(
            *ends,
            where="post",
            color=BLUE,
            lw=1.6,
            marker="o",
            ms=6.0,
            zorder=5,
            markevery=list(range(len(x))),
            label="best so far",
        )
    if search.discarded:
        x, y = [p.number for p in search.discarded], [p.value for p in search.discarded]
        axes.plot(x, y, "o", mfc="white", mec=QUIET, ms=5.0, zorder=4, label="not kept")
    if search.guard:
        x, y = [p.number for p in search.guard], [p.value for p in search.guard]
        axes.plot(
            x, y, "D", mfc="white", mec=GREEN, mew=1.4, ms=5.0, zorder=6, label="guard records"
        )
    for numbers, marker, colour, label in (
        ([p.number for p in search.beyond], "^", QUIET, "off scale"),
        (search.failed, "x", RED, "failed, no score"),
    ):
        if numbers:
            axes.plot(
                numbers,
                [1.0] * len(numbers),
                marker=marker,
                mfc="white",
                mec=colour,
                mew=1.6,
                ms=6.0,
                ls="",
                transform=edge,
                clip_on=False,
                zorder=6,
                label=label,
            )


def _hand_overs(axes: Axes, view: SearchView) -> None:
    """Draw a line at each change of the agent in a relay, with the names of the agents between the
    lines.
    """
    legs = view.started.legs
    if not legs:
        return
    ends = [0.5, *(event.after + 0.5 for event in view.handed_over), axes.get_xlim()[1]]
    edge = blended_transform_factory(axes.transData, axes.transAxes)
    for x in ends[1:-1]:
        axes.axvline(x, color=INK, lw=0.9, ls=(0, (4.0, 3.0)), zorder=3)
    for leg, (start, end) in zip(legs, pairwise(ends), strict=False):
        if end > start:
            axes.text(
                (start + end) / 2,
                0.015,
                plain(leg.agent, 16),
                transform=edge,
                ha="center",
                va="bottom",
                fontsize=_TAG_FONT,
                color=INK,
            )


def _reference(axes: Axes, index: int, name: str, value: float) -> Text:
    dashes = _DASHES[index % len(_DASHES)]
    axes.axhline(value, color=QUIET, lw=0.8, dashes=dashes, zorder=2)
    return axes.annotate(
        f"{name} {number(value)}",
        xy=(1.0, value),
        xycoords=("axes fraction", "data"),
        xytext=(9.0, 0.0),
        textcoords="offset points",
        va="center",
        fontsize=_TAG_FONT,
        color=INK,
        arrowprops={"arrowstyle": "-", "color": FAINT, "lw": 0.6, "shrinkA": 1, "shrinkB": 0},
        annotation_clip=False,
    )


def _spread(labels: Sequence[Text], dpi: float) -> None:
    """Move labels up and down until no two overlap, as little as possible (least squares)."""
    if len(labels) < 2:
        return
    boxes = [label.get_window_extent() for label in labels]
    middle = np.array([(b.y0 + b.y1) / 2 for b in boxes])
    order = np.argsort(middle, kind="stable")
    steps = np.arange(len(labels)) * max(b.height for b in boxes) * 1.15
    moved = isotonic_regression(middle[order] - steps).x + steps
    points = 72.0 / dpi
    for index, y in zip(order, moved, strict=True):
        labels[index].set_position((9.0, float(y - middle[index]) * points))


def _tag(axes: Axes, canvas: FigureCanvasAgg, search: _Points) -> None:
    chosen = _most_telling(search.kept)
    texts = [_balanced(plain(p.title, 66), 26) for p in chosen]
    weights = ["bold" if p is search.kept[-1] else "normal" for p in chosen]
    # Places are found in units of a page's picture, whose letters are 11 high, and y goes down.
    unit = canvas.figure.dpi / 72.0 * _TAG_FONT / 11.0

    def position(point: _Point) -> tuple[float, float]:
        x, y = axes.transData.transform((point.number, point.value)) / unit
        return float(x), -float(y)

    tags: list[Tag] = []
    for point, text, weight in zip(chosen, texts, weights, strict=True):
        box = Text(0, 0, text, fontsize=_TAG_FONT, fontweight=weight, figure=canvas.figure)
        extent = box.get_window_extent(canvas.get_renderer())
        tags.append(Tag(position(point), (extent.width / unit + 4.0, extent.height / unit + 4.0)))
    shown = [position(p) for p in (*search.kept, *search.discarded, *search.guard)]
    edge = axes.get_window_extent()
    frame = Box(edge.x0 / unit, -edge.y1 / unit, edge.x1 / unit, -edge.y0 / unit)
    points = _TAG_FONT / 11.0
    for point, text, weight, tag, found in zip(
        chosen, texts, weights, tags, place(tags, shown, frame), strict=True
    ):
        if found is None:
            continue
        x, y = tag.anchor
        axes.annotate(
            text,
            xy=(point.number, point.value),
            xytext=((found.left + 2.0 - x) * points, (y - found.bottom + 2.0) * points),
            textcoords="offset points",
            ha="left",
            va="bottom",
            fontsize=_TAG_FONT,
            fontweight=weight,
            bbox={"boxstyle": "square,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.85},
            arrowprops={"arrowstyle": "-", "color": QUIET, "lw": 0.7, "shrinkA": 0, "shrinkB": 3.5},
            zorder=7,
        )


def _balanced(text: str, width: int) -> str:
    """`text` on as few lines of at most `width` characters as it needs, about equally long."""
    wrapped = [textwrap.wrap(text, w, break_on_hyphens=False) for w in range(width // 2, width + 1)]
    return "\n".join(next(lines for lines in wrapped if len(lines) <= len(wrapped[-1])))


def _most_telling(kept: Sequence[_Point]) -> list[_Point]:
    """The best model, the first one, then by how much each improved on the one before."""
    if len(kept) < 2:
        return list(kept)
    gains = {b.number: a.value - b.value for a, b in pairwise(kept)}
    middle = sorted(kept[1:-1], key=lambda p: -gains[p.number])
    return [kept[-1], kept[0], *middle][:_MOST_TAGS]


# Several searches on one problem: V against experiments, each side of the comparison a colour.


_COMPARISON_HEIGHT = 4.2
_COLOURS: Final = (BLUE, ORANGE, GREEN, QUIET)


def draw_arms(picture: ArmsPicture) -> Figure:
    """A point each experiment, best so far as a step line: thin for each seed, thick for their
    median, between the lowest and the highest. Points far above are clipped to triangles on the
    edge."""
    sides, levels = picture.sides, picture.levels
    figure = Figure(figsize=(picture_width(), _COMPARISON_HEIGHT), layout="constrained")
    axes = figure.add_subplot()
    length = max((len(c.values) for s in sides for c in s.curves), default=1)
    _comparison_scale(axes, sides, levels, length)
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


def _comparison_scale(
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
