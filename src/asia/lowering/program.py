"""A lowered program: inputs, constants, operations."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from asia.data.trajectory import Array

# Operations of a lowered program, and the shapes of their results.
#
# Every value is an array of float64; truth is 1.0 and 0.0. The table is complete: a program with
# another operation, or with inconsistent shapes, is refused.


Shape = tuple[int, ...]
Attributes = tuple[int, ...]

_UNARY = (
    "neg abs sign floor sqrt exp log log1p expm1 tanh sin cos tan asin acos atan sinh cosh isfinite"
)
_BINARY = "add sub mul div max min pow atan2 lt le gt ge eq ne"
UNARY = frozenset(_UNARY.split())
"""Elementwise operations of one array."""
BINARY = frozenset(_BINARY.split())
"""Elementwise operations of two arrays of one shape, or of an array and a number."""
REDUCTIONS = frozenset(("rsum", "rmax", "rmin", "rprod"))
"""Sum, greatest, least and product over the axes that the attributes name."""
_MOVES = frozenset(["reshape", "broadcast", "transpose", "slice", "pick", "concat", "pad"])
OPERATIONS = (
    *sorted(UNARY | BINARY | REDUCTIONS | _MOVES),
    *("select", "matmul", "loop", "part", "call", "label"),
)
"""All operations; their order gives their numbers in packed programs."""

FUNCTION = "asia "
"""Start of the name of a JAX function that becomes a call; the names of the function and of its
last inputs follow."""
LARGEST_RANK = 8
LARGEST_SIZE = 1 << 26


class ShapeError(ValueError):
    """Operation that does not fit its operands."""


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


def _label(attrs: Attributes, shapes: Sequence[Shape]) -> Shape:
    """attrs: codes of the characters of a name."""
    _demand(len(names_of(attrs)) == 1, "takes one name")
    return _one(shapes)


def names_of(attrs: Attributes) -> list[str]:
    """Names that the attributes of a label or a call spell. Raises ShapeError for others."""
    text = "".join(chr(code) if 0 < code < 128 else "?" for code in attrs)
    _demand(_SPELT.fullmatch(text) is not None, "has no name")
    return text.split(" ")


_SPELT = re.compile(r"[A-Za-z0-9_]+( [A-Za-z0-9_]+)*")


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
    "label": _label,
}


# Lowered program: inputs, constants and operations in the order they are computed.
#
# Values are numbered: first the inputs, then the constants, then one a node. A node `loop` repeats
# its body; its results are read by nodes `part`. So are those of a node `call`, whose body is a
# function with a name, and a node `label` names its operand: both are for readers of printed code.


@dataclass(frozen=True)
class Node:
    """One operation of a program."""

    op: str
    """Operation, one of `ops.OPERATIONS`."""
    operands: tuple[int, ...]
    """Numbers of the values that the operation reads."""
    attrs: Attributes
    """Constant attributes. Those of a loop are the number of iterations, of constant values and of
    carried values; the operands that follow these are read row by row. Those of a call spell the
    names of the function and its last inputs, those of a label a name."""
    shape: Shape
    """Shape of the result; () for a loop or a call."""
    body: Program | None = None
    """Body of a loop: (constant, carried, rows) -> (carried, results that are stacked), or of a
    call."""


@dataclass(frozen=True)
class Program:
    """Function of arrays as a list of operations."""

    inputs: tuple[Shape, ...]
    """Shapes of the inputs."""
    constants: tuple[Array, ...]
    """Constant arrays."""
    nodes: tuple[Node, ...]
    """Operations, each after those it reads."""
    outputs: tuple[int, ...]
    """Numbers of the output values."""

    @property
    def first_node(self) -> int:
        """Number of the first node's value."""
        return len(self.inputs) + len(self.constants)

    @property
    def shapes(self) -> list[Shape]:
        """Shapes of all values."""
        constants = [c.shape for c in self.constants]
        return [*self.inputs, *constants, *(n.shape for n in self.nodes)]

    @property
    def output_shapes(self) -> tuple[Shape, ...]:
        """Shapes of the outputs."""
        shapes = self.shapes
        return tuple(shapes[i] for i in self.outputs)

    @cached_property
    def plain(self) -> Program:
        """The program without calls and labels, for readers that need no names."""
        if all(
            node.op not in ("call", "label") and (node.body is None or node.body.plain is node.body)
            for node in self.nodes
        ):
            return self
        build = Builder(self.inputs)
        return build.program(inlined(build, self, range(len(self.inputs)), plain=True))

    def with_outputs(self, outputs: Sequence[int]) -> Program:
        """Make a program of the same inputs with other outputs, without the nodes that they do not
        need."""
        build = Builder(self.inputs)
        numbers = list(range(len(self.inputs)))
        numbers += [build.constant(constant) for constant in self.constants]
        for node in self.nodes:
            operands = [numbers[i] for i in node.operands]
            numbers.append(build.add(node.op, operands, node.attrs, node.body))
        return build.program([numbers[i] for i in outputs])


