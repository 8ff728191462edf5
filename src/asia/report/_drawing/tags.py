"""Find places for text boxes beside the points they speak of: no two overlap, none covers a point,
none leaves the frame, no leader line crosses another. All lengths share one unit, x to the right
and y up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asia.data import Array

Mask = NDArray[np.bool_]

_STEP = 4.0
_GAP = 5.0
_CROSSED_LINE = 45.0
_CROSSED_POINT = 90.0
_ALONG_LINE = 60.0


@dataclass(frozen=True)
class Tag:
    """Text of size (width, height) that speaks of the point `anchor`."""

    anchor: tuple[float, float]
    size: tuple[float, float]


@dataclass(frozen=True)
class Placement:
    """Lower left corner of a tag, and the end of its leader line on the rim of the box."""

    corner: tuple[float, float]
    leader: tuple[float, float]


@dataclass(frozen=True)
class Surroundings:
    """frame: (x0, y0, x1, y1); points (m, 2) must stay visible, within `radius`; lines (k, 4) are
    segments x0, y0, x1, y1 better left uncovered; `reach` is the longest leader."""

    frame: tuple[float, float, float, float]
    points: Array
    radius: float
    lines: Array
    reach: float


def place(tags: Sequence[Tag], around: Surroundings) -> tuple[Placement | None, ...]:
    """A place for each tag, the first ones served first; None where there is no room."""
    places: list[Placement | None] = []
    boxes, leaders = np.empty((0, 4)), np.empty((0, 4))
    for tag in tags:
        found = _best(tag, around, boxes, leaders)
        places.append(found)
        if found is not None:
            boxes = np.vstack([boxes, _box(found, tag)])
            leaders = np.vstack([leaders, [*tag.anchor, *found.leader]])
    return tuple(places)


def _box(found: Placement, tag: Tag) -> Array:
    x, y = found.corner
    return np.array([x, y, x + tag.size[0], y + tag.size[1]])


def _best(tag: Tag, around: Surroundings, boxes: Array, leaders: Array) -> Placement | None:
    anchor = np.array(tag.anchor)
    candidates = _grid(tag, around.frame)
    near = np.clip(anchor, candidates[:, :2], candidates[:, 2:]) - anchor
    candidates = candidates[np.hypot(near[:, 0], near[:, 1]) < around.reach]
    around_points = np.hstack([around.points - around.radius, around.points + around.radius])
    free = ~_overlap(candidates, _grow(boxes, _GAP)).any(axis=1)
    free &= ~_overlap(candidates, around_points).any(axis=1)
    free &= ~crosses(candidates, leaders).any(axis=1)
    candidates = candidates[free]
    if len(candidates) == 0:
        return None
    ends = np.clip(anchor, candidates[:, :2], candidates[:, 2:])
    own = np.hstack([np.broadcast_to(anchor, ends.shape), ends])
    clear = ~crosses(_grow(boxes, 1.0), own).any(axis=0) & ~_cut(own, leaders).any(axis=1)
    candidates, ends, own = candidates[clear], ends[clear], own[clear]
    if len(candidates) == 0:
        return None
    others = around_points[(np.abs(around.points - anchor) > 1e-9).any(axis=1)]
    cost = np.hypot(*(ends - anchor).T)
    cost += _CROSSED_LINE * crosses(_grow(candidates, _GAP), around.lines).sum(axis=1)
    cost += _CROSSED_POINT * crosses(others, own).sum(axis=0)
    for point in (ends, (ends + anchor) / 2):
        cost += _ALONG_LINE * _on_line(point, around.lines)
    chosen = int(np.argmin(cost))
    corner, end = candidates[chosen, :2], ends[chosen]
    return Placement((float(corner[0]), float(corner[1])), (float(end[0]), float(end[1])))


def _grid(tag: Tag, frame: tuple[float, float, float, float]) -> Array:
    """All boxes of the tag's size inside the frame, on a grid."""
    x = np.arange(frame[0], frame[2] - tag.size[0], _STEP)
    y = np.arange(frame[1], frame[3] - tag.size[1], _STEP)
    corners = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.hstack([corners, corners + np.array(tag.size)])


def _on_line(points: Array, lines: Array) -> Mask:
    """Whether a point lies on one of the lines, so that a leader there would be lost on it."""
    low = np.minimum(lines[:, :2], lines[:, 2:]) - _STEP
    high = np.maximum(lines[:, :2], lines[:, 2:]) + _STEP
    inside = (low < points[:, None]) & (points[:, None] < high)
    return np.asarray(inside.all(axis=-1).any(axis=-1))


def _grow(boxes: Array, by: float) -> Array:
    return boxes + np.array([-by, -by, by, by])


def _overlap(a: Array, b: Array) -> Mask:
    a, b = a[:, None, :], b[None, :, :]
    low = np.maximum(a[..., :2], b[..., :2])
    high = np.minimum(a[..., 2:], b[..., 2:])
    return np.asarray((low < high).all(axis=-1))


def crosses(boxes: Array, segments: Array) -> Mask:
    """Whether segment j passes through box i, (boxes, segments): the slab test, in which a segment
    that runs along an axis is inside or outside that slab for its whole length."""
    start, step = segments[None, :, :2], (segments[:, 2:] - segments[:, :2])[None]
    low, high = boxes[:, None, :2], boxes[:, None, 2:]
    still = np.abs(step) < 1e-12
    safe = np.where(still, 1.0, step)
    a, b = (low - start) / safe, (high - start) / safe
    inside = (low < start) & (start < high)
    enter = np.where(still, np.where(inside, -np.inf, np.inf), np.minimum(a, b)).max(axis=-1)
    leave = np.where(still, np.where(inside, np.inf, -np.inf), np.maximum(a, b)).min(axis=-1)
    return np.maximum(enter, 0.0) < np.minimum(leave, 1.0)


def _cut(a: Array, b: Array) -> Mask:
    """Whether segments a[i] and b[j] cross."""
    p, q = a[:, None, :], b[None, :, :]

    def side(s: Array, x: Array, y: Array) -> Array:
        return (s[..., 2] - s[..., 0]) * (y - s[..., 1]) - (s[..., 3] - s[..., 1]) * (x - s[..., 0])

    apart = side(p, q[..., 0], q[..., 1]) * side(p, q[..., 2], q[..., 3])
    across = side(q, p[..., 0], p[..., 1]) * side(q, p[..., 2], p[..., 3])
    return (apart < 0) & (across < 0)
