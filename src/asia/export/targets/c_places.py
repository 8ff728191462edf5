"""Index arithmetic of array operations in printed C."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asia.lowering import Node, Program, Shape


def last_uses(program: Program) -> dict[int, int]:
    """Number of the last node that reads each value."""
    found: dict[int, int] = {}
    for place, node in enumerate(program.nodes, program.first_node):
        for i in node.operands:
            found[i] = place
    return found


def strides(shape: Shape) -> list[int]:
    """Distance between neighbouring numbers along each axis."""
    return [math.prod(shape[a + 1 :]) for a in range(len(shape))]


def kept_axes(shape: Shape, axes: Sequence[int]) -> list[int]:
    """Axes that are not among these."""
    return [a for a in range(len(shape)) if a not in axes]


def source_places(node: Node, shape: Shape) -> NDArray[np.int64]:
    """Index in the operand of each number of the result."""
    places, a = np.arange(math.prod(shape)).reshape(shape), node.attrs
    if node.op == "pick":
        return np.array(a[1 + a[0] :], np.int64)
    if node.op == "transpose":
        return places.transpose(a).reshape(-1)
    if node.op == "slice":
        rank = len(shape)
        cut = tuple(slice(a[i], a[rank + i], a[2 * rank + i]) for i in range(rank))
        return places[cut].reshape(-1)
    wide, axes = a[1 : 1 + a[0]], a[1 + a[0] :]
    narrow = [1] * len(wide)
    for axis, size in zip(axes, shape, strict=True):
        narrow[axis] = size
    return np.broadcast_to(places.reshape(narrow), wide).reshape(-1)


def runs(places: NDArray[np.int64]) -> list[tuple[int, int, int]]:
    """Split indices into segments (first, step, count) of constant step."""
    found: list[tuple[int, int, int]] = []
    rest = places.tolist()
    i = 0
    while i < len(rest):
        step = rest[i + 1] - rest[i] if i + 1 < len(rest) else 1
        count = 1
        while i + count < len(rest) and rest[i + count] - rest[i + count - 1] == step:
            count += 1
        found.append((rest[i], step, count))
        i += count
    return found
