"""C99 without allocation: model, header, command-line program."""

import ctypes
import math
import re
import shutil
import subprocess
import tempfile
import textwrap
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from asia._files import PACKAGE
from asia.data.segment import SimulatedSegment
from asia.data.trajectory import Array, Signal
from asia.errors import InternalError
from asia.export.model import ExportModel, Printed
from asia.export.target import Answers, Target
from asia.export.targets.indices import Places, inside_places, kept_axes, slices, source_places
from asia.lowering.program import Node, Program, Shape, names_of
from asia.lowering.wire import write_program

# Files around `model.c`.


def template(name: str | Path, **values: object) -> str:
    """A file of `templates`, or at an absolute path, with a value for each `@NAME@`."""
    text = (PACKAGE / "export" / "targets" / "templates" / name).read_text("utf-8")
    for key, value in values.items():
        text = text.replace(f"@{key}@", str(value))
    return text


FLOAT = "typedef float asia_real;"
"""Line of `model.h` that selects single precision; it is replaced by an error where single
precision is not good enough."""
# The type is still defined, so that the compiler prints this error and no other.
NO_FLOAT = (
    '#error "in float this model differs too much from its simulation in double, see USE.md"\n'
    "typedef float asia_real;"
)


def header(model: ExportModel) -> str:
    """Text of `model.h`."""
    states = sum(math.prod(s) for s in model.lowered.states)
    return template("model.h", **header_fields(model), STATES=max(states, 1))


def header_fields(model: ExportModel) -> dict[str, object]:
    """Values of the fields that both header templates share."""
    low = model.lowered
    rows = [
        f" * {side} {i}: {plain_text(s.name)} {plain_text(s.unit)}, trained from {a:g} to {b:g}"
        for side, signals, span in (
            ("input", model.inputs, model.input_range),
            ("output", model.outputs, model.output_range),
        )
        for i, (s, (a, b)) in enumerate(zip(signals, span.tolist(), strict=True))
    ]
    return {
        "TITLE": plain_text(f"{model.problem}: {model.use} of run {model.name}"),
        "SIGNALS": "\n".join(rows),
        "SAMPLING_TIME": repr(model.sampling_time),
        "NU": low.nu,
        "NY": low.ny,
        "PAST_U": low.n_past_u,
        "PAST_Y": low.n_past_y,
    }


def column_names(signals: Sequence[Signal]) -> str:
    return ",".join(plain_text(s.name) for s in signals)


def example_csv(model: ExportModel, window: SimulatedSegment) -> str:
    """Window in the CSV format of `main.c`: the outputs after its past are those of ASIA's
    simulation."""
    past = max(len(window.past_u), len(window.past_y))
    u = np.concatenate([np.zeros((past - len(window.past_u), model.lowered.nu)), window.past_u])
    y = np.concatenate([np.zeros((past - len(window.past_y), model.lowered.ny)), window.past_y])
    rows = np.concatenate(
        [np.concatenate([u, window.u]), np.concatenate([y, window.y_hat])], axis=1
    )
    names = column_names((*model.inputs, *model.outputs))
    return "\n".join([names, *(",".join(repr(float(v)) for v in row) for row in rows), ""])


def plain_text(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9 _.:/^-]", "_", text)


def strides(shape: Shape) -> list[int]:
    """Distance between neighbouring numbers along each axis."""
    return [math.prod(shape[a + 1 :]) for a in range(len(shape))]


def grid(places: Places) -> list[tuple[int, int]] | None:
    """Counts and steps of nested loops that visit these indices row by row; None if there are no
    such loops."""
    found, axes = places.reshape(-1)[:1], list[tuple[int, int]]()
    if not places.size:
        return []
    for axis, count in enumerate(places.shape):
        if count > 1:
            step = int(places.swapaxes(0, axis)[1].reshape(-1)[0] - found[0])
            if axes and axes[-1][1] == count * step:
                count *= axes.pop()[0]
            axes.append((count, step))
    for count, step in axes:
        found = (found[:, None] + step * np.arange(count)).reshape(-1)
    return axes if np.array_equal(found, places.reshape(-1)) else None


