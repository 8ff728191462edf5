"""SVG drawings: records over time, V of experiments, lineage, checks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia._text import one_line
from asia.data.trajectory import Array
from asia.ledger.evidence import DrawnCheck, DrawnCurve
from asia.report.drawing.places import LINE, Box, Tag, place
from asia.report.page.html import Html, join, said, tag

# Scales from numbers to positions in a drawing.


@dataclass(frozen=True)
class Scale:
    """A linear or logarithmic axis."""

    low: float
    """The number at `start`."""
    high: float
    """The number at `end`."""
    start: float
    """Value at the start of the axis."""
    end: float
    """Value at the end of the axis."""
    log: bool = False
    """True for a logarithmic scale."""

    def at(self, value: float) -> float:
        """The place of a number, kept within the axis."""
        low, high, here = self.low, self.high, min(max(value, self.low), self.high)
        if self.log:
            low, high, here = math.log(low), math.log(high), math.log(here)
        share = (here - low) / (high - low) if high > low else 0.5
        return self.start + share * (self.end - self.start)

    def ticks(self, most: int = 6) -> list[float]:
        """Round numbers within the axis."""
        return _powers(self.low, self.high) if self.log else _steps(self.low, self.high, most)


def _steps(low: float, high: float, most: int) -> list[float]:
    span = high - low
    if not span > 0:
        return [low]
    rough = span / most
    unit = 10.0 ** math.floor(math.log10(rough))
    step = next(unit * k for k in (1, 2, 5, 10) if unit * k >= rough)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 12) + 0.0 for k in range(first, math.floor(high / step + 1e-9) + 1)]


def _powers(low: float, high: float) -> list[float]:
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for marks in ((1, 2, 5), (1, 3), (1,)):
        found = [m * 10.0**d for d in decades for m in marks if low <= m * 10.0**d <= high]
        if len(found) <= 7:
            break
    return found or [low, high]


def written(value: float) -> str:
    """A tick's number."""
    return f"{value:.6g}".replace("-", "−")


def rounded(value: float) -> str:
    """A coordinate."""
    return f"{value:.1f}".removesuffix(".0")


def thinned(values: Sequence[float], columns: int) -> list[tuple[int, float]]:
    """(index, value): all of a short record; of a long one the least and the greatest of each
    column."""
    count = len(values)
    if count <= 2 * columns:
        return list(enumerate(values))
    found: list[tuple[int, float]] = []
    for k in range(columns):
        first, last = k * count // columns, (k + 1) * count // columns
        part = range(first, last)
        ends = {min(part, key=values.__getitem__), max(part, key=values.__getitem__)}
        found += [(i, values[i]) for i in sorted(ends)]
    return found


# Drawing of V of every experiment, with the incumbent as a step line, tags at improvements, and
# the reference models.


_LOG_FROM = 6.0
_CHARACTER = 6.3
_MOST_TAGS = 14
# From so many experiments on, those that were not kept are drawn as one path.
_MANY = 400


@dataclass(frozen=True)
class Point:
    """One experiment."""

    number: int
    """1-based."""
    value: float | None
    """V; None where it has none."""
    status: str
    """Status of the experiment."""
    title: str
    """The candidate."""
    sources: str
    """Location of V in the ledger; "" without one."""
    shown: str
    """V as it is written; "" without one."""
    best: bool
    """True if it was the best so far."""


@dataclass(frozen=True)
class ReferenceLevel:
    """A trivial reference."""

    name: str
    """Name of the reference model."""
    value: float
    """Its V."""


@dataclass(frozen=True)
class Size:
    """A variant of the drawing."""

    width: float
    height: float
    right: float
    """Right margin, which holds the names of the reference models if they fit."""
    tag: int
    """Most characters of a tag."""


WIDE = Size(900, 380, 170, 30)
NARROW = Size(380, 340, 12, 3)


