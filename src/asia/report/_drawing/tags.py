"""Placement of labels near their points, for SVG and matplotlib: no two overlap, none covers a
point, none leaves the frame. x points right, y down.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

LINE = 15.0
"""Height of a line of text."""
_RISES = (8.0, 22.0, -22.0, 36.0, -36.0, 52.0, -52.0)
_RADIUS = 5.0


@dataclass(frozen=True)
class Box:
    """A rectangle that a text or a marker takes up."""

    left: float
    top: float
    right: float
    bottom: float

    def meets(self, other: Box) -> bool:
        """Return whether two boxes overlap."""
        apart = self.right < other.left or other.right < self.left
        return not (apart or self.bottom < other.top or other.bottom < self.top)

    def holds(self, other: Box) -> bool:
        """Return whether the other box is inside this one."""
        across = self.left <= other.left and other.right <= self.right
        return across and self.top <= other.top and other.bottom <= self.bottom


@dataclass(frozen=True)
class Tag:
    """A text of size (width, height) for the point `anchor`."""

    anchor: tuple[float, float]
    size: tuple[float, float]


def place(
    tags: Sequence[Tag], points: Sequence[tuple[float, float]], frame: Box
) -> tuple[Box | None, ...]:
    """A place for each tag, the first ones served first; None where there is no room. points: must
    stay visible."""
    taken = [Box(x - _RADIUS, y - _RADIUS, x + _RADIUS, y + _RADIUS) for x, y in points]
    places: list[Box | None] = []
    for tag in tags:
        free = (b for b in _candidates(tag) if frame.holds(b) and not any(map(b.meets, taken)))
        found = next(free, None)
        places.append(found)
        if found is not None:
            taken.append(found)
    return tuple(places)


def _candidates(tag: Tag) -> list[Box]:
    """Above, below, to the right and to the left of the point, the nearest first."""
    (x, y), (width, height) = tag.anchor, tag.size
    found: list[Box] = []
    for rise in _RISES:
        for left in (x + 2, x - width / 2, x - width - 2, x - 24):
            top = y - rise - height if rise > 0 else y - rise - LINE + 2
            found.append(Box(left, top, left + width, top + height))
    return found