# Values, constants and memory of printed C.


Element = Callable[[str], str]
"""C expression of the number at a place, which is itself an expression."""


@dataclass
class Value:
    """Value of the program: a place in memory, or an expression that computes it."""

    at: Element
    shape: Shape
    plain: bool = True
    """`at` is a place, not a computation."""
    places: frozenset[int] = frozenset()
    """Regions of `w` that the value reads."""
    overwritten: bool = False
    """The value reads arguments that the function may overwrite."""


@dataclass
class Constants:
    """`static const` arrays, equal ones once."""

    lines: list[str] = field(default_factory=list[str])
    _names: dict[bytes, str] = field(default_factory=dict[bytes, str])

    def reals(self, array: Array) -> str:
        """Name of an array of numbers."""
        numbers = [number(float(v)) for v in array.reshape(-1)]
        return self._named(array.tobytes(), "k", "asia_real", numbers)

    def places(self, array: Places) -> str:
        """Name of an array of whole numbers."""
        literals = [str(v) for v in array.tolist()]
        return self._named(b"p" + array.tobytes(), "p", "long", literals)

    def used_in(self, text: str) -> list[str]:
        """Definitions of the constants that a text names."""
        names = set(re.findall(r"\b[kp]\d+\b", text))
        return [
            x for x, name in zip(self.lines, self._names.values(), strict=True) if name in names
        ]

    def _named(self, key: bytes, prefix: str, kind: str, literals: Sequence[str]) -> str:
        if key not in self._names:
            name = f"{prefix}{len(self._names)}"
            self._names[key] = name
            rows = [", ".join(literals[i : i + 4]) for i in range(0, len(literals), 4)]
            text = ",\n    ".join(rows)
            self.lines.append(f"static const {kind} {name}[{len(literals)}] = {{\n    {text}\n}};")
        return self._names[key]


def number(value: float) -> str:
    """Literal that C reads back bit by bit."""
    if math.isinf(value):
        return "(asia_real)HUGE_VAL" if value > 0 else "(-(asia_real)HUGE_VAL)"
    return f"R({value!r})"


def plus(start: int, i: str) -> str:
    """Index `start + i`."""
    if i.isdigit():
        return str(start + int(i))
    return f"{start} + {i}" if start else i


def index(start: int, counters: Sequence[str], steps: Sequence[int]) -> str:
    """Index of a number from the counters of loops; that of a single iteration is "0"."""
    terms = [
        i if step == 1 else f"{i} * {step}"
        for i, step in zip(counters, steps, strict=True)
        if step and i != "0"
    ]
    return plus(start, " + ".join(terms) or "0")


class Names:
    """C names of one function or file, each once."""

    def __init__(self, taken: Sequence[str] = ()) -> None:
        self._taken = {*_RESERVED, *taken}

    def new(self, wanted: str) -> str:
        """Name that is not taken yet, as close to the wanted one as C permits."""
        name = f"_{wanted}" if wanted[:1].isdigit() else wanted
        while name in self._taken or _OWN_NAME.fullmatch(name):
            name += "_"
        self._taken.add(name)
        return name