def draw_progress(
    points: Sequence[Point], levels: Sequence[ReferenceLevel], axis: str, alt: str, size: Size
) -> Html:
    """The drawing. axis: name of V; alt: the picture in words."""
    values = [p.value for p in points if p.value is not None] + [x.value for x in levels]
    across, up = _scales(points, values, levels, size)
    drawn = [draw_grid(across, up, size, axis), _levels(levels, across, up, size)]
    shown = points
    if len(points) > _MANY:
        shown = [p for p in points if p.best]
        drawn += _crowd([p for p in points if not p.best], across, up)
    drawn += [_progress_steps(points, across, up), *(_marker(p, across, up) for p in shown)]
    drawn.append(_tags(shown, across, up, size))
    box = f"0 0 {size.width:g} {size.height:g}"
    return tag("svg", *drawn, viewBox=box, role="img", aria_label=alt, class_="progress")


def _scales(
    points: Sequence[Point], values: Sequence[float], levels: Sequence[ReferenceLevel], size: Size
) -> tuple[Scale, Scale]:
    most = max((p.number for p in points), default=1)
    across = Scale(0.5, most + 0.5, 54, size.width - size.right)
    bottom, top = size.height - 40, 26.0
    bests = [p.value for p in points if p.value is not None and p.best]
    telling = [*bests, *(x.value for x in levels)] or [1.0]
    low, high = min([*values, *telling]), min(max([*values, *telling]), 1.6 * max(telling))
    log = high > _LOG_FROM * low > 0
    if log:
        return across, Scale(low / 1.35, high * 1.25, bottom, top, log=True)
    return across, Scale(0.0, high * 1.15 or 1.0, bottom, top)


def _label(x: float, y: float, words: str, anchor: str = "middle", name: str = "tick") -> Html:
    return tag("text", words, x=rounded(x), y=rounded(y), text_anchor=anchor, class_=name)


def draw_grid(across: Scale, up: Scale, size: Size, axis: str) -> Html:
    """Both axes with their numbers. axis: name of V."""
    parts: list[Html] = []
    for value in up.ticks():
        y = up.at(value)
        line = f"M{rounded(across.start)} {rounded(y)}H{rounded(across.end)}"
        parts.append(tag("path", d=line, class_="grid"))
        parts.append(_label(across.start - 8, y + 4, written(value), "end"))
    for value in across.ticks(8):
        if value == round(value) and value >= 1:
            parts.append(_label(across.at(value), up.start + 17, f"{value:g}"))
    parts.append(_label((across.start + across.end) / 2, size.height - 6, "experiment"))
    parts.append(_label(6, 14, axis, "start", "name"))
    return join(parts)


def _levels(levels: Sequence[ReferenceLevel], across: Scale, up: Scale, size: Size) -> Html:
    parts: list[Html] = []
    taken: list[float] = []
    beside = size.right > 100
    for level in sorted(levels, key=lambda one: -one.value):
        y = up.at(level.value)
        line = f"M{rounded(across.start)} {rounded(y)}H{rounded(across.end)}"
        parts.append(tag("path", d=line, class_="level"))
        place = y + 4 if beside else y - 4
        while any(abs(place - other) < LINE for other in taken):
            place += 1
        taken.append(place)
        x, anchor = (across.end + 8, "start") if beside else (across.end, "end")
        parts.append(_label(x, place, one_line(level.name, 26), anchor, "rung"))
    return join(parts)


def _progress_steps(points: Sequence[Point], across: Scale, up: Scale) -> Html | None:
    bests = [(p.number, p.value) for p in points if p.best and p.value is not None]
    return tag("path", d=step_path(bests, across, up, across.end), class_="best") if bests else None


def step_path(bests: Sequence[tuple[int, float]], across: Scale, up: Scale, end: float) -> str:
    """The best so far as a step line; bests: number and V of each; end: where it ends."""
    first, value = bests[0]
    path = f"M{rounded(across.at(first))} {rounded(up.at(value))}"
    for number, better in bests[1:]:
        path += f"H{rounded(across.at(number))}V{rounded(up.at(better))}"
    return f"{path}H{rounded(end)}"


def _crowd(points: Sequence[Point], across: Scale, up: Scale) -> list[Html]:
    """Many that were no new best: a dot for each score, a tick at the top for each failure."""
    dots = [(p.number, up.at(p.value)) for p in points if p.value is not None]
    ticks = [p.number for p in points if p.value is None]
    high = rounded(up.end - 10)
    return [
        tag(
            "path",
            d="".join(f"M{rounded(across.at(n))} {rounded(y)}h0" for n, y in dots),
            class_="crowd",
        ),
        tag(
            "path", d="".join(f"M{rounded(across.at(n))} {high}v7" for n in ticks), class_="failed"
        ),
    ]


