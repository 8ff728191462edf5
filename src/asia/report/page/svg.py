"""SVG drawings: records over time, V of experiments, lineage, checks."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from asia._text import one_line
from asia._timer import duration
from asia.data.trajectory import Array
from asia.ledger.evidence import DrawnCheck
from asia.ledger.text import error_value
from asia.problem.problem import Problem
from asia.report.drawing.places import LINE, LOGARITHMIC_CHECKS, Box, Tag, place, time_unit
from asia.report.page.html import Html, join, said, tag


@dataclass(frozen=True)
class Scale:
    """A linear or logarithmic axis: the numbers low to high at the positions start to end."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def at(self, value: float) -> float:
        """Position of a number, kept within the axis."""
        low, high, here = self.low, self.high, min(max(value, self.low), self.high)
        if self.log:
            low, high, here = math.log(low), math.log(high), math.log(here)
        share = (here - low) / (high - low) if high > low else 0.5
        return self.start + share * (self.end - self.start)

    def ticks(self, most: int = 6) -> list[float]:
        """Round numbers within the axis; of a logarithmic axis about seven."""
        if self.log:
            decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
            found: list[float] = []
            for marks in ((1, 2, 5), (1, 3), (1,)):
                every = (m * 10.0**d for d in decades for m in marks)
                found = [t for t in every if self.low <= t <= self.high]
                if len(found) <= 7:
                    break
            return found or [self.low, self.high]
        if not self.high > self.low:
            return [self.low]
        rough = (self.high - self.low) / most
        unit = 10.0 ** math.floor(math.log10(rough))
        found: list[float] = []
        # Steps of at least `rough`; a smaller one where that leaves a single number.
        for step in (unit * k for k in (10, 5, 2, 1, 0.5)):
            if step < rough and len(found) > 1:
                break
            first = math.ceil(self.low / step - 1e-9)
            last = math.floor(self.high / step + 1e-9)
            found = [round(k * step, 12) + 0.0 for k in range(first, last + 1)]
        return found


def written(value: float) -> str:
    """A tick's number."""
    return f"{value:.6g}".replace("-", "−")


def rounded(value: float) -> str:
    """A coordinate."""
    return f"{value:.1f}".removesuffix(".0")


def legend(entries: Sequence[tuple[str, str]]) -> Html:
    """Names of the curves, each a class and a text."""
    items = [tag("span", tag("span", class_=f"key {name}"), text) for name, text in entries]
    return tag("p", *items, class_="legend")


# V of every experiment, with the best so far as a step line, tags at improvements, and the
# reference models.


_LOG_FROM = 6.0
_CHARACTER = 6.3
_MOST_TAGS = 14
# From so many experiments on, those that were not kept are drawn as one path.
_MANY = 400


@dataclass(frozen=True)
class Point:
    """One experiment; value is V, None without a score; best: it was the best so far."""

    number: int
    value: float | None
    status: str
    title: str
    best: bool


@dataclass(frozen=True)
class Size:
    """A variant of the drawing. right: margin for the names of the reference models, if they fit;
    tag: most characters of a tag."""

    width: float
    height: float
    right: float
    tag: int


WIDE = Size(900, 380, 170, 30)
NARROW = Size(380, 340, 12, 3)


def both_sizes(draw: Callable[[Size], Html]) -> Html:
    """A drawing for wide and for narrow screens, of which the page shows one."""
    sizes = ((WIDE, "wide"), (NARROW, "narrow"))
    return join(tag("div", draw(size), class_=name) for size, name in sizes)