class Functions:
    """`static` functions of a file, equal ones once, each after those that it calls."""

    def __init__(self, constants: Constants) -> None:
        self.texts: list[str] = []
        self.work = 0
        """Most numbers in the array `w` of a function."""
        self._constants = constants
        self._names = Names()
        self._known: dict[bytes, str] = {}

    def name_of(self, call: Node) -> str:
        """Print the function of a call, if it is new, and return its name."""
        assert call.body is not None
        program, packed = call.body, [bytes(call.attrs)]
        write_program(program, packed)
        key = b"".join(packed)
        if key in self._known:
            return self._known[key]
        title, *given = names_of(call.attrs)
        name, inside = self._names.new(title), Names()
        given = [*(f"c{k}" for k in range(len(program.inputs) - len(given))), *given]
        inputs = [
            value_at(inside.new(text), 0, shape) if math.prod(shape) != 1
            else variable(inside.new(text), shape)
            for text, shape in zip(given, program.inputs, strict=True)
        ]  # fmt: skip
        outputs = [
            value_at(inside.new(f"to{k}"), 0, shape)
            for k, shape in enumerate(program.output_shapes)
        ]
        arguments = [
            *(f"asia_real {v.at('0')}" if math.prod(v.shape) == 1
              else f"const asia_real *{address(v)}" for v in inputs),
            *(f"asia_real *{address(v)}" for v in outputs if math.prod(v.shape)),
        ]  # fmt: skip
        together = ", ".join(text.replace(" ", "~") for text in arguments)
        head = "\n    ".join(textwrap.wrap(f"static void {name}({together})", _WIDEST))
        head = head.replace("~", " ")
        text = self.function(head, program, inputs, outputs, inside)
        self.texts.append(text)
        self._known[key] = name
        return name

    def function(
        self, head: str, program: Program, inputs: Sequence[Value], outputs: Sequence[Value],
        names: Names | None = None,
    ) -> str:  # fmt: skip
        """Print a function that computes a program."""
        code = Statements(self._constants, self, names or Names(re.findall(r"\w+", head)))
        free = [] if any(v.overwritten for v in outputs) else outputs
        found = [code.own(value) for value in code.run(program, inputs, free)]
        for target, value in zip(outputs, found, strict=True):
            if value is not target:
                code.copy(target.at, value.at, math.prod(value.shape))
        self.work = max(self.work, code.memory.size)
        lines = [head, "{"]
        if code.memory.size:
            lines.append(f"    asia_real w[{code.memory.size}];")
        if code.loops:
            lines.append(f"    int {', '.join(f'i{d}' for d in range(code.loops))};")
        text = "\n".join(code.lines)
        arguments = re.findall(r"(\w+)[,)]", head)
        unused = [n for n in arguments if not re.search(rf"\b{n}\b", text)]
        return "\n".join([*lines, *(f"    (void){n};" for n in unused), text, "}", ""])


class Memory:
    """Regions of the array `w`."""

    def __init__(self) -> None:
        self.size = 0
        self._free: list[tuple[int, int]] = []
        self._taken: dict[int, int] = {}

    def take(self, count: int) -> int:
        """Reserve a region of so many numbers and return its start."""
        for place, (start, size) in enumerate(self._free):
            if size >= count:
                self._free[place : place + 1] = [(start + count, size - count)] * (size > count)
                self._taken[start] = count
                return start
        start, self.size = self.size, self.size + count
        self._taken[start] = count
        return start

    def give(self, start: int) -> None:
        """Free a region."""
        self._free.append((start, self._taken.pop(start)))
        self._free.sort()
        joined: list[tuple[int, int]] = []
        for begin, size in self._free:
            if joined and sum(joined[-1]) == begin:
                joined[-1] = (joined[-1][0], joined[-1][1] + size)
            else:
                joined.append((begin, size))
        self._free = joined


# C statements of a lowered program.
#
# Arrays lie in one array `w` of a function, whose places are used again once nothing reads them;
# a number is a variable, and a value that is computed elementwise and read once has no place at
# all. Constants are `static const`.


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
_ELEMENTWISE = {*_INFIX, *_COMPARED, *_OWN, "neg", "select"}
_KEYWORDS = (
    "auto break case char const continue default do double else enum extern float for goto if "
    "inline int long register restrict return short signed sizeof static struct switch typedef "
    "union unsigned void volatile while"
)
_MATHS = ("fabs", *_CALLED.split())
_RESERVED = {"w", "main", *_KEYWORDS.split(), *_MATHS, *(f"{name}f" for name in _MATHS)}
_OWN_NAME = re.compile(r"[kpitv]\d+|asia_\w*|ASIA_\w*|_[A-Z_]\w*")
_MOST_TEXT, _WIDEST = 300, 100