def _marker(point: Point, across: Scale, up: Scale) -> Html:
    x = across.at(point.number)
    title = f"#{point.number:02d} {point.status}"
    if point.value is None:
        y = up.end - 6
        cross = f"M{rounded(x - 4)} {rounded(y - 4)}l8 8m0 -8l-8 8"
        text = tag("title", f"{title}: {one_line(point.title, 80)}")
        return tag("g", text, tag("path", d=cross, class_="failed"))
    y = up.at(point.value)
    text = tag("title", f"{title}, V {point.shown}: {one_line(point.title, 80)}")
    name = "kept" if point.best else "other"
    if point.value > up.high:
        mark = tag("path", d=f"M{rounded(x - 5)} {rounded(y + 4)}h10l-5 -9z", class_=name)
    else:
        mark = tag("circle", cx=rounded(x), cy=rounded(y), r="4.5", class_=name)
    return tag("g", text, mark)


def _tags(points: Sequence[Point], across: Scale, up: Scale, size: Size) -> Html:
    """Names at the improvements, where there is room: the last one first, then the largest."""
    scored = [(p, across.at(p.number), up.at(p.value)) for p in points if p.value is not None]
    bests = [one for one in scored if one[0].best]
    chosen = [*bests[-1:], *bests[:-1]][:_MOST_TAGS]
    texts = [f"#{point.number:02d}" for point, _, _ in chosen]
    if size.tag > 3:
        texts = [one_line(f"#{p.number:02d} {p.title}", size.tag) for p, _, _ in chosen]
    tags = [
        Tag((x, y), (len(text) * _CHARACTER, LINE))
        for text, (_, x, y) in zip(texts, chosen, strict=True)
    ]
    frame = Box(across.start, up.end, across.end + 4, up.start)
    places = place(tags, [(x, y) for _, x, y in scored], frame)
    return join(
        _label(box.left, box.bottom - 4, text, "start", "tag")
        for text, box in zip(texts, places, strict=True)
        if box is not None
    )


# The best V so far of several searches, as step lines.


LINES = ("best", "best second")
"""Classes of the lines, in the order of the searches."""


@dataclass(frozen=True)
class BestSoFar:
    """Best V so far in one search."""

    name: str
    """Its name."""
    kept: tuple[tuple[int, float], ...]
    """Number and V of each new best."""
    experiments: int
    """Number of experiments."""


def draw_best(searches: Sequence[BestSoFar], axis: str, alt: str, size: Size) -> Html:
    """A line a search, at most `len(LINES)`. axis: name of V; alt: the picture in words."""
    values = [value for one in searches for _, value in one.kept] or [1.0]
    most = max([one.experiments for one in searches], default=1) or 1
    across = Scale(0.5, most + 0.5, 54, size.width - 12)
    low, high, bottom = min(values), max(values), size.height - 40
    log = high > _LOG_FROM * low > 0
    up = Scale(low / 1.35 if log else 0.0, high * 1.15 or 1.0, bottom, 26.0, log=log)
    drawn = [draw_grid(across, up, size, axis)]
    drawn += [
        tag(
            "path",
            d=step_path(one.kept, across, up, across.at(one.experiments + 0.5)),
            class_=name,
        )
        for one, name in zip(searches, LINES, strict=False)
        if one.kept
    ]
    box = f"0 0 {size.width:g} {size.height:g}"
    keys = [
        tag("span", tag("span", class_=f"key {name}"), said(one.name))
        for one, name in zip(searches, LINES, strict=False)
    ]
    picture = tag("svg", *drawn, viewBox=box, role="img", aria_label=alt, class_="progress")
    return join((picture, tag("p", *keys, class_="legend")))


# Drawing of records over time: measured, simulated, and the error below. The curves scale with the
# page, their labels are HTML.


_WIDTH = 1000
_HEIGHT = 220
_STRIP = 70
_COLUMNS = 420
_MARGIN = 0.06


