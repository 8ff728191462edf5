"""Drawing of records over time: measured, simulated, and the error below. The curves scale with the
page, their labels are HTML.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.data import Array
from asia.report._page.html import Html, said, tag
from asia.report._page.svg.scales import Scale, thinned, written

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