class Statements:
    """Statements of one C function."""

    def __init__(self, constants: Constants, functions: Functions, names: Names) -> None:
        self.constants = constants
        self.functions = functions
        self.names = names
        self.memory = Memory()
        self.lines: list[str] = []
        self._variables = 0
        self.loops = 0
        self._indent = 1
        self._deepest = 0
        # Regions of `w`, and the depth of loops at which each was taken.
        self._mine: dict[int, int] = {}

    def run(
        self, program: Program, inputs: Sequence[Value], outputs: Sequence[Value] = ()
    ) -> list[Value]:
        """Print a program and return the values of its outputs; `outputs` are places for them that
        nothing reads, which those made of parts are written to."""
        places = dict(zip(program.outputs, outputs, strict=False))
        values = [*inputs, *(self._constant(c) for c in program.constants)]
        nodes = list(enumerate(program.nodes, program.first_node))
        returned = set(program.outputs)
        last = {i: place for place, node in nodes for i in node.operands}
        count = Counter([*(i for _, node in nodes for i in node.operands), *program.outputs])
        results: dict[int, list[Value]] = {}
        for place, node in nodes:
            operands = [values[i] for i in node.operands]
            if node.op in ("loop", "call"):
                parts = {n.attrs[0] for _, n in nodes if n.op == "part" and n.operands == (place,)}
                results[place] = (
                    self._loop(node, operands, parts)
                    if node.op == "loop"
                    else self._call(node, operands)
                )
                held = frozenset[int]().union(*(part.places for part in results[place]))
                values.append(Value(str, (), places=held))
            elif node.op == "part":
                values.append(results[node.operands[0]][node.attrs[0]])
            elif node.op == "concat":
                target = places.get(place) or self.region(node.shape)
                self._concat(node, operands, target)
                values.append(target)
            else:
                values.append(self._value(node, operands, count[place]))
            # Free the regions of `w` that nothing reads any more.
            live = {
                region
                for i, value in enumerate(values)
                if i in returned or last.get(i, -1) > place
                for region in value.places
            }
            unread = [
                r for r, depth in self._mine.items() if r not in live and depth == self._indent
            ]
            self._release(unread)
        return [values[i] for i in program.outputs]

    def _release(self, regions: Sequence[int]) -> None:
        for region in regions:
            self.memory.give(region)
            del self._mine[region]

    def line(self, text: str) -> None:
        """Append one statement."""
        indent = "    " * self._indent
        self.lines.append(
            textwrap.fill(
                text, _WIDEST, initial_indent=indent, subsequent_indent=f"{indent}        ",
                break_long_words=False, break_on_hyphens=False,
            )
        )  # fmt: skip

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
        if size == 1:
            name = self._new_name()
            self.line(f"asia_real {name};")
            return variable(name, shape)
        start = self.memory.take(size)
        self._mine[start] = self._indent
        return value_at("w", start, shape, frozenset((start,)))

    def _value(self, node: Node, operands: list[Value], uses: int) -> Value:
        one = operands[0]
        if node.op == "label":
            if math.prod(one.shape) != 1:
                return one
            return self._variable(one, self.names.new(names_of(node.attrs)[0]))
        if node.op == "reshape":
            return replace(one, shape=node.shape)
        if node.op == "broadcast" and math.prod(one.shape) == 1:
            spread = replace(one, at=lambda i: one.at("0"), shape=node.shape)
            return self._settled(spread, uses)
        if node.op in _ELEMENTWISE:
            return self._settled(_elementwise(node, operands), uses)
        if node.op == "matmul":
            return self._matmul(node, [self._placed(o) for o in operands])
        if node.op in _REDUCED:
            return self._reduced(node, self._placed(operands[0]))
        if node.op == "pad":
            target = self.region(node.shape)
            self.copy(target.at, operands[1].at, math.prod(node.shape))
            source = self._placed(one)
            places = inside_places(node, source.shape).reshape(source.shape)
            self._visit(places, lambda k, place: f"{target.at(place)} = {source.at(k)};")
            return target
        source = self._placed(one)
        at, places = source.at, source_places(node, source.shape).reshape(node.shape)
        if not places.size:
            return self.region(node.shape)
        if grid(places) in ([], [(places.size, 1)]):
            # A contiguous part is read in place.
            start = int(places.reshape(-1)[0])
            return replace(source, at=lambda i: at(plus(start, i)), shape=node.shape)
        target = self.region(node.shape)
        self._visit(places, lambda k, place: f"{target.at(k)} = {at(place)};")
        return target

    def _settled(self, value: Value, uses: int) -> Value:
        """Keep a value as an expression if it is short and read once, else store it."""
        short = uses <= 1 and len(value.at("i")) < _MOST_TEXT
        return value if short else self._placed(value)

    def _placed(self, value: Value) -> Value:
        if not value.plain and math.prod(value.shape) == 1:
            return self._variable(value, self._new_name())
        return value if value.plain else self._kept(value)

    def _variable(self, value: Value, name: str, *, constant: bool = True) -> Value:
        """Copy a number to a variable."""
        self.line(f"{'const ' * constant}asia_real {name} = {value.at('0')};")
        return variable(name, value.shape)

    def _new_name(self) -> str:
        self._variables += 1
        return f"v{self._variables}"

    def own(self, value: Value) -> Value:
        """Store a value that the function would overwrite."""
        return self._kept(value) if value.overwritten else value

    def copy(self, target: Element, source: Element, count: int) -> None:
        """Copy `count` numbers."""
        self._repeat([count], lambda i: f"{target(i[0])} = {source(i[0])};")

    def _repeat(self, sizes: Sequence[int], statement: Callable[[list[str]], str]) -> None:
        """Print nested loops of these sizes around a statement, from their counters."""
        counters, loops = list[str](), list[str]()
        for n in sizes:
            i = "0" if n == 1 else f"i{len(loops)}"
            loops += [f"for ({i} = 0; {i} < {n}; ++{i})"] * (n != 1)
            counters.append(i)
        if 0 not in sizes:
            self.loops = max(self.loops, len(loops))
            self.line(" ".join([*loops, statement(counters)]))

    def _visit(self, places: Places, statement: Callable[[str, str], str]) -> None:
        """Print a statement for each of these indices, from its number and the index."""
        axes = grid(places)
        if axes is None:
            name = self.constants.places(places.reshape(-1))
            self._repeat([places.size], lambda i: statement(i[0], f"{name}[{i[0]}]"))
        elif places.size:
            first, sizes = int(places.reshape(-1)[0]), tuple(n for n, _ in axes)
            steps, own = [step for _, step in axes], strides(sizes)
            self._repeat(sizes, lambda i: statement(index(0, i, own), index(first, i, steps)))

    def _matmul(self, node: Node, operands: list[Value]) -> Value:
        left, right = operands
        *stack, rows, columns = node.shape
        target = self.region(node.shape)
        self.copy(target.at, lambda i: "R(0.0)", math.prod(node.shape))

        def sum_up(counters: list[str]) -> str:
            *b, i, k, j = counters
            cell, one, two = (
                value.at(index(0, each, strides(value.shape)))
                for value, each in ((target, [*b, i, j]), (left, [*b, i, k]), (right, [*b, k, j]))
            )
            return f"{cell} += {one} * {two};"

        self._repeat((*stack, rows, left.shape[-1], columns), sum_up)
        return target

    def _reduced(self, node: Node, source: Value) -> Value:
        how, start = _REDUCED[node.op]
        target, kept = self.region(node.shape), kept_axes(source.shape, node.attrs)
        self.copy(target.at, lambda i: start, math.prod(node.shape))
        order, steps = [*kept, *node.attrs], strides(source.shape)

        def take(counters: list[str]) -> str:
            cell = target.at(index(0, counters[: len(kept)], strides(node.shape)))
            read = source.at(index(0, counters, [steps[a] for a in order]))
            return f"{cell} = {how}({cell}, {read});" if "asia" in how else f"{cell} {how} {read};"

        self._repeat([source.shape[a] for a in order], take)
        return target

    def _concat(self, node: Node, operands: list[Value], target: Value) -> None:
        axis = node.attrs[0]
        outer, wide = math.prod(node.shape[:axis]), math.prod(node.shape[axis:])
        start = 0
        for value in operands:
            # Rows of `size` numbers go, from `start` on, into rows of `wide` ones.
            size = math.prod(value.shape[axis:])
            put, read = partial(index, start, steps=(wide, 1)), partial(index, 0, steps=(size, 1))
            self._repeat(
                [outer, size],
                lambda i, value=value, put=put, read=read: (
                    f"{target.at(put(counters=i))} = {value.at(read(counters=i))};"
                ),
            )
            start += size

    def _call(self, node: Node, operands: list[Value]) -> list[Value]:
        assert node.body is not None
        name = self.functions.name_of(node)
        given = [self._placed(o) for o in operands]
        # A number that fills an array takes one place only.
        given = [
            self._kept(o) if math.prod(o.shape) > 1 and o.at("0") == o.at("1") else o for o in given
        ]
        found = [self.region(shape) for shape in node.body.output_shapes]
        arguments = [
            *(o.at("0") if math.prod(o.shape) == 1 else address(o) for o in given),
            *(address(o) for o in found if math.prod(o.shape)),
        ]
        self.line(f"{name}({', '.join(arguments)});")
        return found

    def _loop(self, node: Node, operands: list[Value], parts: set[int]) -> list[Value]:
        """Print a loop; of its stacked results only those among the `parts` are kept."""
        assert node.body is not None
        length, same, carried = node.attrs
        body = node.body
        carry = [self._kept(o) for o in operands[same : same + carried]]
        stacked = [
            self.region((length, *s) if k in parts else (0,))
            for k, s in enumerate(body.output_shapes[carried:], carried)
        ]
        rows = [self._placed(o) for o in operands[same + carried :]]
        fixed = [self._placed(o) for o in operands[:same]]
        self._deepest += 1
        index = f"t{self._deepest}"
        self.line(f"{{ int {index}; for ({index} = 0; {index} < {length}; ++{index}) {{")
        self._indent += 1
        read = [replace(r, at=_row(r, index), shape=r.shape[1:]) for r in rows]
        found = self.run(body, [*fixed, *carry, *read])
        for place, value in zip(stacked, found[carried:], strict=True):
            if math.prod(place.shape):
                self.copy(_row(place, index), value.at, math.prod(value.shape))
        after = [self._kept(value) for value in found[:carried]]
        for place, value in zip(carry, after, strict=True):
            self.copy(place.at, value.at, math.prod(value.shape))
        self._indent -= 1
        self._release([r for r, depth in self._mine.items() if depth > self._indent])
        self.line("} }")
        return [*carry, *stacked]

    def _kept(self, value: Value) -> Value:
        """Copy a value to a region of its own, so that carried values may be overwritten."""
        if math.prod(value.shape) == 1:
            return self._variable(value, self._new_name(), constant=False)
        target = self.region(value.shape)
        self.copy(target.at, value.at, math.prod(value.shape))
        return target


