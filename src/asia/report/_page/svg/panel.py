"""Drawing of a validation check: a few lines over one axis, and the band that chance stays
within.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from asia.ledger import DrawnCheck, DrawnCurve
from asia.report._page.html import Html, said, tag
from asia.report._page.svg.scales import Scale, written

_WIDTH, _HEIGHT = 600, 180
_MARGIN = 0.06
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
    across = _scale([x for x, _ in every], 0, _WIDTH, log=log, margin=0.0)
    edges = [edge for band in bands for edge in (-band, band)]
    up = _scale([*(y for _, y in every), *edges], _HEIGHT, 0, log=log, margin=_MARGIN)
    drawing = tag(
        "svg",
        _shade(bands, up),
        _zero(up, log=log),
        *(_line(line, number, across, up) for number, line in enumerate(lines)),
        viewBox=f"0 0 {_WIDTH} {_HEIGHT}",
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
            tag("div", *_values(up, log=log), class_="values scale", aria_hidden="true"),
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


def _line(points: Sequence[tuple[float, float]], number: int, across: Scale, up: Scale) -> Html:
    places = [f"{round(across.at(x))} {round(up.at(y))}" for x, y in points]
    if len(places) == 1:
        places *= 2
    path = f"M{'L'.join(places)}" if places else "M0 0"
    return tag("path", d=path, class_=f"line series{number}")


def _shade(bands: Sequence[float], up: Scale) -> Html | None:
    if not bands:
        return None
    top, bottom = up.at(max(bands)), up.at(-max(bands))
    return tag("rect", x=0, y=round(top), width=_WIDTH, height=round(bottom - top), class_="band")


def _zero(up: Scale, *, log: bool) -> Html | None:
    if log or not up.low < 0 < up.high:
        return None
    return tag("path", d=f"M0 {round(up.at(0.0))}H{_WIDTH}", class_="zero")


def _ticks(scale: Scale, most: int, *, log: bool) -> list[float]:
    if not log:
        return scale.ticks(most)
    found = scale.ticks()
    if len(found) > most:
        found = [t for t in found if math.log10(t) == round(math.log10(t))]
    return found[:: -(-len(found) // most)] if found else []


def _values(up: Scale, *, log: bool) -> list[Html]:
    share = 100 / _HEIGHT
    places = [(t, share * up.at(t)) for t in _ticks(up, 4, log=log)]
    return [tag("span", written(t), style=f"top:{at:.1f}%") for t, at in places if 3 <= at <= 97]


def _are_few(check: DrawnCheck) -> bool:
    return all(len(c.x) <= _FEW_POINTS and all(x == int(x) for x in c.x) for c in check.curves)


def _times(across: Scale, *, log: bool, whole: bool) -> list[Html]:
    share = 100 / _WIDTH
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