@dataclass(frozen=True)
class Curves:
    """Curves of one output over one record or window."""

    title: Html
    """Title of the panel."""
    alt: str
    """The same for those who do not see it."""
    axis: str
    """Name and unit of the output."""
    time: str
    """Name and unit of the time axis."""
    start: float
    """Time of the first sample."""
    step: float
    """Time from one sample to the next."""
    measured: Array
    """(H,)."""
    simulated: Array
    """(H,)."""
    skip: int = 0
    """Samples at the start that do not count."""
    band: tuple[Array, Array] | None = None
    """Lower and upper edge (H,) of the output bands; None without any."""


def draw_curves(curves: Curves) -> Html:
    """The curves with a strip of errors below."""
    y, y_hat = curves.measured, curves.simulated
    low, high = _limits(y, y_hat)
    error = y - y_hat
    most = float(np.nanmax(np.abs(error), initial=0.0)) or 1.0
    around = None if curves.band is None else (curves.band[0] - y_hat, curves.band[1] - y_hat)
    lines = [("measured", y), ("model", y_hat)]
    upper = _panel(_HEIGHT, Scale(low, high, _HEIGHT, 0), lines, curves.band)
    lower = _panel(_STRIP, Scale(-most, most, _STRIP, 0), [("error", error)], around)
    end = curves.start + curves.step * len(y)
    across = Scale(curves.start, end, 0, 100)
    marks = [
        tag("span", written(t), style=f"left:{across.at(t):.2f}%")
        for t in across.ticks(8)
        if across.at(t) <= 96
    ]
    shade = None
    if curves.skip:
        share = 100 * curves.skip / len(y)
        shade = tag("span", class_="skip", style=f"width:{share:.2f}%")
    return tag(
        "figure",
        tag("figcaption", curves.title),
        tag("div", said(curves.axis), class_="axis"),
        tag(
            "div",
            _values(low, high),
            upper,
            shade,
            class_="plot",
            role="img",
            aria_label=curves.alt,
        ),
        tag("div", "error", class_="axis"),
        tag("div", _values(-most, most, 3), lower, class_="plot strip", aria_hidden="true"),
        tag("div", *marks, class_="times scale"),
        tag("div", curves.time, class_="axis right"),
        class_="curves",
    )


def legend(words: Sequence[tuple[str, str]]) -> Html:
    """Names of the curves; words: class and name."""
    items = [tag("span", tag("span", class_=f"key {name}"), label) for name, label in words]
    return tag("p", *items, class_="legend")


def _limits(*values: Array) -> tuple[float, float]:
    """Those of the measured output; a simulation that leaves them far behind is cut off."""
    known = [v[~np.isnan(v)] for v in values]
    values = tuple(v if v.size else values[-1] for v in known)
    low, high = float(values[0].min()), float(values[0].max())
    room = 0.5 * (high - low) or 1.0
    least, most = (float(f([f(v) for v in values])) for f in (np.min, np.max))
    low, high = max(low - room, min(low, least)), min(high + room, max(high, most))
    edge = _MARGIN * (high - low) or 1.0
    return low - edge, high + edge


def _values(low: float, high: float, most: int = 4) -> Html:
    scale = Scale(low, high, 100, 0)
    ticks = [t for t in scale.ticks(most) if 3 <= scale.at(t) <= 97]
    marks = [tag("span", written(t), style=f"top:{scale.at(t):.1f}%") for t in ticks]
    return tag("div", *marks, class_="values scale", aria_hidden="true")


def _panel(
    height: int,
    scale: Scale,
    lines: Sequence[tuple[str, Array]],
    band: tuple[Array, Array] | None = None,
) -> Html:
    parts = [_line(name, values, scale) for name, values in lines]
    zero = round(scale.at(0.0)) if scale.low < 0 < scale.high else None
    rule = None if zero is None else tag("path", d=f"M0 {zero}H{_WIDTH}", class_="zero")
    return tag(
        "svg",
        None if band is None else _between(*band, scale),
        rule,
        *parts,
        viewBox=f"0 0 {_WIDTH} {height}",
        preserveAspectRatio="none",
        aria_hidden="true",
        focusable="false",
    )


def _line(name: str, values: Array, scale: Scale) -> Html:
    """Draw a line with a gap at each NaN; an isolated value is a dash of one sample."""
    across = Scale(0, max(len(values) - 1, 1), 0, _WIDTH)
    parts: list[str] = []
    for first, last in _segments(values):
        points = thinned(values[first:last].tolist(), _COLUMNS)
        places = [f"{round(across.at(first + i))} {round(scale.at(v))}" for i, v in points]
        parts.append(f"M{'L'.join(places)}" + ("h1" if len(places) == 1 else ""))
    return tag("path", d="".join(parts), class_=f"line {name}")