def value_at(name: str, start: int, shape: Shape, places: frozenset[int] = frozenset()) -> Value:
    return Value(lambda i: f"{name}[{plus(start, i)}]", shape, places=places)


def variable(name: str, shape: Shape) -> Value:
    """Value of a variable for one number."""
    return Value(lambda i: name, shape)


def address(value: Value) -> str:
    """Pointer to a value in memory."""
    first = value.at("0")
    return first.removesuffix("[0]") if first.endswith("[0]") else f"&{first}"


def _row(value: Value, index: str) -> Element:
    size = math.prod(value.shape[1:])
    row = f"{index} * {size}" if size != 1 else index
    return lambda i: value.at(row if i == "0" else f"{row} + {i}")


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
    return Value(at, node.shape, False, places, any(o.overwritten for o in operands))


# C99 without allocation: one file of functions, a header, and a program that runs a CSV file.


FLAGS = ("-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror", "-O2")
_HELPERS = {
    "asia_max": "static asia_real asia_max(asia_real a, asia_real b)\n"
    "{\n    return (a > b || a != a) ? a : b;\n}\n",
    "asia_min": "static asia_real asia_min(asia_real a, asia_real b)\n"
    "{\n    return (a < b || a != a) ? a : b;\n}\n",
    "asia_sign": "static asia_real asia_sign(asia_real a)\n"
    "{\n    return (asia_real)((a > R(0.0)) - (a < R(0.0)));\n}\n",
    "asia_isfinite": "static asia_real asia_isfinite(asia_real a)\n"
    "{\n    return isfinite(a) ? R(1.0) : R(0.0);\n}\n",
}


