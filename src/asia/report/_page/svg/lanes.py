"""Drawing of the lineage as lanes next to a list of experiments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from asia.report._page.html import Html, tag

ROW = 34
"""Height of a row of the list, as in page.css."""
_LANE = 16
_MOST_LANES = 9


@dataclass(frozen=True)
class Kin:
    """One row of the list."""

    number: int
    """Number of the experiment."""
    parent: int | None
    """Number of the parent experiment."""
    status: str
    """Status of the experiment."""
    winning: bool
    """True for the winner and its ancestors."""


def lanes(rows: Sequence[Kin]) -> dict[int, int]:
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


def draw_lanes(rows: Sequence[Kin]) -> tuple[Html, int]:
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


def _dot(row: Kin, x: int, y: int) -> Html:
    name = {"keep": "kept", "discard": "other", "inconclusive": "other"}.get(row.status, "failed")
    if name == "failed":
        return tag("path", d=f"M{x - 4} {y - 4}l8 8m0 -8l-8 8", class_=name)
    return tag("circle", cx=x, cy=y, r="5", class_=name)


def _x(lane: int) -> int:
    return 10 + lane * _LANE


def _y(row: int) -> int:
    return ROW * row + ROW // 2