def _between(lower: Array, upper: Array, scale: Scale) -> Html:
    """Draw the area between two edges, clipped to the panel."""
    across = Scale(0, max(len(lower) - 1, 1), 0, _WIDTH)
    edges = [np.clip(edge, scale.low, scale.high).tolist() for edge in (upper, lower)]
    there, back = (thinned(edge, _COLUMNS) for edge in edges)
    places = [f"{round(across.at(i))} {round(scale.at(v))}" for i, v in (*there, *reversed(back))]
    return tag("path", d=f"M{'L'.join(places)}Z", class_="outputs")


def _segments(values: Array) -> list[tuple[int, int]]:
    """Return the first sample and the one after the last of each segment without NaN."""
    known = ~np.isnan(values)
    if known.all():
        return [(0, len(values))]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


# Drawing of the lineage as lanes next to a list of experiments.


ROW = 34
"""Height of a row of the list, as in page.css."""
_LANE = 16
_MOST_LANES = 9


@dataclass(frozen=True)
class LineageRow:
    """One row of the list."""

    number: int
    """Number of the experiment."""
    parent: int | None
    """Number of the parent experiment."""
    status: str
    """Status of the experiment."""
    winning: bool
    """True for the winner and its ancestors."""


def lanes(rows: Sequence[LineageRow]) -> dict[int, int]:
    """Return the lane of each experiment, 0 for the winner's line. A child takes the lane of its
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


def draw_lanes(rows: Sequence[LineageRow]) -> tuple[Html, int]:
    """The drawing, and its width in pixels."""
    at = lanes(rows)
    places = {row.number: (_x(at[row.number]), _y(i)) for i, row in enumerate(rows)}
    edges: list[Html] = []
    for row in rows:
        if row.parent not in places:
            continue
        (x0, y0), (x1, y1) = places[row.parent], places[row.number]
        # Down the parent's lane, then over: another dot of the child's lane is no parent.
        turn = y1 - ROW
        path = f"M{x0} {y0}V{y1}"
        if x0 != x1:
            path = f"M{x0} {y0}V{turn}C{x0} {turn + 20} {x1} {turn + 14} {x1} {y1}"
        edges.append(tag("path", d=path, class_="edge won" if row.winning else "edge"))
    dots = [_dot(row, *places[row.number]) for row in rows]
    width = (max(at.values(), default=0) + 1) * _LANE + 8
    height = ROW * len(rows)
    return (
        tag(
            "svg",
            *edges,
            *dots,
            viewBox=f"0 0 {width} {height}",
            width=width,
            height=height,
            aria_hidden="true",
            focusable="false",
        ),
        width,
    )


def _dot(row: LineageRow, x: int, y: int) -> Html:
    name = {"keep": "kept", "discard": "other", "inconclusive": "other"}.get(row.status, "failed")
    if name == "failed":
        return tag("path", d=f"M{x - 4} {y - 4}l8 8m0 -8l-8 8", class_=name)
    return tag("circle", cx=x, cy=y, r="5", class_=name)


def _x(lane: int) -> int:
    return 10 + lane * _LANE


def _y(row: int) -> int:
    return ROW * row + ROW // 2


# Drawing of a validation check: a few lines over one axis, and the band that chance stays within.


_PANEL_WIDTH, _PANEL_HEIGHT = 600, 180
# Curves with at most this many points have fold or record numbers as abscissa, which are integers.
_FEW_POINTS = 12


def draw_panel(check: DrawnCheck, *, log: bool) -> Html:
    """The curves of a check with their names. log: both axes are logarithmic, and what is not
    above 0 is left out."""
    lines = [_points(curve, log=log) for curve in check.curves]
    every = [point for line in lines for point in line]
    if not every:
        return tag("figure", tag("figcaption", said(check.name)), tag("p", "Nothing to draw."))
    bands = [curve.band for curve in check.curves if curve.band is not None]
    across = _scale([x for x, _ in every], 0, _PANEL_WIDTH, log=log, margin=0.0)
    edges = [edge for band in bands for edge in (-band, band)]
    up = _scale([*(y for _, y in every), *edges], _PANEL_HEIGHT, 0, log=log, margin=_MARGIN)
    drawing = tag(
        "svg",
        _shade(bands, up),
        _zero(up, log=log),
        *(_panel_line(line, number, across, up) for number, line in enumerate(lines)),
        viewBox=f"0 0 {_PANEL_WIDTH} {_PANEL_HEIGHT}",
        preserveAspectRatio="none",
        aria_hidden="true",
        focusable="false",
    )
    names = ", ".join(curve.name for curve in check.curves)
    return tag(
        "figure",
        tag("figcaption", said(check.name)),
        _legend(check) if len(check.curves) > 1 else None,
        tag("div", said(check.axes[1]), class_="axis"),
        tag(
            "div",
            tag("div", *_panel_values(up, log=log), class_="values scale", aria_hidden="true"),
            drawing,
            class_="plot",
            role="img",
            aria_label=f"{check.name}: {check.axes[1]} over {check.axes[0]}, of {names}",
        ),
        tag("div", *_times(across, log=log, whole=_are_few(check)), class_="times scale"),
        tag("div", said(check.axes[0]), class_="axis right"),
        class_="curves panel",
    )


def _points(curve: DrawnCurve, *, log: bool) -> list[tuple[float, float]]:
    pairs = zip(curve.x, curve.y, strict=True)
    return [(x, y) for x, y in pairs if not log or (x > 0 and y > 0)]


def _scale(values: Sequence[float], start: float, end: float, *, log: bool, margin: float) -> Scale:
    low, high = min(values), max(values)
    if log:
        room = (high / low) ** margin if high > low else 2.0
        return Scale(low / room, high * room, start, end, log=True)
    room = margin * (high - low) if high > low else 0.5
    return Scale(low - room, high + room, start, end)


def _panel_line(
    points: Sequence[tuple[float, float]], number: int, across: Scale, up: Scale
) -> Html:
    places = [f"{round(across.at(x))} {round(up.at(y))}" for x, y in points]
    if len(places) == 1:
        places *= 2
    path = f"M{'L'.join(places)}" if places else "M0 0"
    return tag("path", d=path, class_=f"line series{number}")


def _shade(bands: Sequence[float], up: Scale) -> Html | None:
    if not bands:
        return None
    top, bottom = up.at(max(bands)), up.at(-max(bands))
    return tag(
        "rect", x=0, y=round(top), width=_PANEL_WIDTH, height=round(bottom - top), class_="band"
    )


def _zero(up: Scale, *, log: bool) -> Html | None:
    if log or not up.low < 0 < up.high:
        return None
    return tag("path", d=f"M0 {round(up.at(0.0))}H{_PANEL_WIDTH}", class_="zero")


def _ticks(scale: Scale, most: int, *, log: bool) -> list[float]:
    if not log:
        return scale.ticks(most)
    found = scale.ticks()
    if len(found) > most:
        found = [t for t in found if math.log10(t) == round(math.log10(t))]
    return found[:: -(-len(found) // most)] if found else []


def _panel_values(up: Scale, *, log: bool) -> list[Html]:
    share = 100 / _PANEL_HEIGHT
    places = [(t, share * up.at(t)) for t in _ticks(up, 4, log=log)]
    return [tag("span", written(t), style=f"top:{at:.1f}%") for t, at in places if 3 <= at <= 97]


def _are_few(check: DrawnCheck) -> bool:
    return all(len(c.x) <= _FEW_POINTS and all(x == int(x) for x in c.x) for c in check.curves)


def _times(across: Scale, *, log: bool, whole: bool) -> list[Html]:
    share = 100 / _PANEL_WIDTH
    ticks = [t for t in _ticks(across, 6, log=log) if not whole or t == int(t)]
    places = [(t, share * across.at(t)) for t in ticks]
    return [tag("span", written(t), style=f"left:{at:.2f}%") for t, at in places if at <= 96]


def _legend(check: DrawnCheck) -> Html:
    items = [
        tag("span", tag("span", class_=f"key series{k}"), said(curve.name, 80))
        for k, curve in enumerate(check.curves)
    ]
    more = "further ones are in report/validation.pdf" if check.left_out else None
    return tag("p", *items, more, class_="legend")