class CTarget(Target):
    """Target `c`: `model.c`, `model.h`, `main.c`, `Makefile`, `example.csv`."""

    name = "c"
    usage = """```c
asia_state x;
asia_init(&x, past_u, past_y, u);     /* row by row, the oldest first; u: first input */
asia_output(&x, u, y);                /* y of the present sample */
asia_update(&x, u);                   /* to the next sample; asia_step does both */
```
`make` builds `model`, which simulates a CSV file: `./model example.csv`. With `-DASIA_FLOAT` all
numbers are `float`; where that differs too much, `model.h` refuses it. The functions use no heap
and no global variables. Do not compile with `-ffast-math`: a value that is no number must stay
one."""

    def print(self, model: ExportModel) -> Printed:
        """Print the files; the sizes are those of `double`."""
        source, work = c_source(model)
        outputs, columns = (
            column_names(model.outputs),
            column_names((*model.inputs, *model.outputs)),
        )
        files = {
            "model.c": source.encode(),
            "model.h": header(model).encode(),
            "main.c": template("main.c", NAMES=outputs, COLUMNS=columns).encode(),
            "Makefile": template("Makefile").encode(),
        }
        if model.example is not None:
            files["example.csv"] = example_csv(model, model.example).encode()
        states = sum(math.prod(s) for s in model.lowered.states)
        sizes = {"state_ram": 8 * max(states, 1), "stack_ram": 8 * work}
        code = _code_bytes(files)
        return Printed(files, sizes | ({} if code is None else {"code": code}))

    def run(self, folder: Path, windows: Sequence[SimulatedSegment]) -> list[Answers] | str:
        """Compile the files here and simulate in double and in single precision."""
        compiler = c_compiler()
        if compiler is None:
            return "no C compiler here: not compared"
        return [_simulated(compiler, folder, windows, single=single) for single in (False, True)]