def draw_progress(
    points: Sequence[Point],
    levels: Sequence[tuple[str, float]],
    axis: str,
    alt: str,
    size: Size,
) -> Html:
    """Draw V of each experiment.

    Args:
        points: the experiments.
        levels: name and V of the reference models.
        axis: name of V.
        alt: the picture in words.
        size: for a wide or a narrow screen.
    """
    scored = [(p, p.value) for p in points if p.value is not None]
    bests = [(p.number, value) for p, value in scored if p.best]
    # Results far above the best ones and the references are clipped to the upper edge.
    usual = [value for _, value in (*bests, *levels)] or [1.0]
    values = [*usual, *(value for _, value in scored)]
    low, high = min(values), min(max(values), 1.6 * max(usual))
    most = max((p.number for p in points), default=1)
    across = Scale(0.5, most + 0.5, 54, size.width - size.right)
    bottom, top = size.height - 40, 26.0
    if high > _LOG_FROM * low > 0:
        up = Scale(low / 1.35, high * 1.25, bottom, top, log=True)
    else:
        up = Scale(0.0, high * 1.15 or 1.0, bottom, top)
    drawn: list[Html | None] = [_grid(across, up, size, axis), _levels(levels, across, up, size)]
    shown = points
    if len(points) > _MANY:
        shown = [p for p in points if p.best]
        dots = [
            f"M{rounded(across.at(p.number))} {rounded(up.at(value))}h0"
            for p, value in scored
            if not p.best
        ]
        ticks = [
            f"M{rounded(across.at(p.number))} {rounded(up.end - 10)}v7"
            for p in points
            if p.value is None
        ]
        drawn.append(tag("path", d="".join(dots), class_="crowd"))
        drawn.append(tag("path", d="".join(ticks), class_="failed"))
    if bests:
        drawn.append(tag("path", d=_steps(bests, across, up, across.end), class_="best"))
    drawn += [_marker(point, across, up) for point in shown]
    drawn.append(_tags(shown, across, up, size))
    return _progress_svg(drawn, alt, size)


def _progress_svg(drawn: Sequence[Html | None], alt: str, size: Size) -> Html:
    box = f"0 0 {size.width:g} {size.height:g}"
    return tag("svg", *drawn, viewBox=box, role="img", aria_label=alt, class_="progress")


def _label(x: float, y: float, text: str, anchor: str = "middle", name: str = "tick") -> Html:
    return tag("text", text, x=rounded(x), y=rounded(y), text_anchor=anchor, class_=name)


def _across(y: float, across: Scale, name: str) -> Html:
    line = f"M{rounded(across.start)} {rounded(y)}H{rounded(across.end)}"
    return tag("path", d=line, class_=name)


def _grid(across: Scale, up: Scale, size: Size, axis: str, below: str = "experiment") -> Html:
    """Both axes with their numbers. axis: name of V; below: name of the horizontal axis."""
    parts: list[Html] = []
    for value in up.ticks():
        y = up.at(value)
        parts.append(_across(y, across, "grid"))
        parts.append(_label(across.start - 8, y + 4, written(value), "end"))
    for value in across.ticks(8):
        if below != "experiment" or (value == round(value) and value >= 1):
            parts.append(_label(across.at(value), up.start + 17, written(value)))
    parts.append(_label((across.start + across.end) / 2, size.height - 6, below))
    parts.append(_label(6, 14, axis, "start", "name"))
    return join(parts)


def _levels(levels: Sequence[tuple[str, float]], across: Scale, up: Scale, size: Size) -> Html:
    """Lines of the reference models, with names that do not overlap."""
    parts: list[Html] = []
    taken: list[float] = []
    beside = size.right > 100
    for name, value in sorted(levels, key=lambda level: -level[1]):
        y = up.at(value)
        parts.append(_across(y, across, "level"))
        at = y + 4 if beside else y - 4
        while any(abs(at - other) < LINE for other in taken):
            at += 1
        taken.append(at)
        x, anchor = (across.end + 8, "start") if beside else (across.end, "end")
        parts.append(_label(x, at, one_line(name, 26), anchor, "reference"))
    return join(parts)


def _steps(bests: Sequence[tuple[int, float]], across: Scale, up: Scale, end: float) -> str:
    """Path of the best so far. bests: number and V of each; end: position where it ends."""
    first, value = bests[0]
    path = f"M{rounded(across.at(first))} {rounded(up.at(value))}"
    for number, better in bests[1:]:
        path += f"H{rounded(across.at(number))}V{rounded(up.at(better))}"
    return f"{path}H{rounded(end)}"


