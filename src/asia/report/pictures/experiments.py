"""Pictures of the experiments of a search: trade-offs, times, lineage."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final, Literal

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.ticker import MaxNLocator

from asia.report.drawing.places import time_unit
from asia.report.drawing.style import (
    BLUE,
    FAINT,
    ORANGE,
    QUIET,
    RED,
    figure_legend,
    label_decades,
    picture_width,
    plain,
    quiet_grid,
)
from asia.report.pictures.progress import NamedPoint, log_values, name_points

# V against a cost of a model.


@dataclass(frozen=True)
class Traded:
    """An experiment in a picture of V against a cost."""

    number: int
    title: str
    value: float
    """V."""
    cost: float


def front_of(points: Sequence[Traded]) -> list[Traded]:
    """Return the points that no other one beats in V and in cost, the cheapest first."""
    found: list[Traded] = []
    for point in sorted(points, key=lambda p: (p.cost, p.value)):
        if not found or point.value < found[-1].value:
            found.append(point)
    return found


def draw_tradeoff(points: Sequence[Traded], axis: str, below: str) -> Figure:
    """Draw V against a cost on logarithmic axes, with the front that nothing dominates.

    Args:
        points: the experiments, all with a positive cost.
        axis: name of V.
        below: name of the cost, with its unit.
    """
    front = front_of(points)
    figure = Figure(figsize=(picture_width(), 3.9), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    low = max(front[-1].value, 1e-12)
    # Results far above the front are drawn at the upper edge.
    high = max(low, min(max(p.value for p in points), 20 * low))
    log_values(axes, low, high)
    axes.set_xscale("log")
    axes.set_xlim(min(p.cost for p in points) / 1.3, max(p.cost for p in points) * 1.3)
    label_decades(axes.xaxis)
    axes.set_xlabel(below)
    axes.set_ylabel(plain(axis, 40))
    quiet_grid(axes)
    top = axes.get_ylim()[1]
    x, y = [p.cost for p in front], [p.value for p in front]
    marks: dict[str, Any] = {"marker": "o", "ms": 6.0, "markevery": list(range(len(x)))}
    axes.step([*x, axes.get_xlim()[1]], [*y, y[-1]], where="post", color=BLUE, lw=1.6, zorder=5,
              label="no other candidate has less of both", gid="front", **marks)  # fmt: skip
    others = [p for p in points if p not in front]
    for chosen, marker, label in (
        ([p for p in others if p.value <= top], "o", "others"),
        ([p for p in others if p.value > top], "^", "V above the axis"),
    ):
        if chosen:
            axes.plot([p.cost for p in chosen], [min(p.value, top) for p in chosen], marker,
                      mfc="white", mec=QUIET, ms=5.0, zorder=4, clip_on=False, label=label,
                      gid="others")  # fmt: skip
    figure_legend(figure, axes.get_legend_handles_labels()[0], 3)
    canvas.draw()
    figure.set_layout_engine("none")
    named = [NamedPoint(p.cost, p.value, p.title) for p in (front[-1:] + front[:-1])]
    name_points(axes, canvas, named, [(p.cost, p.value) for p in points])
    return figure


# Evaluations over time.


_LONGEST_GAP = 0.1
"""Share of the time of all evaluations; longer gaps between them are cut to it."""

Kind = Literal["kept", "other", "failed", "running"]
_KINDS: Final = {
    "kept": (BLUE, "new best"),
    "other": (FAINT, "no new best"),
    "failed": (RED, "no score"),
    "running": (ORANGE, "being evaluated"),
}


@dataclass(frozen=True)
class Span:
    """Evaluation of an experiment from begin to end, in seconds."""

    number: int
    kind: Kind
    begin: float
    end: float


def without_pauses(spans: Sequence[Span]) -> list[Span]:
    """Return the spans in the order of their begin, on a time axis from 0 on whose long gaps are
    cut."""
    ordered = sorted(spans, key=lambda one: (one.begin, one.number))
    edges: list[tuple[float, float]] = []
    for one in ordered:
        if edges and one.begin <= edges[-1][1]:
            edges[-1] = edges[-1][0], max(edges[-1][1], one.end)
        else:
            edges.append((one.begin, one.end))
    most = _LONGEST_GAP * sum(end - begin for begin, end in edges)
    cut, shifts = edges[0][0], [edges[0][0]]
    for (_, end), (begin, _) in pairwise(edges):
        cut += max(0.0, begin - end - most)
        shifts.append(cut)
    starts = [begin for begin, _ in edges]
    moved: list[Span] = []
    for one in ordered:
        shift = shifts[bisect_right(starts, one.begin) - 1]
        moved.append(replace(one, begin=one.begin - shift, end=one.end - shift))
    return moved


def draw_timeline(spans: Sequence[Span]) -> Figure:
    """Draw a bar for each evaluation, those at the same time in rows of their own. spans: at least
    one."""
    moved = without_pauses(spans)
    free: list[float] = []
    rows: list[int] = []
    for one in moved:
        row = next((k for k, end in enumerate(free) if end <= one.begin), len(free))
        free[row : row + 1] = [one.end]
        rows.append(row)
    unit = time_unit(max(free) or 1.0)
    figure = Figure(figsize=(picture_width(), 1.0 + 0.18 * len(free)), layout="constrained")
    axes = figure.add_subplot()
    shortest = 1e-3 * (max(free) or 1.0)
    for kind, (colour, label) in _KINDS.items():
        each = [(one, row) for one, row in zip(moved, rows, strict=True) if one.kind == kind]
        if each:
            axes.barh(
                [row + 1 for _, row in each],
                [max(one.end - one.begin, shortest) / unit.seconds for one, _ in each],
                left=[one.begin / unit.seconds for one, _ in each],
                height=0.75, color=colour, edgecolor="white", lw=0.4, label=label,
            )  # fmt: skip
            for bar, (one, _) in zip(axes.patches[-len(each) :], each, strict=True):
                bar.set_gid(f"bar {kind} experiment-{one.number}")
    axes.set_ylim(len(free) + 0.6, 0.4)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axes.set_xlabel(f"time [{unit.name}]")
    axes.grid(visible=True, axis="x")
    figure_legend(figure, axes.get_legend_handles_labels()[0], 4)
    return figure


# The lineage as lanes next to a list of experiments.


ROW: Final = 34
"""Height of a row of the list in pixels, as in page.css."""
_LANE = 16
_MOST_LANES = 9
_PIXELS = 96
"""Pixels of an inch."""


@dataclass(frozen=True)
class LineageRow:
    """One experiment of the list; winning: the best one or one of its ancestors."""

    number: int
    parent: int | None
    status: str
    winning: bool


def lanes(rows: Sequence[LineageRow]) -> dict[int, int]:
    """Return the lane of each experiment, 0 for that of the best one. A child takes the lane of its
    parent if no other experiment uses it from the parent on, else the next free one.
    """
    last = {row.parent: i for i, row in enumerate(rows) if row.parent is not None}
    found: dict[int, int] = {}
    until: dict[int, int] = {0: len(rows)}
    continued: set[int] = set()
    for i, row in enumerate(rows):
        if row.winning:
            found[row.number] = 0
            continue
        lane = found.get(row.parent or 0)
        if lane is None or lane == 0 or row.parent in continued:
            lane = next((k for k in range(1, _MOST_LANES) if until.get(k, -1) < i), _MOST_LANES)
        elif row.parent is not None:
            continued.add(row.parent)
        found[row.number] = lane
        until[lane] = max(until.get(lane, -1), last.get(row.number, i))
    return found


def lineage_width(rows: Sequence[LineageRow]) -> int:
    """Return the width of `draw_lineage` in pixels."""
    return (max(lanes(rows).values(), default=0) + 1) * _LANE + 8


def draw_lineage(rows: Sequence[LineageRow]) -> Figure:
    """Draw a dot for each row of the list, joined to its parent, as high as the list."""
    at = lanes(rows)
    width, height = lineage_width(rows), ROW * len(rows)
    figure = Figure(figsize=(width / _PIXELS, height / _PIXELS))
    figure.patch.set_alpha(0.0)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0, width), ylim=(height, 0))
    axes.set_axis_off()
    places = {
        row.number: (10.0 + at[row.number] * _LANE, ROW * i + ROW / 2) for i, row in enumerate(rows)
    }
    for winning, colour, line in ((False, FAINT, 1.1), (True, BLUE, 2.2)):
        edges = [
            _edge(places[row.parent], places[row.number])
            for row in rows
            if row.winning == winning and row.parent is not None and row.parent in places
        ]
        if edges:
            path = Path.make_compound_path(*edges)
            axes.add_patch(PathPatch(path, fill=False, ec=colour, lw=line))
    scored = "discard", "inconclusive", "mixed", "unconfirmed", "running", "unfinished"
    kinds = {
        row.number: "kept"
        if row.status == "keep"
        else "other"
        if row.status in scored
        else "failed"
        for row in rows
    }
    styles: dict[str, dict[str, Any]] = {
        "kept": {"marker": "o", "mfc": BLUE, "mec": "white", "ms": 8.0},
        "other": {"marker": "o", "mfc": "white", "mec": QUIET, "ms": 7.0},
        "failed": {"marker": "x", "mec": RED, "mew": 1.4, "ms": 6.0},
    }
    for kind, style in styles.items():
        chosen = [places[number] for number, one in kinds.items() if one == kind]
        if chosen:
            x, y = zip(*chosen, strict=True)
            axes.plot(x, y, ls="", zorder=3, **style)
    return figure


def _edge(parent: tuple[float, float], child: tuple[float, float]) -> Path:
    """Down the lane of the parent, then over: another dot of the child's lane is no parent."""
    (x0, y0), (x1, y1) = parent, child
    if x0 == x1:
        return Path([(x0, y0), (x1, y1)])
    turn = y1 - ROW
    corners = [(x0, y0), (x0, turn), (x0, turn + 20), (x1, turn + 14), (x1, y1)]
    return Path(corners, [Path.MOVETO, Path.LINETO, Path.CURVE4, Path.CURVE4, Path.CURVE4])