@dataclass(frozen=True)
class LoweredModel:
    """Lowered model that simulates one sample after the other."""

    n_past_u: int
    """Number of inputs in the past window."""
    n_past_y: int
    """Number of outputs in the past window."""
    nu: int
    """Number of inputs."""
    ny: int
    """Number of outputs."""
    single: bool
    """The model itself computes in single precision."""
    initial: Program
    """past_u (n_past_u, nu), past_y (n_past_y, ny), first input (nu,) -> states."""
    step: Program
    """States and input (nu,) -> output (ny,) of this sample, and the states at the next."""

    @property
    def states(self) -> tuple[Shape, ...]:
        """Shapes of the states."""
        return self.step.inputs[:-1]

    @cached_property
    def output(self) -> Program:
        """Program from states and input to the output."""
        return self.step.with_outputs(self.step.outputs[:1])

    @cached_property
    def update(self) -> Program:
        """Program from states and input to the states at the next sample."""
        return self.step.with_outputs(self.step.outputs[1:])

    def check(self) -> None:
        """Check that the parts fit together. Raises ShapeError if they do not."""
        window = ((self.n_past_u, self.nu), (self.n_past_y, self.ny), (self.nu,))
        if self.initial.inputs != window or self.step.inputs[-1:] != ((self.nu,),):
            raise ShapeError("programs read other signals than the model has")
        if self.initial.output_shapes != self.states:
            raise ShapeError("the states at the start differ from those of a step")
        if self.step.output_shapes != ((self.ny,), *self.states):
            raise ShapeError("a step gives other shapes than it reads")


@dataclass
class Builder:
    """Builder of a program that keeps equal values once."""

    inputs: tuple[Shape, ...]
    _values: list[Array | Node] = field(default_factory=list[Array | Node])
    _known: dict[object, int] = field(default_factory=dict[object, int])

    def constant(self, value: object) -> int:
        """Add a constant and return its number."""
        array = np.array(value, np.float64, order="C")
        if np.isnan(array).any():
            raise ShapeError("a constant is no number")
        return self._kept(("constant", array.shape, array.tobytes()), array)

    def add(
        self, op: str, operands: Sequence[int], attrs: Attributes = (), body: Program | None = None
    ) -> int:
        """Add an operation and return the number of its result. Raises ShapeError if operands and
        attributes do not fit together."""
        shapes = [self.shape(i) for i in operands]
        if op != "part" and any(n and n.op in ("loop", "call") for n in map(self.node, operands)):
            raise ShapeError(f"{op} reads a loop or call in whole, and not a part of it")
        if op in ("loop", "call"):
            _check_body(op, attrs, shapes, body)
            shape: Shape = ()
        elif op == "part":
            shape = _part_shape(attrs, [self._values[i - len(self.inputs)] for i in operands])
        else:
            shape = _RULES[op](attrs, shapes)
            large = len(shape) > LARGEST_RANK or math.prod(shape) > LARGEST_SIZE
            if large or any(n < 0 for n in shape):
                raise ShapeError(f"{op} gives shape {shape}")
        same = self._without_effect(op, operands, attrs, shape)
        if same is not None:
            return same
        inner = self.node(operands[0]) if op == "reshape" else None
        if inner is not None and inner.op == "reshape":
            return self.add("reshape", inner.operands, attrs)
        node = Node(op, tuple(operands), attrs, shape, body)
        return self._kept((op, node.operands, attrs, id(body) if body else None), node)

    def _without_effect(
        self, op: str, operands: Sequence[int], attrs: Attributes, shape: Shape
    ) -> int | None:
        """Operand that already equals the result; None if something is computed."""
        if op in ("reshape", "broadcast") and shape == self.shape(operands[0]):
            return operands[0]
        if op == "concat" and len(operands) == 1:
            return operands[0]
        if op == "pick" and shape == self.shape(operands[0]):
            places = attrs[1 + attrs[0] :]
            return operands[0] if places == tuple(range(len(places))) else None
        for rest, neutral in (_NEUTRAL.get(op, {})).items():
            other = self.known(operands[1 - rest])
            if (
                other is not None
                and (other == neutral).all()
                and self.shape(operands[rest]) == shape
            ):
                return operands[rest]
        return None

    def shape(self, value: int) -> Shape:
        """Shape of a value."""
        if value < len(self.inputs):
            return self.inputs[value]
        return self._values[value - len(self.inputs)].shape

    def node(self, value: int) -> Node | None:
        """Node that computes a value; None for an input or a constant."""
        found = self._values[value - len(self.inputs)] if value >= len(self.inputs) else None
        return found if isinstance(found, Node) else None

    def known(self, value: int) -> Array | None:
        """Array of a constant; None for other values."""
        found = self._values[value - len(self.inputs)] if value >= len(self.inputs) else None
        return None if isinstance(found, Node) else found

    def program(self, outputs: Sequence[int]) -> Program:
        """Finish the program: constants before nodes, without the nodes that the outputs do not
        need."""
        first, needed = len(self.inputs), set(outputs)
        for i in range(len(self._values) - 1, -1, -1):
            value = self._values[i]
            if first + i in needed and isinstance(value, Node):
                needed.update(value.operands)
        used = [i for i in range(len(self._values)) if first + i in needed]
        constants = [i for i in used if not isinstance(self._values[i], Node)]
        order = [*constants, *(i for i in used if isinstance(self._values[i], Node))]
        names = {i: i for i in range(first)} | {first + i: first + k for k, i in enumerate(order)}
        arrays: list[Array] = []
        nodes: list[Node] = []
        for i in order:
            value = self._values[i]
            if isinstance(value, Node):
                nodes.append(replace(value, operands=tuple(names[o] for o in value.operands)))
            else:
                arrays.append(value)
        return Program(self.inputs, tuple(arrays), tuple(nodes), tuple(names[i] for i in outputs))

    def _kept(self, key: object, value: Array | Node) -> int:
        if key not in self._known:
            self._values.append(value)
            self._known[key] = len(self.inputs) + len(self._values) - 1
        return self._known[key]