def _cross(x: float, y: float, name: str = "failed") -> Html:
    return tag("path", d=f"M{rounded(x - 4)} {rounded(y - 4)}l8 8m0 -8l-8 8", class_=name)


def _marker(point: Point, across: Scale, up: Scale) -> Html:
    x = across.at(point.number)
    value = "" if point.value is None else f", V {error_value(point.value)}"
    title = f"#{point.number:02d} {point.status}{value}: {one_line(point.title, 80)}"
    name = "kept" if point.best else "other"
    mark = _cross(x, up.end - 6) if point.value is None else _dot(x, point.value, up, name)
    return tag("g", tag("title", title), mark)


def _dot(x: float, value: float, up: Scale, name: str) -> Html:
    """A circle, or a triangle at the upper edge for a value above it."""
    y = up.at(value)
    if value > up.high:
        return tag("path", d=f"M{rounded(x - 5)} {rounded(y + 4)}h10l-5 -9z", class_=name)
    return tag("circle", cx=rounded(x), cy=rounded(y), r="4.5", class_=name)


def _tags(
    points: Sequence[Point], across: Scale, up: Scale, size: Size, at: Sequence[float] = ()
) -> Html:
    """Names at the improvements, where there is room: the last one first, then the largest. at:
    places on the horizontal axis; default: the numbers of the points."""
    scored = [
        (p, across.at(x), up.at(p.value))
        for p, x in zip(points, at or [p.number for p in points], strict=True)
        if p.value is not None
    ]
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
    # The steps through the improvements.
    lines: list[Box] = []
    for (_, x, y), after in zip(bests, [*bests[1:], None], strict=True):
        end, level = (after[1], after[2]) if after else (across.end, y)
        lines += [Box(x, y - 1, end, y + 1), Box(end - 1, min(y, level), end + 1, max(y, level))]
    places = place(tags, [(x, y) for _, x, y in scored], frame, lines)
    return join(
        _label(box.left, box.bottom - 4, text, "start", "tag")
        for text, box in zip(texts, places, strict=True)
        if box is not None
    )


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


def draw_tradeoff(points: Sequence[Traded], axis: str, below: str, alt: str, size: Size) -> Html:
    """Draw V against a cost on logarithmic axes, with the front that nothing dominates.

    Args:
        points: the experiments, all with a positive cost
        axis: name of V
        below: name of the cost, with its unit
        alt: the picture in words
        size: for a wide or a narrow screen
    """
    front = front_of(points)
    cheap, dear = (f(p.cost for p in points) for f in (min, max))
    # Results far above the front are clipped to the upper edge.
    low, high = front[-1].value, min(max(p.value for p in points), 20 * front[-1].value or 1.0)
    across = Scale(cheap / 1.3, dear * 1.3, 54, size.width - 40, log=True)
    up = Scale(max(low, 1e-12) / 1.3, max(high, low) * 1.3 or 1.0, size.height - 40, 26.0, log=True)
    drawn: list[Html | None] = [_grid(across, up, size, axis, below)]
    others = [p for p in points if p not in front]
    places = [(f"{rounded(across.at(p.cost))} {rounded(up.at(p.value))}", p) for p in others]
    if len(others) > _MANY:
        drawn.append(tag("path", d="".join(f"M{at}h0" for at, _ in places), class_="crowd"))
        others = []
    line = "".join(
        f"{'V' if k else 'M'}{'' if k else f'{rounded(across.at(p.cost))} '}"
        f"{rounded(up.at(p.value))}H{rounded(across.at(q.cost) if q else across.end)}"
        for k, (p, q) in enumerate(zip(front, [*front[1:], None], strict=True))
    )
    drawn.append(tag("path", d=line, class_="best"))
    for point in (*others, *front):
        text = f"#{point.number:02d} V {error_value(point.value)}, {below} {point.cost:.3g}: "
        mark = _dot(across.at(point.cost), point.value, up, "kept" if point in front else "other")
        drawn.append(tag("g", tag("title", text + one_line(point.title, 80)), mark))
    every = [*front, *others]
    shown = [Point(p.number, p.value, "", p.title, best=p in front) for p in every]
    drawn.append(_tags(shown, across, up, size, [p.cost for p in every]))
    return _progress_svg(drawn, alt, size)


