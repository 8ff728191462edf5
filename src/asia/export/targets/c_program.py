"""C statements of a lowered program.

Numbers lie in one array `w` of a function, whose places are used again once nothing reads them;
a value that is computed elementwise and read once has no place at all. Constants are `static
const`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from asia.data import Array
from asia.export.targets.c_places import kept_axes, last_uses, runs, source_places, strides
from asia.export.targets.c_values import Constants, Element, Memory, Value, number
from asia.lowering import Node, Program, Shape

_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/"}
_COMPARED = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
_CALLED = "floor sqrt exp log log1p expm1 tanh sin cos tan asin acos atan sinh cosh pow atan2"
_OWN = {
    "abs": "F(fabs)",
    "max": "asia_max",
    "min": "asia_min",
    "sign": "asia_sign",
    "isfinite": "asia_isfinite",
    **{name: f"F({name})" for name in _CALLED.split()},
}
_REDUCED = {
    "rsum": ("+=", "R(0)"),
    "rprod": ("*=", "R(1)"),
    "rmax": ("asia_max", "-(asia_real)HUGE_VAL"),
    "rmin": ("asia_min", "(asia_real)HUGE_VAL"),
}
_MOST_TEXT, _MOST_RUNS = 300, 6


class Statements:
    """Statements of one C function."""

    def __init__(self, constants: Constants) -> None:
        self.constants = constants
        self.memory = Memory()
        self.lines: list[str] = []
        self.loops = 0
        self._indent = 1
        self._deepest = 0
        # Regions of `w`, and the depth of loops at which each was taken.
        self._mine: dict[int, int] = {}

    def run(self, program: Program, inputs: Sequence[Value]) -> list[Value]:
        """Print a program and return the values of its outputs."""
        values = [*inputs, *(self._constant(c) for c in program.constants)]
        nodes, first = program.nodes, program.first_node
        last = last_uses(program)
        count = [0] * (first + len(nodes))
        for node in nodes:
            for i in node.operands:
                count[i] += 1
        for i in program.outputs:
            count[i] += 2
        loops: dict[int, list[Value]] = {}
        for place, node in enumerate(nodes):
            operands = [values[i] for i in node.operands]
            if node.op == "loop":
                loops[first + place] = self._loop(node, operands)
                parts = loops[first + place]
                held = frozenset[int]().union(*(part.places for part in parts))
                values.append(Value(str, (), places=held))
            elif node.op == "part":
                values.append(loops[node.operands[0]][node.attrs[0]])
            else:
                values.append(self._value(node, operands, count[first + place]))
            self._release(place, values, last, program)
        return [values[i] for i in program.outputs]

    def _release(
        self, place: int, values: list[Value], last: dict[int, int], program: Program
    ) -> None:
        """Free the regions of `w` that nothing reads any more."""
        now = program.first_node + place
        outputs = set(program.outputs)
        live = {
            region
            for i, value in enumerate(values)
            if i in outputs or last.get(i, -1) > now
            for region in value.places
        }
        for region in list(self._mine):
            if region not in live and self._mine[region] == self._indent:
                self.memory.give(region)
                del self._mine[region]

    def line(self, text: str) -> None:
        """Append one statement."""
        self.lines.append("    " * self._indent + text)

    def _constant(self, array: Array) -> Value:
        if array.size == 1:
            text = number(float(array.reshape(-1)[0]))
            return Value(lambda i: text, array.shape)
        if array.size == 0:
            return Value(lambda i: "R(0.0)", array.shape)
        name = self.constants.reals(array)
        return Value(lambda i: f"{name}[{i}]", array.shape)

    def region(self, shape: Shape) -> Value:
        """Reserve memory for a value."""
        size = math.prod(shape)
        if size == 0:
            return Value(lambda i: "R(0.0)", shape)
        start = self.memory.take(size)
        self._mine[start] = self._indent
        return Value(_offset("w", start), shape, places=frozenset((start,)))

    def _value(self, node: Node, operands: list[Value], uses: int) -> Value:
        if node.op == "reshape":
            return Value(operands[0].at, node.shape, operands[0].plain, operands[0].places)
        if node.op == "broadcast" and not operands[0].shape:
            return self._settled(_spread(operands[0], node.shape), uses)
        if _is_elementwise(node.op):
            return self._settled(_elementwise(node, operands), uses)
        if node.op == "matmul":
            return self._matmul(node, [self._placed(o) for o in operands])
        if node.op in _REDUCED:
            return self._reduced(node, self._placed(operands[0]))
        if node.op == "concat":
            return self._concat(node, operands)
        if node.op == "pad":
            return self._padded(node, operands)
        source = self._placed(operands[0])
        return self._moved(node, source)

    def _settled(self, value: Value, uses: int) -> Value:
        """Keep a value as an expression if it is short and read once, else store it."""
        if value.plain or (uses <= 1 and len(value.at("i")) < _MOST_TEXT):
            return value
        return self._placed(value)

    def _placed(self, value: Value) -> Value:
        if value.plain:
            return value
        target = self.region(value.shape)
        self.copy(target.at, value.at, math.prod(value.shape))
        return target

    def own(self, value: Value) -> Value:
        """Store a value in `w`, in a region that nothing else writes."""
        return value if value.plain and value.places else self._kept(value)

    def copy(self, target: Element, source: Element, count: int) -> None:
        """Copy `count` numbers."""
        if count == 1:
            self.line(f"{target('0')} = {source('0')};")
        elif count > 1:
            i = self.counter(0)
            self.line(f"for ({i} = 0; {i} < {count}; ++{i}) {target(i)} = {source(i)};")

    def counter(self, depth: int) -> str:
        """Name of a loop variable."""
        name = f"i{depth}"
        self.loops = max(self.loops, depth + 1)
        return name

    def _matmul(self, node: Node, operands: list[Value]) -> Value:
        left, right = operands
        *stack, rows, columns = node.shape
        inner, target = left.shape[-1], self.region(node.shape)
        i, j, k = (self.counter(d) for d in range(3))
        b = self.counter(3) if stack else ""
        wide = "" if not stack else f"{b} * {rows} + "
        if stack:
            self.line(f"for ({b} = 0; {b} < {stack[0]}; ++{b})")
        cell = f"({wide}{i}) * {columns} + {j}"
        self.line(f"for ({i} = 0; {i} < {rows}; ++{i}) {{")
        source = f"({b} * {inner} + {k}) * {columns} + {j}" if stack else f"{k} * {columns} + {j}"
        self._indent += 1
        self.line(f"for ({j} = 0; {j} < {columns}; ++{j}) {target.at(cell)} = R(0.0);")
        self.line(f"for ({k} = 0; {k} < {inner}; ++{k})")
        self._indent += 1
        product = f"{left.at(f'({wide}{i}) * {inner} + {k}')} * {right.at(source)}"
        self.line(f"for ({j} = 0; {j} < {columns}; ++{j}) {target.at(cell)} += {product};")
        self._indent -= 2
        self.line("}")
        return target

    def _reduced(self, node: Node, source: Value) -> Value:
        how, start = _REDUCED[node.op]
        target = self.region(node.shape)
        self.copy(target.at, lambda i: start, math.prod(node.shape))
        steps = strides(source.shape)
        out = dict(zip(kept_axes(source.shape, node.attrs), strides(node.shape), strict=True))
        order = sorted(range(len(source.shape)), key=lambda a: (a in node.attrs, a))
        names = [self.counter(d) for d in range(len(order))]
        for depth, axis in enumerate(order):
            i = names[depth]
            self.line(f"for ({i} = 0; {i} < {source.shape[axis]}; ++{i})")
            self._indent += 1
        read = " + ".join(f"{names[d]} * {steps[a]}" for d, a in enumerate(order)) or "0"
        put = " + ".join(f"{names[d]} * {out[a]}" for d, a in enumerate(order) if a in out) or "0"
        cell = target.at(put)
        if how.startswith("asia"):
            self.line(f"{cell} = {how}({cell}, {source.at(read)});")
        else:
            self.line(f"{cell} {how} {source.at(read)};")
        self._indent -= len(order)
        return target

    def _concat(self, node: Node, operands: list[Value]) -> Value:
        target, axis = self.region(node.shape), node.attrs[0]
        outer = math.prod(node.shape[:axis])
        wide, start = math.prod(node.shape[axis:]), 0
        for value in operands:
            size = math.prod(value.shape[axis:])
            self._block(target, value, (outer, wide, start, size))
            start += size
        return target

    def _block(self, target: Value, value: Value, sizes: tuple[int, int, int, int]) -> None:
        """Copy rows of `size` numbers, from `start` on, into rows of `wide` ones."""
        outer, wide, start, size = sizes
        if outer * size == 0:
            return
        if outer == 1:
            self.copy(lambda i: target.at(f"{start} + {i}"), value.at, size)
            return
        i, j = self.counter(0), self.counter(1)
        put, read = target.at(f"{i} * {wide} + {start} + {j}"), value.at(f"({i} * {size} + {j})")
        inner = f"for ({j} = 0; {j} < {size}; ++{j})"
        self.line(f"for ({i} = 0; {i} < {outer}; ++{i}) {inner} {put} = {read};")

    def _padded(self, node: Node, operands: list[Value]) -> Value:
        target, rank = self.region(node.shape), len(node.shape)
        self.copy(target.at, operands[1].at, math.prod(node.shape))
        places = np.arange(math.prod(node.shape)).reshape(node.shape)
        inside = tuple(
            slice(node.attrs[a], node.attrs[a] + operands[0].shape[a]) for a in range(rank)
        )
        source = self._placed(operands[0])
        self._assign(target.at, source.at, places[inside].reshape(-1), None)
        return target

    def _moved(self, node: Node, source: Value) -> Value:
        places = source_places(node, source.shape)
        size = len(places)
        if size and (places == places[0] + np.arange(size)).all():
            # A contiguous part is read in place.
            start = int(places[0])
            at = source.at
            moved = at if start == 0 else lambda i: at(f"{start} + {i}")
            return Value(moved, node.shape, True, source.places)
        target = self.region(node.shape)
        self._assign(target.at, source.at, None, places)
        return target

    def _assign(
        self,
        target: Element,
        source: Element,
        put: NDArray[np.int64] | None,
        read: NDArray[np.int64] | None,
    ) -> None:
        """Print target[put] = source[read]; None counts up from 0."""
        places = put if put is not None else read
        assert places is not None
        segments = runs(places)
        i = self.counter(0)
        if len(segments) > _MOST_RUNS and len(places) > 2 * _MOST_RUNS:
            name = self.constants.places(places)
            there = (f"{name}[{i}]", i) if put is not None else (i, f"{name}[{i}]")
            loop = f"for ({i} = 0; {i} < {len(places)}; ++{i})"
            self.line(f"{loop} {target(there[0])} = {source(there[1])};")
            return
        done = 0
        for start, step, count in segments:

            def moving(j: str, start: int = start, step: int = step) -> str:
                return f"{start} + {j} * {step}" if step != 1 else f"{start} + {j}"

            def counting(j: str, done: int = done) -> str:
                return f"{done} + {j}"

            here, there = (moving, counting) if put is not None else (counting, moving)
            self.copy(_through(target, here), _through(source, there), count)
            done += count

    def _loop(self, node: Node, operands: list[Value]) -> list[Value]:
        assert node.body is not None
        length, same, carried = node.attrs
        body = node.body
        carry = [self.region(o.shape) for o in operands[same : same + carried]]
        for place, value in zip(carry, operands[same : same + carried], strict=True):
            self.copy(place.at, value.at, math.prod(value.shape))
        stacked = [self.region((length, *s)) for s in body.output_shapes[carried:]]
        rows = [self._placed(o) for o in operands[same + carried :]]
        fixed = [self._placed(o) for o in operands[:same]]
        self._deepest += 1
        index = f"t{self._deepest}"
        self.line(f"{{ int {index}; for ({index} = 0; {index} < {length}; ++{index}) {{")
        self._indent += 1
        read = [Value(_row(r, index), r.shape[1:], places=r.places) for r in rows]
        found = self.run(body, [*fixed, *carry, *read])
        for place, value in zip(stacked, found[carried:], strict=True):
            self.copy(_row(place, index), value.at, math.prod(value.shape))
        after = [self._kept(value) for value in found[:carried]]
        for place, value in zip(carry, after, strict=True):
            self.copy(place.at, value.at, math.prod(value.shape))
        self._indent -= 1
        for region in [r for r, depth in self._mine.items() if depth > self._indent]:
            self.memory.give(region)
            del self._mine[region]
        self.line("} }")
        return [*carry, *stacked]

    def _kept(self, value: Value) -> Value:
        """Copy a value to a region of its own, so that carried values may be overwritten."""
        target = self.region(value.shape)
        self.copy(target.at, value.at, math.prod(value.shape))
        return target


def _offset(name: str, start: int) -> Element:
    return lambda i: f"{name}[{start} + {i}]" if start else f"{name}[{i}]"


def _row(value: Value, index: str) -> Element:
    size = math.prod(value.shape[1:])
    return lambda i: value.at(f"{index} * {size} + {i}")


def _through(element: Element, place: Callable[[str], str]) -> Element:
    return lambda i: element(place(i))


def _spread(value: Value, shape: Shape) -> Value:
    return Value(lambda i: value.at("0"), shape, value.plain, value.places)


def _is_elementwise(op: str) -> bool:
    return op in _INFIX or op in _COMPARED or op in _OWN or op in ("neg", "select")


def _elementwise(node: Node, operands: list[Value]) -> Value:
    def at(i: str) -> str:
        read = [o.at(i if o.shape else "0") for o in operands]
        if node.op == "neg":
            return f"(-{read[0]})"
        if node.op == "select":
            return f"({read[0]} != R(0.0) ? {read[1]} : {read[2]})"
        if node.op in _INFIX:
            return f"({read[0]} {_INFIX[node.op]} {read[1]})"
        if node.op in _COMPARED:
            return f"({read[0]} {_COMPARED[node.op]} {read[1]} ? R(1.0) : R(0.0))"
        return f"{_OWN[node.op]}({', '.join(read)})"

    places = frozenset[int]().union(*(o.places for o in operands))
    return Value(at, node.shape, False, places)