def c_compiler() -> str | None:
    """Path of a C compiler; None if there is none."""
    return shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def c_source(model: ExportModel) -> tuple[str, int]:
    """Print `model.c`; return it with the most numbers that one of its functions keeps on the
    stack."""
    low, constants = model.lowered, Constants()
    functions = Functions(constants)
    parts = zip(slices(low.states), low.states, strict=True)
    states = [
        replace(value_at("x->x", part.start, shape), overwritten=True) for part, shape in parts
    ]
    u, y = value_at("u", 0, (low.nu,)), value_at("y", 0, (low.ny,))
    window = [
        value_at("past_u", 0, (low.n_past_u, low.nu)),
        value_at("past_y", 0, (low.n_past_y, low.ny)),
        u,
    ]
    parts = (
        (low.initial, window, states), (low.output, [*states, u], [y]),
        (low.update, [*states, u], states), (low.step, [*states, u], [y, *states]),
    )  # fmt: skip
    steps = [
        functions.function(head, *part) for head, part in zip(_STEP_FUNCTIONS, parts, strict=True)
    ]
    body = "\n".join([*functions.texts, *steps])
    title = re.sub(r"[^A-Za-z0-9 _.,:-]", "_", f"{model.problem}: {model.use} of run {model.name}")
    top = [f"/* {title}. */", '#include "model.h"', *preamble(body, constants)]
    return "\n".join([*top, body]), functions.work


def preamble(body: str, constants: Constants) -> list[str]:
    """Macros, constants and helpers that the functions use."""
    return [
        "#include <math.h>",
        "",
        "#define R(x) ((asia_real)(x))",
        "#ifdef ASIA_FLOAT",
        "#define F(name) name##f",
        "#else",
        "#define F(name) name",
        "#endif",
        "",
        *constants.used_in(body),
        "",
        "\n".join(text for name, text in _HELPERS.items() if f"{name}(" in body),
    ]


