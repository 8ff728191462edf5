"""Lowering rules for primitives that move, sum and multiply arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asia.lowering.building import CannotLowerError, Rule, Step, Value, Values, picked


def reshape(at: Step, v: Values) -> Values:
    """Lower `reshape`, `squeeze` and `expand_dims`."""
    return [at.add("reshape", v[0], attrs=at.shape)]


def broadcast(at: Step, v: Values) -> Values:
    """Lower `broadcast_in_dim`: the operand lies along given axes of the result."""
    axes, shape = at.params["broadcast_dimensions"], at.params["shape"]
    if math.prod(at.shape_of(v[0])) == math.prod(shape):
        return [at.add("reshape", v[0], attrs=shape)]
    return [at.add("broadcast", v[0], attrs=(len(shape), *shape, *axes))]


def transpose(at: Step, v: Values) -> Values:
    """Lower `transpose`."""
    return [transposed(at, v[0], at.params["permutation"])]


def transposed(at: Step, value: Value, axes: Sequence[int]) -> Value:
    """Permute the axes of a value."""
    if list(axes) == sorted(axes):
        return value
    if not isinstance(value, int):
        return np.transpose(value, axes)
    shape = at.build.shape(value)
    moved = [a for a in axes if shape[a] != 1]
    if moved == sorted(moved):
        return at.add("reshape", value, attrs=[shape[a] for a in axes])
    return at.add("transpose", value, attrs=axes)


def reshaped(at: Step, value: Value, shape: Sequence[int]) -> Value:
    """Reshape a value."""
    if not isinstance(value, int):
        return np.reshape(value, shape)
    return at.add("reshape", value, attrs=shape)


def sliced(at: Step, v: Values) -> Values:
    """Lower `slice`."""
    starts, ends = at.params["start_indices"], at.params["limit_indices"]
    steps = at.params["strides"] or (1,) * len(starts)
    return [at.add("slice", v[0], attrs=(*starts, *ends, *steps))]


def dynamic_slice(at: Step, v: Values) -> Values:
    """Lower `dynamic_slice` with constant start indices."""
    if any(isinstance(i, int) for i in v[1:]):
        raise CannotLowerError(
            "cannot be exported: dynamic_slice at a place that is computed; shift a buffer instead"
        )
    sizes, shape = at.params["slice_sizes"], at.shape_of(v[0])
    requested = [int(np.asarray(i)) for i in v[1:]]
    starts = [min(max(i, 0), n - m) for i, n, m in zip(requested, shape, sizes, strict=True)]
    ends = [a + n for a, n in zip(starts, sizes, strict=True)]
    return [at.add("slice", v[0], attrs=(*starts, *ends, *(1 for _ in sizes)))]


def gather(at: Step, v: Values) -> Values:
    """Lower `gather` with constant indices, which JAX itself evaluates."""
    if not isinstance(v[0], int) or isinstance(v[1], int):
        raise CannotLowerError(
            "cannot be exported: gather at places that are computed; use a sum over a one-hot row"
        )
    import jax

    equation = at.equation

    def move(places: NDArray[np.int64]) -> NDArray[np.int64]:
        # Indices outside the array give the fill value, nan.
        with jax.ensure_compile_time_eval():
            operand = jax.numpy.asarray(places, np.float64)
            found = equation.primitive.bind(operand, jax.numpy.asarray(v[1]), **equation.params)
        return np.asarray(found).astype(np.int64)

    return [picked(at, v[0], move)]


def reverse(at: Step, v: Values) -> Values:
    """Lower `rev`: flip along axes."""
    assert isinstance(v[0], int)
    return [picked(at, v[0], lambda x: np.flip(x, at.params["dimensions"]))]


def concat(at: Step, v: Values) -> Values:
    """Lower `concatenate`."""
    axis = at.params["dimension"]
    full = [x for x in v if count(at, x)]
    if len(full) == 1:
        return [full[0]]
    return [at.add("concat", *full, attrs=(axis,))]


def stack(at: Step, v: Values) -> Values:
    """Stack values along a new axis."""
    axis, shape = at.params["axis"], at.shape
    one = (*shape[:axis], 1, *shape[axis + 1 :])
    rows = [at.add("reshape", x, attrs=one) for x in v]
    return [at.add("concat", *rows, attrs=(axis,))]


def count(at: Step, value: Value) -> int:
    """Number of elements of a value."""
    return math.prod(at.shape_of(value))


def split(at: Step, v: Values) -> Values:
    """Lower `split` along an axis."""
    axis, shape, found, start = at.params["axis"], at.shape_of(v[0]), list[Value](), 0
    for size in at.params["sizes"]:
        starts = [start if a == axis else 0 for a in range(len(shape))]
        ends = [start + size if a == axis else n for a, n in enumerate(shape)]
        found.append(at.add("slice", v[0], attrs=(*starts, *ends, *(1 for _ in shape))))
        start += size
    return found


def pad(at: Step, v: Values) -> Values:
    """Lower `pad` with a constant around the array."""
    counts = at.params["padding_config"]
    if any(inner for _, _, inner in counts):
        raise CannotLowerError("cannot be exported: pad between the numbers of an array")
    shape, value = at.shape_of(v[0]), v[0]
    if any(low < 0 or high < 0 for low, high, _ in counts):
        starts = [max(-low, 0) for low, _, _ in counts]
        ends = [n - max(-high, 0) for n, (_, high, _) in zip(shape, counts, strict=True)]
        value = at.add("slice", value, attrs=(*starts, *ends, *(1 for _ in shape)))
    before, behind = [max(c[0], 0) for c in counts], [max(c[1], 0) for c in counts]
    if not any((*before, *behind)):
        return [value]
    return [at.add("pad", value, v[1], attrs=(*before, *behind))]


def reduce(op: str) -> Rule:
    """Make the rule of a reduction over axes."""

    def rule(at: Step, v: Values) -> Values:
        axes, shape = at.params["axes"], at.shape_of(v[0])
        if all(shape[a] == 1 for a in axes):
            return [at.add("reshape", v[0], attrs=at.shape)]
        return [at.add(op, v[0], attrs=axes)]

    return rule


def dot(at: Step, v: Values) -> Values:
    """Lower `dot_general` to a product of matrices."""
    (left_sum, right_sum), (left_batch, right_batch) = at.params["dimension_numbers"]
    shapes = [at.shape_of(x) for x in v]
    sides: list[Value] = []
    kept: list[list[int]] = []
    if 0 in (*shapes[0], *shapes[1]):
        return [np.zeros(at.shape)]
    stack = [shapes[0][a] for a in left_batch]
    inner = math.prod(shapes[0][a] for a in left_sum)
    for side, (value, shape, batch, summed) in enumerate(
        zip(v, shapes, (left_batch, right_batch), (left_sum, right_sum), strict=True)
    ):
        free = [a for a in range(len(shape)) if a not in batch and a not in summed]
        order = (*batch, *free, *summed) if side == 0 else (*batch, *summed, *free)
        wide = math.prod(shape[a] for a in free)
        ends = [wide, inner] if side == 0 else [inner, wide]
        front = [math.prod(stack)] if math.prod(stack) != 1 else []
        sides.append(reshaped(at, transposed(at, value, order), [*front, *ends]))
        kept.append([shape[a] for a in free])
    product = at.add("matmul", *sides)
    return [reshaped(at, product, [*stack, *kept[0], *kept[1]])]
