"""Operations of a lowered program, and the shapes of their results.

Every value is an array of float64; truth is 1.0 and 0.0. The table is complete: a program with
another operation, or with inconsistent shapes, is refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

Shape = tuple[int, ...]
Attributes = tuple[int, ...]

_UNARY = (
    "neg abs sign floor sqrt exp log log1p expm1 tanh sin cos tan asin acos atan sinh cosh isfinite"
)
_BINARY = "add sub mul div max min pow atan2 lt le gt ge eq ne"
_MOVES = "reshape broadcast transpose slice pick concat pad"
UNARY = frozenset(_UNARY.split())
"""Elementwise operations of one array."""
BINARY = frozenset(_BINARY.split())
"""Elementwise operations of two arrays of one shape, or of an array and a number."""
REDUCTIONS = frozenset(("rsum", "rmax", "rmin", "rprod"))
"""Sum, greatest, least and product over the axes that the attributes name."""
MOVES = frozenset(_MOVES.split())
"""Operations that only rearrange numbers."""
OPERATIONS = (
    *sorted(UNARY | BINARY | REDUCTIONS | MOVES),
    *("select", "matmul", "loop", "part"),
)
"""All operations; their order gives their numbers in packed programs."""

LARGEST_RANK = 8
LARGEST_SIZE = 1 << 26


class ShapeError(ValueError):
    """Operation that does not fit its operands."""


def shape_of(op: str, attrs: Attributes, shapes: Sequence[Shape]) -> Shape:
    """Shape of the result of an operation.

    The program that holds `loop` and `part` gives their shapes.

    Raises:
        ShapeError: if operands and attributes do not fit together.
    """
    found = _RULES[op](attrs, shapes)
    if len(found) > LARGEST_RANK or any(n < 0 for n in found) or math.prod(found) > LARGEST_SIZE:
        raise ShapeError(f"{op} gives shape {found}")
    return found


def _demand(holds: bool, message: str) -> None:
    if not holds:
        raise ShapeError(message)


def _elementwise(count: int) -> Callable[[Attributes, Sequence[Shape]], Shape]:
    def rule(attrs: Attributes, shapes: Sequence[Shape]) -> Shape:
        _demand(len(shapes) == count and not attrs, f"takes {count} arrays")
        wide = {s for s in shapes if s}
        _demand(len(wide) <= 1, f"shapes {tuple(shapes)} differ")
        return wide.pop() if wide else ()

    return rule


def _one(shapes: Sequence[Shape]) -> Shape:
    _demand(len(shapes) == 1, "takes one array")
    return shapes[0]


def _reduction(attrs: Attributes, shapes: Sequence[Shape]) -> Shape:
    shape = _one(shapes)
    _demand(len(set(attrs)) == len(attrs) > 0, "names an axis twice, or none")
    _demand(all(0 <= a < len(shape) for a in attrs), f"no such axis in {shape}")
    _demand(all(shape[a] > 0 for a in attrs), "reduces nothing")
    return tuple(n for a, n in enumerate(shape) if a not in attrs)


def _reshape(attrs: Attributes, shapes: Sequence[Shape]) -> Shape:
    _demand(math.prod(_one(shapes)) == math.prod(attrs), f"{shapes[0]} is no {attrs}")
    return attrs


def _broadcast(attrs: Attributes, shapes: Sequence[Shape]) -> Shape:
    """attrs: rank of the result, its shape, the axis of the result for each axis of the operand."""
    shape = _one(shapes)
    _demand(len(attrs) == 1 + attrs[0] + len(shape), "takes rank, shape and axes")
    wide, axes = attrs[1 : 1 + attrs[0]], attrs[1 + attrs[0] :]
    _demand(list(axes) == sorted(set(axes)), "axes do not rise")
    for axis, size in zip(axes, shape, strict=True):
        _demand(0 <= axis < len(wide) and size in (1, wide[axis]), f"{shape} does not fill {wide}")
    return wide


def _transpose(attrs: Attributes, shapes: Sequence[Shape]) -> Shape:
    shape = _one(shapes)
    _demand(sorted(attrs) == list(range(len(shape))), "no permutation of the axes")
    return tuple(shape[a] for a in attrs)


def _slice(attrs: Attributes, shapes: Sequence[Shape]) -> Shape:
    """attrs: starts, ends, steps."""
    shape = _one(shapes)
    rank = len(shape)
    _demand(len(attrs) == 3 * rank, "takes starts, ends and steps")
    found: list[int] = []
    for size, start, end, step in zip(
        shape, attrs[:rank], attrs[rank : 2 * rank], attrs[2 * rank :], strict=True
    ):
        _demand(0 <= start <= end <= size and step >= 1, f"{start}:{end}:{step} of {size}")
        found.append(-(-(end - start) // step))
    return tuple(found)


def _pick(attrs: Attributes, shapes: Sequence[Shape]) -> Shape:
    """attrs: rank of the result, its shape, and each number's index in the flattened operand."""
    size = math.prod(_one(shapes))
    wide, places = attrs[1 : 1 + attrs[0]], attrs[1 + attrs[0] :]
    _demand(len(places) == math.prod(wide), "takes a place a number")
    _demand(all(0 <= p < size for p in places), "picks what is not there")
    return wide


def _concat(attrs: Attributes, shapes: Sequence[Shape]) -> Shape:
    _demand(len(shapes) > 0 and len(attrs) == 1, "takes arrays and an axis")
    (axis,), first = attrs, shapes[0]
    _demand(0 <= axis < len(first), f"no such axis in {first}")
    for shape in shapes:
        rest = shape[:axis] + shape[axis + 1 :]
        same = len(shape) == len(first) and rest == first[:axis] + first[axis + 1 :]
        _demand(same, f"shapes {tuple(shapes)} differ")
    return (*first[:axis], sum(s[axis] for s in shapes), *first[axis + 1 :])


def _pad(attrs: Attributes, shapes: Sequence[Shape]) -> Shape:
    """attrs: numbers put before, and numbers put behind, for each axis; the second operand is the
    fill value."""
    _demand(len(shapes) == 2 and shapes[1] == (), "takes an array and a number")
    rank = len(shapes[0])
    _demand(len(attrs) == 2 * rank and min(attrs, default=0) >= 0, "takes two counts an axis")
    return tuple(n + attrs[a] + attrs[rank + a] for a, n in enumerate(shapes[0]))


def _matmul(attrs: Attributes, shapes: Sequence[Shape]) -> Shape:
    _demand(len(shapes) == 2 and not attrs, "takes two matrices")
    left, right = shapes
    _demand(len(left) == len(right) and len(left) in (2, 3), "takes matrices or stacks of them")
    _demand(left[:-2] == right[:-2] and left[-1] == right[-2], f"{left} times {right}")
    return (*left[:-1], right[-1])


_RULES: dict[str, Callable[[Attributes, Sequence[Shape]], Shape]] = {
    **dict.fromkeys(UNARY, _elementwise(1)),
    **dict.fromkeys(BINARY, _elementwise(2)),
    **dict.fromkeys(REDUCTIONS, _reduction),
    "select": _elementwise(3),
    "reshape": _reshape,
    "broadcast": _broadcast,
    "transpose": _transpose,
    "slice": _slice,
    "pick": _pick,
    "concat": _concat,
    "pad": _pad,
    "matmul": _matmul,
}