def inlined(
    build: Builder, program: Program, inputs: Sequence[int], *, plain: bool = False
) -> list[int]:
    """Inline a program into another one and return the numbers of its outputs there; `plain`
    inlines the functions that it calls too, and leaves labels out."""
    values = [*inputs, *(build.constant(c) for c in program.constants)]
    results: dict[int, list[int]] = {}
    for place, node in enumerate(program.nodes, program.first_node):
        operands, body = [values[i] for i in node.operands], node.body
        if plain and node.op == "call" and body is not None:
            results[place] = inlined(build, body, operands, plain=True)
            values.append(-1)
        elif plain and node.op == "label":
            values.append(operands[0])
        elif node.op == "part" and node.operands[0] in results:
            values.append(results[node.operands[0]][node.attrs[0]])
        else:
            body = body.plain if plain and body is not None else body
            values.append(build.add(node.op, operands, node.attrs, body))
    return [values[i] for i in program.outputs]


# Neutral elements of the operations: for each operand, the value of the other one with which the
# result equals the operand.
_NEUTRAL = {"add": {0: 0.0, 1: 0.0}, "sub": {0: 0.0}, "mul": {0: 1.0, 1: 1.0}, "div": {0: 1.0}}


def _check_body(op: str, attrs: Attributes, shapes: Sequence[Shape], body: Program | None) -> None:
    if op == "call":
        fits = body is not None and body.inputs == tuple(shapes)
        if not fits or len(names_of(attrs)) > 1 + len(shapes):
            raise ShapeError("a call takes its name, those of inputs, and a body that reads them")
        return
    if body is None or len(attrs) != 3 or min(attrs) < 0:
        raise ShapeError("a loop takes a body and three counts")
    length, same, carried = attrs
    whole, rows = list(shapes[: same + carried]), shapes[same + carried :]
    if any(len(s) == 0 or s[0] != length for s in rows) or len(whole) != same + carried:
        raise ShapeError(f"a loop of {length} iterations reads rows of {tuple(rows)}")
    if list(body.inputs) != whole + [s[1:] for s in rows]:
        raise ShapeError("the body of a loop reads other shapes")
    if list(body.output_shapes[:carried]) != whole[same:]:
        raise ShapeError("a loop carries other shapes than its body gives")


def _part_shape(attrs: Attributes, operands: Sequence[object]) -> Shape:
    loop = operands[0] if len(operands) == 1 else None
    if not isinstance(loop, Node) or loop.body is None or len(attrs) != 1:
        raise ShapeError("a part belongs to a loop or a call")
    shapes = loop.body.output_shapes
    if not 0 <= attrs[0] < len(shapes):
        raise ShapeError("a loop or a call has no such part")
    stacked = loop.op == "loop" and attrs[0] >= loop.attrs[2]
    return ((loop.attrs[0],) if stacked else ()) + shapes[attrs[0]]