def series(number: int) -> str:
    """Class of the line of a run or an experiment, from 0 on: five colours, then dashes."""
    return f"series{number % 5} dash{number // 5 % 3}"


@dataclass(frozen=True)
class BestSoFar:
    """Number and V of each new best of a search, and its number of experiments."""

    name: str
    kept: tuple[tuple[int, float], ...]
    experiments: int


def draw_best(searches: Sequence[BestSoFar], axis: str, alt: str, size: Size) -> Html:
    """The best V so far of each search as step lines. axis: name of V; alt: the picture in
    words."""
    values = [value for one in searches for _, value in one.kept] or [1.0]
    most = max([one.experiments for one in searches], default=1) or 1
    across = Scale(0.5, most + 0.5, 54, size.width - 12)
    low, high = min(values), max(values)
    log = high > _LOG_FROM * low > 0
    up = Scale(low / 1.35 if log else 0.0, high * 1.15 or 1.0, size.height - 40, 26.0, log=log)
    drawn: list[Html | None] = [_grid(across, up, size, axis)]
    for k, one in enumerate(searches):
        if one.kept:
            path = _steps(one.kept, across, up, across.at(one.experiments + 0.5))
            drawn.append(tag("path", d=path, class_=f"line steps {series(k)}"))
    keys = [(series(k), said(one.name)) for k, one in enumerate(searches)]
    return join((_progress_svg(drawn, alt, size), legend(keys)))


def draw_loss(points: Sequence[tuple[float, float]]) -> Html:
    """Draw the losses of a running fit over its steps as a line without axes; logarithmic where all
    are positive. The text next to it has the last one."""
    steps, losses = [step for step, _ in points], [loss for _, loss in points]
    low, high = min(losses), max(losses)
    across = Scale(steps[0], steps[-1], 2, 138)
    up = Scale(low, high, 30, 4, log=low > 0)
    path = "".join(
        f"{'L' if k else 'M'}{rounded(across.at(step))} {rounded(up.at(loss))}"
        for k, (step, loss) in enumerate(points)
    )
    line = tag("path", d=path, class_="line series0")
    return tag("svg", line, viewBox="0 0 140 34", class_="loss", aria_hidden="true")


# Evaluations over time.


_ROW = 16
_LONGEST_GAP = 0.1
"""Share of the time of all evaluations; longer gaps between them are cut to it."""


@dataclass(frozen=True)
class Span:
    """Evaluation of an experiment from begin to end, in seconds; kind: class of its bar."""

    number: int
    title: str
    kind: str
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


def draw_timeline(spans: Sequence[Span], alt: str, size: Size) -> Html:
    """Draw a bar for each evaluation, those at the same time in rows of their own.

    Args:
        spans: the evaluations, at least one
        alt: the picture in words
        size: for a wide or a narrow screen; its height follows from the number of rows
    """
    moved = without_pauses(spans)
    free: list[float] = []
    lanes: list[int] = []
    for one in moved:
        lane = next((k for k, end in enumerate(free) if end <= one.begin), len(free))
        free[lane : lane + 1] = [one.end]
        lanes.append(lane)
    unit = time_unit(max(free) or 1.0)
    across = Scale(0.0, max(free) / unit.seconds or 1.0, 28, size.width - 12)
    bottom = 6.0 + _ROW * len(free)
    drawn: list[Html] = []
    for value in across.ticks(8):
        drawn.append(
            tag("path", d=f"M{rounded(across.at(value))} 4V{rounded(bottom)}", class_="grid")
        )
        drawn.append(_label(across.at(value), bottom + 15, written(value)))
    drawn += [_label(20, 6 + _ROW * (k + 0.75), f"{k + 1}", "end") for k in range(len(free))]
    drawn.append(_label((across.start + across.end) / 2, bottom + 32, f"time [{unit.name}]"))
    for one, lane in zip(moved, lanes, strict=True):
        left, right = (across.at(at / unit.seconds) for at in (one.begin, one.end))
        bar = tag(
            "rect", x=rounded(left), y=rounded(8 + _ROW * lane), rx="2", height=f"{_ROW - 4}",
            width=rounded(max(right - left, 1.0)), class_=f"bar {one.kind}",
        )  # fmt: skip
        text = f"#{one.number:02d}, {duration(one.end - one.begin)}: {one_line(one.title, 80)}"
        drawn.append(tag("g", tag("title", text), bar))
    return _progress_svg(drawn, alt, replace(size, height=bottom + 38))


