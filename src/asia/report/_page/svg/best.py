"""The best V so far of several searches, as step lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from asia.report._page.html import Html, join, said, tag
from asia.report._page.svg.progress import Size, draw_grid, step_path
from asia.report._page.svg.scales import Scale

_LOG_FROM = 6.0
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
