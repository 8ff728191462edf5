"""Values of a program node by node, and the index arithmetic of its array operations.

An index counts the numbers of an array row after row.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asia.data.trajectory import Array
from asia.lowering.program import Node, Program, Shape

Places = NDArray[np.int64]


def values_of(
    program: Program,
    inputs: Sequence[Any],
    constant: Callable[[Array], Any],
    value: Callable[[Node, list[Any], list[Shape]], Any],
    loop: Callable[[Node, list[Any], list[Shape]], list[Any]],
) -> list[Any]:
    """Return the values of the outputs of a program, in the way that a target represents values.

    Args:
        program: the program.
        inputs: values of its inputs.
        constant: represents a constant.
        value: represents the result of a node, from the values and shapes of its operands.
        loop: the same for all results of a loop.
    """
    program = program.plain
    shapes, values = program.shapes, [*inputs, *map(constant, program.constants)]
    for node in program.nodes:
        read = [values[i] for i in node.operands]
        if node.op == "part":
            values.append(read[0][node.attrs[0]])
        else:
            make = loop if node.op == "loop" else value
            values.append(make(node, read, [shapes[i] for i in node.operands]))
    return [values[i] for i in program.outputs]


def slices(shapes: Sequence[Shape]) -> list[slice]:
    """Part of a vector that each of these arrays takes up."""
    ends = np.cumsum([math.prod(shape) for shape in shapes], dtype=int).tolist()
    return [slice(end - math.prod(shape), end) for end, shape in zip(ends, shapes, strict=True)]


def kept_axes(shape: Shape, axes: Sequence[int]) -> list[int]:
    """Axes that are not among these."""
    return [a for a in range(len(shape)) if a not in axes]


def _numbered(shape: Shape, start: int = 0) -> Places:
    return start + np.arange(math.prod(shape)).reshape(shape)


def source_places(node: Node, shape: Shape) -> Places:
    """Index in the operand of each number of the result of pick, transpose, slice or broadcast."""
    places, a = _numbered(shape), node.attrs
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


def joined_places(node: Node, shapes: Sequence[Shape]) -> Places:
    """Index of each number of a concat in its operands one after the other."""
    places = [_numbered(s, part.start) for s, part in zip(shapes, slices(shapes), strict=True)]
    return np.concatenate(places, axis=node.attrs[0]).reshape(-1)


def inside_places(node: Node, shape: Shape) -> Places:
    """Index in the result of a pad of each number of its operand."""
    inside = tuple(slice(node.attrs[a], node.attrs[a] + n) for a, n in enumerate(shape))
    return _numbered(node.shape)[inside].reshape(-1)


def reduced_places(node: Node, shape: Shape) -> Places:
    """Indices in the operand of a reduction, a row for each number of the result."""
    order = [*kept_axes(shape, node.attrs), *node.attrs]
    return _numbered(shape).transpose(order).reshape(max(math.prod(node.shape), 1), -1)
