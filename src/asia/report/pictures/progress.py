"""Pictures of a search: V against experiments, of one search or several."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from matplotlib.transforms import blended_transform_factory

from asia.agents.expert_result import ExpertResult
from asia.data.trajectory import Array
from asia.judge.scoring.outcome import Score
from asia.ledger.view import SearchView
from asia.report.drawing.places import Box, Tag, place
from asia.report.drawing.style import (
    BLUE,
    DASHES,
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


def draw_progress(view: SearchView, metric: str, beside: ExpertResult | None = None) -> Figure:
    """Draw the progress of a search.

    A point for each experiment, the incumbent as a step line, failures as crosses on the upper
    edge, the last evaluation on the guard records as diamonds, tags at improvements, reference
    models and the run of the expert as thin lines.

    Args:
        view: the search.
        metric: name of the metric.
        beside: result of the expert at the same budget.
    """
    references = [
        (_REFERENCE_NAMES.get(r.name, plain(r.name, 24)), r.outcome.value)
        for r in view.references
        if isinstance(r.outcome, Score)
    ]
    if beside is not None and beside.value is not None:
        references.append(("expert, same budget", beside.value))
    scored = [_Point(e.number, e.score.value, e.proposed.title) for e in view.finished if e.score]
    bests = {e.number for e in view.bests}
    kept = [p for p in scored if p.number in bests]
    others = [p for p in scored if p.number not in bests]
    guard = [
        _Point(s.experiment, s.outcome.value, "guard")
        for s in (view.looks[-1].scores if view.looks else ())
        if isinstance(s.outcome, Score)
    ]
    usual = [*(value for _, value in references), *(p.value for p in kept)]
    ceiling = _OFF_SCALE * max(usual, default=float("inf"))
    beyond = [p.number for p in (*others, *guard) if p.value > ceiling]
    discarded = [p for p in others if p.value <= ceiling]
    guard = [p for p in guard if p.value <= ceiling]
    failed = [e.number for e in view.finished if e.failure]
    points = (*kept, *discarded, *guard)
    count = max((e.number for e in view.finished), default=0)

    width = picture_width()
    figure = Figure(figsize=(width, min(_HEIGHT, width)), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    values = [*(p.value for p in points), *(value for _, value in references)]
    low, high = min(values, default=0.0), max(values, default=1.0)
    scale_experiments(axes, count, metric)
    if high > _LOG_FROM * low > 0:
        log_values(axes, low, high)
    else:
        axes.set_ylim(0.0, high * 1.12 if high > 0 else 1.0)
    quiet_grid(axes)
    title = _title(view)
    if width < _HEIGHT:
        title = "\n".join(textwrap.fill(line, int(11 * width)) for line in title.splitlines())
        axes.set_title(title, fontweight="bold", fontsize=8.0, pad=8.0)
    else:
        axes.set_title(title, fontweight="bold", fontsize=9.5, pad=11.0)
    if kept:
        x, y = [p.number for p in kept], [p.value for p in kept]
        marks: dict[str, Any] = {"marker": "o", "ms": 6.0, "markevery": list(range(len(x)))}
        ends = [*x, count], [*y, y[-1]]
        marks |= {"label": "best so far", "gid": "best"}
        axes.step(*ends, where="post", color=BLUE, lw=1.6, zorder=5, **marks)
    if discarded:
        x, y = [p.number for p in discarded], [p.value for p in discarded]
        axes.plot(
            x, y, "o", mfc="white", mec=QUIET, ms=5.0, zorder=4, label="not kept", gid="other"
        )
    if guard:
        x, y = [p.number for p in guard], [p.value for p in guard]
        marks = {"mfc": "white", "mec": GREEN, "mew": 1.4, "ms": 5.0}
        axes.plot(x, y, "D", zorder=6, label="guard records", **marks)
    edge = blended_transform_factory(axes.transData, axes.transAxes)
    for numbers, marker, colour, gid, label in (
        (beyond, "^", QUIET, "above", "off scale"),
        (failed, "x", RED, "failed", "failed, no score"),
    ):
        if numbers:
            marks = {"mfc": "white", "mec": colour, "mew": 1.6, "ms": 6.0, "clip_on": False}
            y = [1.0] * len(numbers)
            axes.plot(numbers, y, marker, transform=edge, zorder=6, label=label, gid=gid, **marks)
    labels = [_reference(axes, i, name, value) for i, (name, value) in enumerate(references)]
    handles = axes.get_legend_handles_labels()[0]
    figure_legend(figure, handles, 4, handletextpad=0.5, columnspacing=2.2)
    canvas.draw()
    figure.set_layout_engine("none")
    _spread(labels, figure.dpi)
    if kept:
        # The best model, the first one, then by how much each improved on the one before.
        gains = {b.number: a.value - b.value for a, b in pairwise(kept)}
        middle = sorted(kept[1:-1], key=lambda p: -gains[p.number])
        chosen = [kept[-1], *kept[:-1][:1], *middle]
        named = [NamedPoint(p.number, p.value, p.title) for p in chosen]
        name_points(axes, canvas, named, [(p.number, p.value) for p in points])
    return figure


def _title(view: SearchView) -> str:
    start, best = view.started, view.best
    head = f"{plain(start.problem, 28)}, agent {plain(start.agent, 28)}, seed {start.seed}"
    if best is None or best.score is None:
        return f"{head}: no model yet"
    link = ": " if view.v_name == "V" else "\n"
    value = f"{view.v_name} = {number(best.score.value)}"
    use = view.refitted.use if view.refitted else None
    named = f"\nmodel to use: {use}" if use else ""
    total = len(view.finished)
    return f"{head}{link}best {value} (experiment {best.number} of {total}){named}"


def scale_experiments(axes: Axes, count: int, metric: str) -> None:
    """The numbers of experiments, and the names of both axes."""
    axes.set_xlabel("Experiment")
    axes.set_ylabel(v_axis_label(metric))
    axes.set_xlim(0.4, max(count, 1) + 0.6)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=16, min_n_ticks=1))


def log_values(axes: Axes, low: float, high: float) -> None:
    """A log scale of V from below `low` to above `high`, with plain numbers."""
    axes.set_yscale("log")
    axes.set_ylim(low / 1.6, high * 1.35)
    steps = (1.0, 2.0, 5.0) if high / low < 300.0 else (1.0,)
    axes.yaxis.set_major_locator(LogLocator(subs=steps))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axes.yaxis.set_minor_locator(NullLocator())


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
    from scipy.optimize import isotonic_regression  # takes half a second to load

    boxes = [label.get_window_extent() for label in labels]
    middle = np.array([(b.y0 + b.y1) / 2 for b in boxes])
    order = np.argsort(middle, kind="stable")
    steps = np.arange(len(labels)) * max(b.height for b in boxes) * 1.15
    moved = isotonic_regression(middle[order] - steps).x + steps
    points = 72.0 / dpi
    for index, y in zip(order, moved, strict=True):
        labels[index].set_position((9.0, float(y - middle[index]) * points))


@dataclass(frozen=True)
class NamedPoint:
    """A point of a picture with the name that it receives."""

    x: float
    y: float
    name: str


def name_points(
    axes: Axes,
    canvas: FigureCanvasAgg,
    named: Sequence[NamedPoint],
    points: Sequence[tuple[float, float]],
) -> None:
    """Name some points, where there is room and no point is covered.

    Args:
        named: the most important one, in bold, first.
        points: all points.
    """
    named = named[:_MOST_TAGS]
    texts = [_balanced(plain(p.name, 66), 26) for p in named]
    weights = ["bold", *["normal"] * len(named)]
    # Places are found in units in which letters are 11 high, and y goes down.
    unit = canvas.figure.dpi / 72.0 * _TAG_FONT / 11.0

    def position(point: tuple[float, float]) -> tuple[float, float]:
        x, y = axes.transData.transform(point) / unit
        return float(x), -float(y)

    tags: list[Tag] = []
    for point, text, weight in zip(named, texts, weights, strict=False):
        box = Text(0, 0, text, fontsize=_TAG_FONT, fontweight=weight, figure=canvas.figure)
        extent = box.get_window_extent(canvas.get_renderer())
        size = extent.width / unit + 4.0, extent.height / unit + 4.0
        tags.append(Tag(position((point.x, point.y)), size))
    edge = axes.get_window_extent()
    frame = Box(edge.x0 / unit, -edge.y1 / unit, edge.x1 / unit, -edge.y0 / unit)
    places = place(tags, [position(p) for p in points], frame)
    scale = _TAG_FONT / 11.0
    for point, text, weight, tag, found in zip(named, texts, weights, tags, places, strict=False):
        if found is None:
            continue
        x, y = tag.anchor
        axes.annotate(
            text,
            xy=(point.x, point.y),
            xytext=((found.left + 2.0 - x) * scale, (y - found.bottom + 2.0) * scale),
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


# Several searches on one problem: V against experiments, each agent a colour.


_COLOURS: Final = (BLUE, ORANGE, GREEN, QUIET)

Curve = Sequence[float | None]
"""V of each experiment of one search, in order; None without a score."""


def draw_comparison(
    agents: Mapping[str, Sequence[Curve]], levels: Mapping[str, float], metric: str, title: str
) -> Figure:
    """A point each experiment, best so far as a step line: thin for each search of an agent, thick
    for their median, between the lowest and the highest. Points far above are clipped to triangles
    on the edge.

    Args:
        agents: searches of each agent, one for each seed.
        levels: V of models to compare with, by name.
        metric: `rmse` or `mae`.
    """
    figure = Figure(figsize=(picture_width(), 4.2), layout="constrained")
    axes = figure.add_subplot()
    length = max((len(curve) for curves in agents.values() for curve in curves), default=1)
    best = {
        name: np.array([_best_so_far(curve, length) for curve in curves]).reshape(-1, length)
        for name, curves in agents.items()
    }
    values = np.concatenate([*(found.ravel() for found in best.values()), [*levels.values()]])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    scale_experiments(axes, length, metric)
    if high > _LOG_FROM * low > 0:
        log_values(axes, low, high)
    else:
        axes.set_ylim(0.0, high * 1.15)
    quiet_grid(axes)
    for index, (name, curves) in enumerate(agents.items()):
        line = _COLOURS[index % len(_COLOURS)], DASHES[index // len(_COLOURS) % len(DASHES)]
        for curve in curves:
            _draw_points(axes, curve, line[0], 0.12 * (index - (len(agents) - 1) / 2))
        _draw_best(axes, best[name], line, name)
    for index, (name, value) in enumerate(levels.items()):
        label = f"{plain(name, 44)}: {number(value)}"
        dashes = _DASHES[index % len(_DASHES)]
        axes.axhline(value, color=INK, lw=0.9, dashes=dashes, zorder=2, label=label)
    entitle(figure, title)
    handles = axes.get_legend_handles_labels()[0]
    figure_legend(figure, handles, 2, fontsize=7.5, handletextpad=0.6)
    return figure


def _best_so_far(curve: Curve, length: int) -> Array:
    """(length,); NaN before the first score, the last value again after the end."""
    values = [np.nan if v is None else v for v in curve]
    return np.fmin.accumulate(np.array(values + [np.nan] * (length - len(values))))


def _draw_points(axes: Axes, curve: Curve, colour: str, shift: float) -> None:
    top = axes.get_ylim()[1]
    points = [(n, v) for n, v in enumerate(curve, start=1) if v is not None]
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


def _draw_best(axes: Axes, best: Array, line: tuple[str, str], name: str) -> None:
    """best: (searches, experiments); line: colour and dashes."""
    (colour, dashes), at = line, np.arange(1, best.shape[1] + 1)
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
    label = f"{plain(name, 44)}: {number(float(middle[-1]))}"
    label += f", median of {len(best)} seeds" if several else ""
    ends = np.append(at[shown], len(at) + 0.4), np.append(middle, middle[-1])
    axes.step(*ends, where="post", color=colour, ls=dashes, lw=2.0, zorder=5, label=label,
              gid="side")  # fmt: skip
