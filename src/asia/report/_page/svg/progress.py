"""Drawing of V of every experiment, with the incumbent as a step line, tags at improvements, and
the reference models.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from asia._text import one_line
from asia.report._drawing.tags import LINE, Box, Tag, place
from asia.report._page.html import Html, join, tag
from asia.report._page.svg.scales import Scale, rounded, written

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
class RungLevel:
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
    points: Sequence[Point], levels: Sequence[RungLevel], axis: str, alt: str, size: Size
) -> Html:
    """The drawing. axis: name of V; alt: the picture in words."""
    values = [p.value for p in points if p.value is not None] + [x.value for x in levels]
    across, up = _scales(points, values, levels, size)
    drawn = [draw_grid(across, up, size, axis), _levels(levels, across, up, size)]
    shown = points
    if len(points) > _MANY:
        shown = [p for p in points if p.best]
        drawn += _crowd([p for p in points if not p.best], across, up)
    drawn += [_steps(points, across, up), *(_marker(p, across, up) for p in shown)]
    drawn.append(_tags(shown, across, up, size))
    box = f"0 0 {size.width:g} {size.height:g}"
    return tag("svg", *drawn, viewBox=box, role="img", aria_label=alt, class_="progress")


def _scales(
    points: Sequence[Point], values: Sequence[float], levels: Sequence[RungLevel], size: Size
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


def _levels(levels: Sequence[RungLevel], across: Scale, up: Scale, size: Size) -> Html:
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


def _steps(points: Sequence[Point], across: Scale, up: Scale) -> Html | None:
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
