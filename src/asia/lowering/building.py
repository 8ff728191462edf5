"""Building blocks of the lowering rules: values, steps and their errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asia.lowering.ops import Shape
from asia.lowering.program import Builder

Value: TypeAlias = "int | np.ndarray[Any, Any] | np.generic"
"""Number of a value that depends on the signals, or a constant."""
Values: TypeAlias = Sequence[Value]


class CannotLowerError(Exception):
    """Model that cannot be lowered, with the obstacle and the remedy."""


def number(build: Builder, value: Value) -> int:
    """Number of a value in a program; a constant is added to it."""
    return value if isinstance(value, int) else build.constant(value)


class Step:
    """One operation of a jaxpr under lowering, with the program that it is added to."""

    def __init__(self, build: Builder, equation: Any) -> None:
        self.build = build
        self.params: dict[str, Any] = {} if equation is None else dict(equation.params)
        self.shape: Shape = () if equation is None else equation.outvars[0].aval.shape
        self.equation: Any = equation

    def add(self, op: str, *values: Value, attrs: Sequence[int] = ()) -> int:
        numbers = [number(self.build, v) for v in values]
        return self.build.add(op, numbers, tuple(int(a) for a in attrs))

    def wise(self, op: str, *values: Value) -> int:
        """Apply an operation elementwise; a scalar that was broadcast stays a scalar."""
        narrow = [self.narrowed(v) for v in values]
        shapes = [self.shape_of(v) for v in narrow if self.shape_of(v)]
        wide = np.broadcast_shapes(*shapes)
        found = self.add(op, *(self.filling(v, wide) for v in narrow))
        return self.spread(found, np.broadcast_shapes(*(self.shape_of(v) for v in values)))

    def filling(self, value: Value, shape: Shape) -> Value:
        """Broadcast a value to this shape, unless it is a scalar."""
        own = self.shape_of(value)
        if own in ((), shape):
            return value
        if not isinstance(value, int):
            return np.broadcast_to(value, shape)
        return self.add("broadcast", value, attrs=(len(shape), *shape, *range(len(shape))))

    def spread(self, value: int, shape: Shape) -> int:
        if self.build.shape(value) == shape:
            return value
        return self.add("broadcast", value, attrs=(len(shape), *shape))

    def narrowed(self, value: Value) -> Value:
        if isinstance(value, int):
            node = self.build.node(value)
            if node is not None and node.op == "broadcast":
                inner = node.operands[0]
                if self.build.shape(inner) == ():
                    return inner
            return value
        flat = np.asarray(value).reshape(-1)
        if flat.size > 0 and np.ndim(value) and (flat == flat[0]).all():
            return flat[0]
        return value

    def shape_of(self, value: Value) -> Shape:
        return self.build.shape(value) if isinstance(value, int) else np.shape(value)

    def choose(self, which: Value, yes: Value, no: Value, shape: Shape) -> int:
        found = self.add("select", self.narrowed(which), self.narrowed(yes), self.narrowed(no))
        return self.spread(found, shape)

    def reversed_rows(self, value: Value) -> Value:
        if not isinstance(value, int):
            return np.asarray(value)[::-1]
        return picked(self, value, lambda x: x[::-1])


Rule = Callable[[Step, Values], Values]


def picked(at: Step, value: int, move: Callable[[NDArray[np.int64]], Any]) -> int:
    """Rearrange the numbers of a value as `move` rearranges those of an array."""
    shape = at.build.shape(value)
    places = np.asarray(move(np.arange(math.prod(shape)).reshape(shape)))
    attrs = (places.ndim, *places.shape, *places.reshape(-1))
    return at.add("pick", value, attrs=attrs)
