"""Exact derivatives of lowered programs, as programs: forward accumulation over all directions.

A value of shape s has a tangent of shape (K, *s), one row for each of the K numbers of the inputs
that vary. Without a tangent a value does not depend on them. At a corner of a function the
derivative is that of the side that the function takes. Source: Griewank and Walther, Evaluating
Derivatives, 2nd ed., SIAM 2008, chapter 3.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from asia.data.trajectory import Array
from asia.lowering.evaluation import evaluate
from asia.lowering.program import Builder, Node, Program, Shape, ShapeError


def jacobian(program: Program, varying: Sequence[int] | None = None) -> Program:
    """Program of the outputs and of their derivatives (m, K) by all numbers of the inputs that
    vary, one after the other.

    Args:
        varying: numbers of those inputs; default: all

    Raises:
        ShapeError: for an operation that cannot be differentiated
    """
    program = program.plain
    varying = range(len(program.inputs)) if varying is None else varying
    sizes = [math.prod(program.inputs[i]) for i in varying]
    count = sum(sizes)
    build = Builder(program.inputs)
    tangents: list[int | None] = [None] * len(program.inputs)
    for which, size, first in zip(varying, sizes, np.cumsum([0, *sizes]), strict=False):
        seed = np.eye(count)[:, first : first + size]
        tangents[which] = build.constant(seed.reshape(count, *program.inputs[which]))
    inputs = list(range(len(program.inputs)))
    found = _Tangents(build, count).through(program, inputs, tangents)
    rows: list[int] = []
    for value, tangent in found:
        size = math.prod(build.shape(value))
        if tangent is None:
            tangent = build.constant(np.zeros((count, size)))
        rows.append(build.add("reshape", (tangent,), (count, size)))
    slopes = build.add("transpose", (build.add("concat", rows, (1,)),), (1, 0))
    return build.program([*(value for value, _ in found), slopes])


def derivatives(program: Program, inputs: Sequence[Array]) -> tuple[Array, Array]:
    """Outputs (m,) of a program, one after the other, and their exact derivatives (m, n) by all
    numbers of the inputs."""
    *values, slopes = evaluate(jacobian(program), inputs)
    return np.concatenate([np.reshape(value, -1) for value in values]), slopes


@dataclass(frozen=True)
class _Tangents:
    """Values with tangents in `count` directions, added to a program."""

    build: Builder
    count: int

    def through(
        self, program: Program, inputs: Sequence[int], tangents: Sequence[int | None]
    ) -> list[tuple[int, int | None]]:
        """Inline a program and return its outputs with their tangents."""
        build = self.build
        values = [*inputs, *(build.constant(one) for one in program.constants)]
        slopes: list[int | None] = [*tangents, *(None for _ in program.constants)]
        loops: dict[int, list[tuple[int, int | None]]] = {}
        for place, node in enumerate(program.nodes, program.first_node):
            read, moved = [values[i] for i in node.operands], [slopes[i] for i in node.operands]
            if node.op == "loop":
                loops[place] = self._loop(node, read, moved)
                values.append(-1)
                slopes.append(None)
                continue
            if node.op == "part":
                value, slope = loops[node.operands[0]][node.attrs[0]]
            else:
                value = build.add(node.op, read, node.attrs)
                moves = any(one is not None for one in moved)
                slope = self._tangent(node, read, moved, value) if moves else None
            values.append(value)
            slopes.append(slope)
        return [(values[i], slopes[i]) for i in program.outputs]

    # Arithmetic on tangents; None is zero.

    def _op(self, op: str, *operands: int | float) -> int:
        each = [self.build.constant(v) if isinstance(v, float) else v for v in operands]
        return self.build.add(op, each)

    def _lifted(self, value: int) -> int:
        """A value of shape s in all directions (K, *s); a number stays one."""
        shape = self.build.shape(value)
        if not shape:
            return value
        wide = (self.count, *shape)
        return self.build.add("broadcast", (value,), (len(wide), *wide, *range(1, len(wide))))

    def _spread(self, tangent: int, shape: Shape) -> int:
        """The tangent of a number, as that of all numbers of an array."""
        wide = (self.count, *shape)
        if self.build.shape(tangent) == wide:
            return tangent
        return self.build.add("broadcast", (tangent,), (len(wide), *wide, 0))

    def _times(
        self, tangent: int | None, factor: int | float, shape: Shape, *, steep: bool
    ) -> int | None:
        if tangent is None:
            return None
        wide = self._spread(tangent, shape)
        if isinstance(factor, float):
            return wide if factor == 1.0 else self._op("mul", wide, factor)
        found = self._op("mul", wide, self._lifted(factor))
        return self._op("select", self._op("ne", wide, 0.0), found, 0.0) if steep else found

    def _sum(self, *tangents: int | None) -> int | None:
        known = [one for one in tangents if one is not None]
        total = known[0] if known else None
        for one in known[1:]:
            assert total is not None
            total = self._op("add", total, one)
        return total

    def _zeros(self, value: int) -> int:
        return self.build.constant(np.zeros((self.count, *self.build.shape(value))))

    def _tangent(
        self, node: Node, read: Sequence[int], moved: Sequence[int | None], value: int
    ) -> int | None:
        op, attrs, shape = node.op, node.attrs, node.shape
        if op in _SLOPES or op in _PARTIAL:
            if op in _SLOPES:
                slopes = (_SLOPES[op](self._op, read[0], value),)
            else:
                slopes = _PARTIAL[op](self._op, read[0], read[1], value)
            each = [
                self._times(t, s, shape, steep=op in _STEEP)
                for t, s in zip(moved, slopes, strict=True)
            ]
            return self._sum(*each)
        if op in _CHOSEN or op == "select":
            chosen = read[0] if op == "select" else self._op(_CHOSEN[op], read[0], read[1])
            sides = [0.0 if t is None else self._spread(t, shape) for t in moved[-2:]]
            if sides == [0.0, 0.0]:
                return None
            return self._op("select", self._lifted(chosen), *sides)
        if op in _CONSTANT:
            return None
        (first, *_), wide = moved, (self.count, *shape)
        if op == "concat":
            each = [self._zeros(v) if t is None else t for v, t in zip(read, moved, strict=True)]
            return self.build.add("concat", each, (attrs[0] + 1,))
        if op == "matmul":
            return self._sum(self._left(read, moved[0], wide), self._right(read, moved[1], wide))
        if op == "pad" and moved[1] is not None:
            raise ShapeError("the number that pads an array has no derivative")
        assert first is not None
        return self._moved(op, attrs, first, read[0], value, wide)

    def _moved(
        self, op: str, attrs: Sequence[int], tangent: int, source: int, value: int, wide: Shape
    ) -> int:
        """Tangent of an operation that moves, sums or multiplies the numbers of one array."""
        build, shape = self.build, self.build.shape(source)
        rank = len(shape)
        if op == "reshape":
            return build.add("reshape", (tangent,), wide)
        if op == "broadcast":
            axes = [axis + 1 for axis in attrs[1 + attrs[0] :]]
            return build.add("broadcast", (tangent,), (len(wide), *wide, 0, *axes))
        if op == "transpose":
            return build.add("transpose", (tangent,), (0, *(axis + 1 for axis in attrs)))
        if op == "slice":
            starts, ends, steps = (attrs[k * rank : (k + 1) * rank] for k in range(3))
            whole = (0, *starts, self.count, *ends, 1, *steps)
            return build.add("slice", (tangent,), whole)
        if op == "pick":
            places = np.asarray(attrs[1 + attrs[0] :], np.int64)
            every = places + math.prod(shape) * np.arange(self.count)[:, None]
            return build.add("pick", (tangent,), (len(wide), *wide, *every.reshape(-1).tolist()))
        if op == "pad":
            counts = (0, *attrs[:rank], 0, *attrs[rank:])
            return build.add("pad", (tangent, build.constant(0.0)), counts)
        over = tuple(axis + 1 for axis in attrs)
        if op == "rsum":
            return build.add("rsum", (tangent,), over)
        if op in ("rmax", "rmin"):
            # Mean over equal elements.
            kept = [axis for axis in range(rank) if axis not in attrs]
            again = build.add("broadcast", (value,), (rank, *shape, *kept))
            equal = self._op("eq", source, again)
            share = self._lifted(build.add("rsum", (equal,), tuple(attrs)))
            total = build.add("rsum", (self._op("mul", tangent, self._lifted(equal)),), over)
            return self._op("div", total, share)
        if op != "rprod":
            raise ShapeError(f"{op} has no derivative")
        # Product rule, one factor after the other.
        kept = [axis for axis in range(rank) if axis not in attrs]
        size = math.prod(shape[axis] for axis in attrs)
        rows = build.add("transpose", (source,), (*attrs, *kept))
        rows = build.add("reshape", (rows,), (size, *wide[1:]))
        slopes = build.add("transpose", (tangent,), (*over, 0, *(axis + 1 for axis in kept)))
        slopes = build.add("reshape", (slopes,), (size, *wide))

        def row(stacked: int, k: int, one: Shape) -> int:
            ends, zeros = (k + 1, *one), (0,) * len(one)
            cut = build.add("slice", (stacked,), (k, *zeros, *ends, 1, *(1 for _ in one)))
            return build.add("reshape", (cut,), one)

        product, slope = row(rows, 0, wide[1:]), row(slopes, 0, wide)
        for k in range(1, size):
            factor, change = row(rows, k, wide[1:]), row(slopes, k, wide)
            before = self._op("mul", change, self._lifted(product))
            slope = self._op("add", self._op("mul", slope, self._lifted(factor)), before)
            product = self._op("mul", product, factor)
        return slope

    def _left(self, read: Sequence[int], tangent: int | None, wide: Shape) -> int | None:
        """Tangent of the left factor times the right one."""
        if tangent is None:
            return None
        build, right = self.build, read[1]
        *stack, inner, columns = build.shape(right)
        if not stack:
            rows = build.add("reshape", (tangent,), (self.count * wide[1], inner))
            return build.add("reshape", (build.add("matmul", (rows, right)),), wide)
        every = (self.count * stack[0], wide[2], inner)
        rows = build.add("reshape", (tangent,), every)
        fixed = build.add("reshape", (self._lifted(right),), (every[0], inner, columns))
        return build.add("reshape", (build.add("matmul", (rows, fixed)),), wide)

    def _right(self, read: Sequence[int], tangent: int | None, wide: Shape) -> int | None:
        """The left factor times the tangent of the right one."""
        if tangent is None:
            return None
        build, left = self.build, read[0]
        *stack, rows, inner = build.shape(left)
        columns = wide[-1]
        if not stack:
            # All directions as columns of one matrix.
            side = build.add("transpose", (tangent,), (1, 0, 2))
            side = build.add("reshape", (side,), (inner, self.count * columns))
            found = build.add("reshape", (build.add("matmul", (left, side)),),
                              (rows, self.count, columns))  # fmt: skip
            return build.add("transpose", (found,), (1, 0, 2))
        many = self.count * stack[0]
        fixed = build.add("reshape", (self._lifted(left),), (many, rows, inner))
        side = build.add("reshape", (tangent,), (many, inner, columns))
        return build.add("reshape", (build.add("matmul", (fixed, side)),), wide)

    def _loop(
        self, node: Node, read: Sequence[int], moved: Sequence[int | None]
    ) -> list[tuple[int, int | None]]:
        """A loop that carries the tangents too; those of its rows come iteration first."""
        length, same, carried = node.attrs
        assert node.body is not None
        if all(one is None for one in moved):
            loop = self.build.add("loop", read, node.attrs, node.body)
            parts = [self.build.add("part", (loop,), (k,)) for k in range(len(node.body.outputs))]
            return [(part, None) for part in parts]
        build = self.build
        fixed = [one for one in moved[:same] if one is not None]
        carry = [
            self._zeros(v) if t is None else t
            for v, t in zip(read[same : same + carried], moved[same : same + carried], strict=True)
        ]
        rows = [self._first(t, 1) for t in moved[same + carried :] if t is not None]
        # Inputs of the body: values and tangents, first constant, then carried, then rows.
        operands = [*read[:same], *fixed, *read[same : same + carried], *carry,
                    *read[same + carried :], *rows]  # fmt: skip
        constant, changing = same + len(fixed), 2 * carried
        shapes = [build.shape(i) for i in operands]
        shapes[constant + changing :] = [shape[1:] for shape in shapes[constant + changing :]]
        body = Builder(tuple(shapes))
        values = [*range(same), *range(constant, constant + carried)]
        first_row = constant + changing
        values += range(first_row, first_row + len(read) - same - carried)
        places = iter([*range(same, constant), *range(constant + carried, first_row),
                       *range(first_row + len(read) - same - carried, len(operands))])  # fmt: skip
        active = [one is not None or same <= k < same + carried for k, one in enumerate(moved)]
        inner = _Tangents(body, self.count)
        found = inner.through(
            node.body, values, [next(places) if moves else None for moves in active]
        )
        full = [(v, inner._zeros(v) if t is None else t) for v, t in found]
        after, stacked = full[:carried], full[carried:]
        outputs = [v for v, _ in after] + [t for _, t in after]
        outputs += [v for v, _ in stacked] + [t for _, t in stacked]
        attrs = (length, constant, changing)
        loop = build.add("loop", operands, attrs, body.program(outputs))
        parts = [build.add("part", (loop,), (k,)) for k in range(len(outputs))]
        ends, more = parts[changing:], len(stacked)
        return [
            *zip(parts[:carried], parts[carried:changing], strict=True),
            *((v, self._first(t, 1)) for v, t in zip(ends[:more], ends[more:], strict=True)),
        ]

    def _first(self, value: int, axis: int) -> int:
        """Exchange the first axis with another one: directions and iterations."""
        axes = list(range(len(self.build.shape(value))))
        axes[0], axes[axis] = axis, 0
        return self.build.add("transpose", (value,), tuple(axes))


_Op = Callable[..., int]
_Slope = Callable[[_Op, int, int], int | float]


def _power_slopes(op: _Op, base: int, exponent: int, value: int) -> tuple[int, int]:
    positive = op("gt", base, 0.0)
    logarithm = op("log", op("select", positive, base, 1.0))
    return (
        op("mul", exponent, op("pow", base, op("sub", exponent, 1.0))),
        op("select", positive, op("mul", value, logarithm), 0.0),
    )


def _angle_slopes(op: _Op, y: int, x: int, value: int) -> tuple[int, int]:
    square = op("add", op("mul", x, x), op("mul", y, y))
    return op("div", x, square), op("neg", op("div", y, square))


def _arc(op: _Op, x: int) -> int:
    return op("sqrt", op("sub", 1.0, op("mul", x, x)))


# Slope of an operation of one array x with the value y.
_SLOPES: dict[str, _Slope] = {
    "neg": lambda op, x, y: -1.0,
    "abs": lambda op, x, y: op("select", op("lt", x, 0.0), -1.0, 1.0),
    "sqrt": lambda op, x, y: op("div", 0.5, y),
    "exp": lambda op, x, y: y,
    "log": lambda op, x, y: op("div", 1.0, x),
    "log1p": lambda op, x, y: op("div", 1.0, op("add", x, 1.0)),
    "expm1": lambda op, x, y: op("add", y, 1.0),
    "tanh": lambda op, x, y: op("sub", 1.0, op("mul", y, y)),
    "sin": lambda op, x, y: op("cos", x),
    "cos": lambda op, x, y: op("neg", op("sin", x)),
    "tan": lambda op, x, y: op("add", op("mul", y, y), 1.0),
    "asin": lambda op, x, y: op("div", 1.0, _arc(op, x)),
    "acos": lambda op, x, y: op("div", -1.0, _arc(op, x)),
    "atan": lambda op, x, y: op("div", 1.0, op("add", op("mul", x, x), 1.0)),
    "sinh": lambda op, x, y: op("cosh", x),
    "cosh": lambda op, x, y: op("sinh", x),
}
# Slopes of an operation of two arrays a and b with the value y.
_PARTIAL: dict[str, Callable[[_Op, int, int, int], tuple[int | float, int | float]]] = {
    "add": lambda op, a, b, y: (1.0, 1.0),
    "sub": lambda op, a, b, y: (1.0, -1.0),
    "mul": lambda op, a, b, y: (b, a),
    "div": lambda op, a, b, y: (op("div", 1.0, b), op("neg", op("div", y, b))),
    "pow": _power_slopes,
    "atan2": _angle_slopes,
}
# Where this comparison holds, the result is the first operand.
_CHOSEN = {"max": "ge", "min": "le"}
_CONSTANT = frozenset("sign floor isfinite lt le gt ge eq ne".split())  # noqa: SIM905
# Infinite slopes at 0 count as none in the directions that do not move the operand.
_STEEP = frozenset(("sqrt", "pow"))