# Curves over one axis. The curves scale with the page, so that their labels are HTML.


_WIDTH = 1000
_HEIGHT = 220
_STRIP = 70
_COLUMNS = 420
_MARGIN = 0.06


def _ticks(scale: Scale, most: int) -> list[float]:
    """Round numbers; of a logarithmic axis decades where there are too many."""
    found = scale.ticks(most)
    if not scale.log:
        return found
    if len(found) > most:
        found = [t for t in found if math.log10(t) == round(math.log10(t))]
    return found[:: -(-len(found) // most)] if found else []


def _plot(
    up: Scale,
    band: Html | None,
    lines: Sequence[Html],
    most: int = 4,
    shade: Html | None = None,
    **attributes: object,
) -> Html:
    """Curves with at most `most` numbers of the vertical axis beside them. up: from the height of
    the drawing to 0; shade: lies over the drawing; attributes: those of the element."""
    height = int(up.start)
    places = [(t, 100 * up.at(t) / height) for t in _ticks(up, most)]
    values = [tag("span", written(t), style=f"top:{at:.1f}%") for t, at in places if 3 <= at <= 97]
    zero = None
    if not up.log and up.low < 0 < up.high:
        zero = tag("path", d=f"M0 {round(up.at(0.0))}H{_WIDTH}", class_="zero")
    drawing = tag(
        "svg",
        band,
        zero,
        *lines,
        viewBox=f"0 0 {_WIDTH} {height}",
        preserveAspectRatio="none",
        aria_hidden="true",
        focusable="false",
    )
    numbers = tag("div", *values, class_="values scale", aria_hidden="true")
    return tag("div", numbers, drawing, shade, **attributes)


def _below(across: Scale, label: str, most: int, *, whole: bool = False) -> tuple[Html, Html]:
    """Numbers and name of the horizontal axis. across: from 0 to 100 per cent."""
    ticks = [t for t in _ticks(across, most) if not whole or t == int(t)]
    places = [(t, across.at(t)) for t in ticks]
    marks = [tag("span", written(t), style=f"left:{at:.2f}%") for t, at in places if at <= 96]
    return (
        tag("div", *marks, class_="times scale"),
        tag("div", said(label), class_="axis right"),
    )


@dataclass(frozen=True)
class Overlay:
    """Measured and simulated output over one record, block or window.

    Attributes:
        title: title of the panel.
        alt: the same for those who do not see it.
        channel: number of the output.
        first: number of the first sample in its record.
        measured, simulated: (H, ny).
        skip: samples at the start that do not count.
        band: lower and upper edges (H, ny) of the output bands.
        others: further simulations (H, ny).
        below: label and values (H,) of a curve in place of the errors.
    """

    title: Html
    alt: str
    channel: int
    first: int
    measured: Array
    simulated: Array
    skip: int = 0
    band: tuple[Array, Array] | None = None
    others: tuple[Array, ...] = ()
    below: tuple[str, Array] | None = None

    def cut(self, first: int, last: int | None) -> Overlay:
        """Return the part between two samples, counted from its start and clipped to it; at least
        two samples. last: None for the end.
        """
        count = len(self.measured)
        begin = min(max(first, 0), count - 2)
        end = max(count if last is None else min(last + 1, count), begin + 2)
        return replace(
            self,
            first=self.first + begin,
            measured=self.measured[begin:end],
            simulated=self.simulated[begin:end],
            skip=max(0, min(self.skip, end) - begin),
            band=None if self.band is None else (self.band[0][begin:end], self.band[1][begin:end]),
            others=tuple(one[begin:end] for one in self.others),
            below=None if self.below is None else (self.below[0], self.below[1][begin:end]),
        )


def overlay_legend(*, banded: bool = False) -> Html:
    """Legend of the curves. banded: true if output bands are among them."""
    entries = [("measured", "measured"), ("model", "simulated"), ("error", "error")]
    return legend([*entries, *([("outputs", "output bands")] if banded else [])])


def error_limit(overlay: Overlay) -> float:
    """Largest error that a strip of the overlay's simulations shows: of several, one that is far
    off does not hide the others."""
    y, *simulated = (
        side[:, overlay.channel] for side in (overlay.measured, overlay.simulated, *overlay.others)
    )
    sizes = sorted(float(np.nanmax(np.abs(y - one), initial=0.0)) for one in simulated)
    return min(sizes[-1], 5 * sizes[0]) or sizes[-1] or 1.0


def draw_overlay(problem: Problem, overlay: Overlay, limit: float | None = None) -> Html:
    """Measured against simulated output, with a strip of errors below. limit: end of the strip's
    axis; default: `error_limit`."""
    signal = problem.outputs[overlay.channel]
    y, y_hat, *others = (
        side[:, overlay.channel] for side in (overlay.measured, overlay.simulated, *overlay.others)
    )
    names = [series(k) for k in range(1 + len(others))] if others else ["model"]
    unit = time_unit(problem.sampling_time * (overlay.first + len(y)))
    step = problem.sampling_time / unit.seconds
    low, high = _limits(y, y_hat, *others)
    upper = Scale(low, high, _HEIGHT, 0)
    errors = [y - one for one in (y_hat, *others)]
    most = limit or error_limit(overlay)
    strip = Scale(-most, most, _STRIP, 0)
    what = Html("error")
    if overlay.below is not None:
        what, errors = said(overlay.below[0]), [overlay.below[1]]
        strip = Scale(*_limits(overlay.below[1]), _STRIP, 0)
    band = around = None
    if overlay.band is not None:
        edges = [edge[:, overlay.channel] for edge in overlay.band]
        band = _area(edges, upper)
        around = _area([edge - y_hat for edge in edges], strip)
    shade = None
    if overlay.skip:
        shade = tag("span", class_="skip", style=f"width:{100 * overlay.skip / len(y):.2f}%")
    start = overlay.first * step
    return tag(
        "figure",
        tag("figcaption", overlay.title),
        tag("div", said(signal.label), class_="axis"),
        _plot(
            upper,
            band,
            [
                _line("measured", y, upper),
                *(
                    _line(name, one, upper)
                    for name, one in zip(names, (y_hat, *others), strict=True)
                ),
            ],
            shade=shade,
            class_="plot",
            role="img",
            aria_label=f"{overlay.alt}: measured and simulated {signal.name}",
        ),
        tag("div", what, class_="axis"),
        _plot(
            strip,
            around,
            [
                _line(name if others else "error", one, strip)
                for name, one in zip(names, errors, strict=False)
            ],
            3,
            class_="plot strip",
            aria_hidden="true",
        ),
        *_below(Scale(start, start + step * len(y), 0, 100), f"time [{unit.name}]", 8),
        class_="curves",
    )


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


def thinned(values: Sequence[float]) -> list[tuple[int, float]]:
    """(index, value): all of a short record; of a long one the least and the greatest of each
    column of the drawing."""
    count = len(values)
    if count <= 2 * _COLUMNS:
        return list(enumerate(values))
    found: list[tuple[int, float]] = []
    for k in range(_COLUMNS):
        part = range(k * count // _COLUMNS, (k + 1) * count // _COLUMNS)
        ends = {min(part, key=values.__getitem__), max(part, key=values.__getitem__)}
        found += [(i, values[i]) for i in sorted(ends)]
    return found


def _line(name: str, values: Array, up: Scale) -> Html:
    """A line with a gap at each NaN; an isolated value is a dash of one sample."""
    across = Scale(0, max(len(values) - 1, 1), 0, _WIDTH)
    known = np.concatenate([[False], ~np.isnan(values), [False]])
    edges = np.flatnonzero(np.diff(known)).tolist()
    path = ""
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        points = thinned(values[first:last].tolist())
        places = [f"{round(across.at(first + i))} {round(up.at(v))}" for i, v in points]
        path += f"M{'L'.join(places)}" + ("h1" if len(places) == 1 else "")
    return tag("path", d=path, class_=f"line {name}")


def _area(edges: Sequence[Array], up: Scale) -> Html:
    """The area between a lower and an upper edge, clipped to the panel."""
    across = Scale(0, max(len(edges[0]) - 1, 1), 0, _WIDTH)
    back, there = (thinned(np.clip(edge, up.low, up.high).tolist()) for edge in edges)
    places = [f"{round(across.at(i))} {round(up.at(v))}" for i, v in (*there, *reversed(back))]
    return tag("path", d=f"M{'L'.join(places)}Z", class_="outputs")


# Curves with at most this many points have fold or record numbers as abscissa, which are integers.
_FEW_POINTS = 12


def draw_check(check: DrawnCheck) -> Html:
    """The curves of a validation check with their names, and the band that chance stays within."""
    # Logarithmic axes leave out what is not above 0.
    log = check.name in LOGARITHMIC_CHECKS
    log_x = log or check.name == "phase"
    lines = [
        [
            (x, y)
            for x, y in zip(curve.x, curve.y, strict=True)
            if (x > 0 or not log_x) and (y > 0 or not log)
        ]
        for curve in check.curves
    ]
    every = [point for line in lines for point in line]
    if not every:
        return tag("figure", tag("figcaption", said(check.name)), tag("p", "Nothing to draw."))
    bands = [curve.band for curve in check.curves if curve.band is not None]
    edges = [edge for band in bands for edge in (-band, band)]
    low, high = _range([x for x, _ in every], 0.0, log=log_x)
    across, percent = Scale(low, high, 0, _WIDTH, log_x), Scale(low, high, 0, 100, log_x)
    up = Scale(*_range([*(y for _, y in every), *edges], _MARGIN, log=log), _HEIGHT, 0, log)
    band = None
    if bands:
        top, bottom = up.at(max(bands)), up.at(-max(bands))
        size = {"width": _WIDTH, "height": round(bottom - top)}
        band = tag("rect", x=0, y=round(top), **size, class_="band")
    paths: list[Html] = []
    for number, line in enumerate(lines):
        places = [f"{round(across.at(x))} {round(up.at(y))}" for x, y in line]
        if len(places) == 1:
            places *= 2
        path = f"M{'L'.join(places)}" if places else "M0 0"
        paths.append(tag("path", d=path, class_=f"line series{number}"))
    names = ", ".join(curve.name for curve in check.curves)
    whole = all(len(c.x) <= _FEW_POINTS and all(x == int(x) for x in c.x) for c in check.curves)
    keys = None
    if len(check.curves) > 1:
        items = [
            tag("span", tag("span", class_=f"key series{k}"), said(curve.name, 80))
            for k, curve in enumerate(check.curves)
        ]
        more = "further ones are in report/validation.pdf" if check.left_out else None
        keys = tag("p", *items, more, class_="legend")
    return tag(
        "figure",
        tag("figcaption", said(check.name)),
        keys,
        tag("div", said(check.axes[1]), class_="axis"),
        _plot(
            up,
            band,
            paths,
            class_="plot",
            role="img",
            aria_label=f"{check.name}: {check.axes[1]} over {check.axes[0]}, of {names}",
        ),
        *_below(percent, check.axes[0], 6, whole=whole),
        class_="curves panel",
    )


def draw_poles(models: Sequence[tuple[str, Sequence[complex], Sequence[complex]]]) -> Html:
    """Poles as crosses and zeros as circles of models in the z-plane, with the unit circle. models:
    name, poles and zeros of each."""
    reach = max([1.1, *(abs(z) for _, poles, zeros in models for z in (*poles, *zeros))])
    reach = min(reach, 2.0)
    side = 300.0
    across, up = Scale(-reach, reach, 8, side - 8), Scale(-reach, reach, side - 8, 8)
    unit = (across.end - across.start) / (2 * reach)
    axes = f"M{across.start} {up.at(0)}H{across.end}M{across.at(0)} {up.start}V{up.end}"
    drawn: list[Html] = [
        tag("path", d=axes, class_="grid"),
        tag("circle", cx=across.at(0), cy=up.at(0), r=rounded(unit), class_="level"),
    ]
    for k, (_, poles, zeros) in enumerate(models):
        drawn += [_cross(across.at(z.real), up.at(z.imag), f"line {series(k)}") for z in poles]
        for z in zeros:
            x, y = rounded(across.at(z.real)), rounded(up.at(z.imag))
            drawn.append(tag("circle", cx=x, cy=y, r="4.5", class_=f"line {series(k)}"))
    figure = tag("svg", *drawn, viewBox=f"0 0 {side:g} {side:g}", class_="poles", role="img",
                 aria_label="Poles and zeros in the z-plane; the text has the poles")  # fmt: skip
    keys = legend([(series(k), said(name, 80)) for k, (name, _, _) in enumerate(models)])
    title = tag("figcaption", "poles (crosses), zeros (circles) and the unit circle")
    return tag("figure", title, keys, figure, class_="curves panel")


def _range(values: Sequence[float], margin: float, *, log: bool) -> tuple[float, float]:
    low, high = min(values), max(values)
    if log:
        room = (high / low) ** margin if high > low else 2.0
        return low / room, high * room
    room = margin * (high - low) if high > low else 0.5
    return low - room, high + room


# The lineage as lanes next to a list of experiments.


ROW = 34
"""Height of a row of the list, as in page.css."""
_LANE = 16
_MOST_LANES = 9


@dataclass(frozen=True)
class LineageRow:
    """One experiment of the list; winning: the best candidate or one of its ancestors."""

    number: int
    parent: int | None
    status: str
    winning: bool


def lanes(rows: Sequence[LineageRow]) -> dict[int, int]:
    """Return the lane of each experiment, 0 for the best candidate's line. A child takes the lane
    of its parent if no other experiment uses it from the parent on, else the next free one.
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
    places = {
        row.number: (10 + at[row.number] * _LANE, ROW * i + ROW // 2) for i, row in enumerate(rows)
    }
    edges: list[Html] = []
    dots: list[Html] = []
    for row in rows:
        x1, y1 = places[row.number]
        if row.parent in places:
            x0, y0 = places[row.parent]
            # Down the parent's lane, then over: another dot of the child's lane is no parent.
            turn = y1 - ROW
            path = f"M{x0} {y0}V{y1}"
            if x0 != x1:
                path = f"M{x0} {y0}V{turn}C{x0} {turn + 20} {x1} {turn + 14} {x1} {y1}"
            edges.append(tag("path", d=path, class_="edge won" if row.winning else "edge"))
        scored = "discard", "inconclusive", "mixed", "unconfirmed", "running", "unfinished"
        kind = "kept" if row.status == "keep" else "other" if row.status in scored else None
        dots.append(tag("circle", cx=x1, cy=y1, r="5", class_=kind) if kind else _cross(x1, y1))
    width, height = (max(at.values(), default=0) + 1) * _LANE + 8, ROW * len(rows)
    drawing = tag(
        "svg",
        *edges,
        *dots,
        viewBox=f"0 0 {width} {height}",
        width=width,
        height=height,
        aria_hidden="true",
        focusable="false",
    )
    return drawing, width