_STEP_FUNCTIONS = (
    "void asia_init(asia_state *x, const asia_real *past_u, const asia_real *past_y, "
    "const asia_real *u)",
    "void asia_output(const asia_state *x, const asia_real *u, asia_real *y)",
    "void asia_update(asia_state *x, const asia_real *u)",
    "void asia_step(asia_state *x, const asia_real *u, asia_real *y)",
)


def run_compiled(
    compiler: str,
    source: Path,
    harness: str | Path,
    name: str,
    calls: Sequence[tuple[Sequence[Array], tuple[int, ...]]],
    *,
    single: bool = False,
) -> tuple[list[Array], float]:
    """Compile a file with a harness, and call its function with arrays.

    Args:
        calls: arrays that the function reads, and shape of the one that it fills

    Returns:
        Arrays that it filled, and the seconds of all calls.
    """
    kind, real = (np.float32, ctypes.c_float) if single else (np.float64, ctypes.c_double)
    with tempfile.TemporaryDirectory(prefix="asia-c-") as made:
        own, library = Path(made) / "harness.c", Path(made) / "model.so"
        own.write_text(template(harness))
        words = [*FLAGS, "-fPIC", "-shared", f"-I{source.parent}", str(source), str(own)]
        words += ["-o", str(library), "-lm", *(["-DASIA_FLOAT"] if single else [])]
        compile_c(compiler, words, Path(made), "C")
        run = ctypes.CDLL(str(library))[name]
        run.restype = None
        found: list[Array] = []
        seconds = 0.0
        for read, shape in calls:
            arrays = [*(np.ascontiguousarray(a, kind) for a in read), np.empty(shape, kind)]
            pointers = [a.ctypes.data_as(ctypes.POINTER(real)) for a in arrays]
            begin = time.perf_counter()
            run(*pointers, ctypes.c_long(len(arrays[-1])))
            seconds += time.perf_counter() - begin
            found.append(arrays[-1].astype(np.float64))
        return found, seconds


def _simulated(
    compiler: str, folder: Path, windows: Sequence[SimulatedSegment], *, single: bool
) -> Answers:
    calls = [((w.past_u, w.past_y, w.u), w.y_hat.shape) for w in windows]
    y_hat, seconds = run_compiled(
        compiler, folder / "model.c", "harness.c", "asia_run", calls, single=single
    )
    if not single:
        return Answers("double", tuple(y_hat), seconds)
    refused = (folder / "model.h").read_text().replace(FLOAT, NO_FLOAT).encode()
    return Answers("float", tuple(y_hat), seconds, True, {"model.h": refused})


def compile_c(compiler: str, words: Sequence[str], folder: Path, printed: str) -> None:
    """Run a C compiler in a folder. printed: name of the code, for the error."""
    done = subprocess.run(
        [compiler, *words], cwd=folder, capture_output=True, text=True, check=False, timeout=300
    )
    if done.returncode != 0:
        raise InternalError(f"the printed {printed} does not compile: {done.stderr[:1000]}")


def _code_bytes(files: dict[str, bytes]) -> int | None:
    """Size of the instructions and constants of `model.c`, as compiled for size here."""
    compiler, size = c_compiler(), shutil.which("size")
    if compiler is None or size is None:
        return None
    with tempfile.TemporaryDirectory(prefix="asia-c-") as made:
        for name in ("model.c", "model.h"):
            (Path(made) / name).write_bytes(files[name])
        words = ["-std=c99", "-Os", "-c", "model.c", "-o", "model.o"]
        try:
            compile_c(compiler, words, Path(made), "C")
        except InternalError:
            return None
        completed = subprocess.run(
            [size, "model.o"], cwd=made, capture_output=True, text=True, check=False, timeout=60
        )
        found = re.search(r"\n\s*(\d+)\s+(\d+)", completed.stdout)
        return int(found[1]) + int(found[2]) if found else None
