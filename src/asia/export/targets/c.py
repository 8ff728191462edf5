"""C99 without allocation: model, header, command-line program."""

import ctypes
import math
import re
import shutil
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from asia._files import PACKAGE
from asia.data.segment import SimulatedSegment
from asia.data.trajectory import Array, Signal
from asia.errors import InternalError
from asia.export.model import ExportModel, Printed
from asia.export.target import Answers, Target
from asia.export.targets.indices import Places, inside_places, kept_axes, slices, source_places
from asia.lowering.program import Node, Program, Shape

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


def runs(places: Places) -> list[tuple[int, int, int]]:
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
    if value == int(value) and abs(value) < 1e6:
        return f"R({value:.1f})"
    return f"R({value.hex()})"


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
# Numbers lie in one array `w` of a function, whose places are used again once nothing reads them;
# a value that is computed elementwise and read once has no place at all. Constants are `static
# const`.


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
        nodes = list(enumerate(program.nodes, program.first_node))
        outputs = set(program.outputs)
        last = {i: place for place, node in nodes for i in node.operands}
        # Outputs count as read twice, so that they are stored.
        count = Counter([i for _, node in nodes for i in node.operands])
        count.update([*program.outputs, *program.outputs])
        loops: dict[int, list[Value]] = {}
        for place, node in nodes:
            operands = [values[i] for i in node.operands]
            if node.op == "loop":
                loops[place] = self._loop(node, operands)
                held = frozenset[int]().union(*(part.places for part in loops[place]))
                values.append(Value(str, (), places=held))
            elif node.op == "part":
                values.append(loops[node.operands[0]][node.attrs[0]])
            else:
                values.append(self._value(node, operands, count[place]))
            # Free the regions of `w` that nothing reads any more.
            live = {
                region
                for i, value in enumerate(values)
                if i in outputs or last.get(i, -1) > place
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
        return value_at("w", start, shape, frozenset((start,)))

    def _value(self, node: Node, operands: list[Value], uses: int) -> Value:
        if node.op == "reshape":
            return Value(operands[0].at, node.shape, operands[0].plain, operands[0].places)
        if node.op == "broadcast" and not operands[0].shape:
            one = operands[0]
            spread = Value(lambda i: one.at("0"), node.shape, one.plain, one.places)
            return self._settled(spread, uses)
        if node.op in _ELEMENTWISE:
            return self._settled(_elementwise(node, operands), uses)
        if node.op == "matmul":
            return self._matmul(node, [self._placed(o) for o in operands])
        if node.op in _REDUCED:
            return self._reduced(node, self._placed(operands[0]))
        if node.op == "concat":
            return self._concat(node, operands)
        if node.op == "pad":
            target = self.region(node.shape)
            self.copy(target.at, operands[1].at, math.prod(node.shape))
            source = self._placed(operands[0])
            self._assign(target.at, source.at, inside_places(node, source.shape), put=True)
            return target
        source = self._placed(operands[0])
        at, places = source.at, source_places(node, source.shape)
        if len(places) and (places == places[0] + np.arange(len(places))).all():
            # A contiguous part is read in place.
            start = int(places[0])
            moved = at if start == 0 else lambda i: at(f"{start} + {i}")
            return Value(moved, node.shape, True, source.places)
        target = self.region(node.shape)
        self._assign(target.at, at, places, put=False)
        return target

    def _settled(self, value: Value, uses: int) -> Value:
        """Keep a value as an expression if it is short and read once, else store it."""
        short = uses <= 1 and len(value.at("i")) < _MOST_TEXT
        return value if short else self._placed(value)

    def _placed(self, value: Value) -> Value:
        return value if value.plain else self._kept(value)

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
        for i, axis in zip(names, order, strict=True):
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
        outer, wide = math.prod(node.shape[:axis]), math.prod(node.shape[axis:])
        start = 0
        for value in operands:
            # Rows of `size` numbers go, from `start` on, into rows of `wide` ones.
            size = math.prod(value.shape[axis:])
            if outer == 1:
                self.copy(
                    _through(target.at, lambda i, start=start: f"{start} + {i}"), value.at, size
                )
            elif outer * size:
                i, j = self.counter(0), self.counter(1)
                put = target.at(f"{i} * {wide} + {start} + {j}")
                read = value.at(f"({i} * {size} + {j})")
                inner = f"for ({j} = 0; {j} < {size}; ++{j})"
                self.line(f"for ({i} = 0; {i} < {outer}; ++{i}) {inner} {put} = {read};")
            start += size
        return target

    def _assign(self, target: Element, source: Element, places: Places, *, put: bool) -> None:
        """Print target[places] = source, or target = source[places]."""
        segments = runs(places)
        i = self.counter(0)
        if len(segments) > _MOST_RUNS and len(places) > 2 * _MOST_RUNS:
            name = self.constants.places(places)
            there = (f"{name}[{i}]", i) if put else (i, f"{name}[{i}]")
            loop = f"for ({i} = 0; {i} < {len(places)}; ++{i})"
            self.line(f"{loop} {target(there[0])} = {source(there[1])};")
            return
        done = 0
        for start, step, count in segments:

            def moving(j: str, start: int = start, step: int = step) -> str:
                return f"{start} + {j} * {step}" if step != 1 else f"{start} + {j}"

            def counting(j: str, done: int = done) -> str:
                return f"{done} + {j}"

            here, there = (moving, counting) if put else (counting, moving)
            self.copy(_through(target, here), _through(source, there), count)
            done += count

    def _loop(self, node: Node, operands: list[Value]) -> list[Value]:
        assert node.body is not None
        length, same, carried = node.attrs
        body = node.body
        carry = [self._kept(o) for o in operands[same : same + carried]]
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
        self._release([r for r, depth in self._mine.items() if depth > self._indent])
        self.line("} }")
        return [*carry, *stacked]

    def _kept(self, value: Value) -> Value:
        """Copy a value to a region of its own, so that carried values may be overwritten."""
        target = self.region(value.shape)
        self.copy(target.at, value.at, math.prod(value.shape))
        return target


def value_at(name: str, start: int, shape: Shape, places: frozenset[int] = frozenset()) -> Value:
    prefix = f"{start} + " if start else ""
    return Value(lambda i: f"{name}[{prefix}{i}]", shape, places=places)


def _row(value: Value, index: str) -> Element:
    size = math.prod(value.shape[1:])
    return lambda i: value.at(f"{index} * {size} + {i}")


def _through(element: Element, place: Callable[[str], str]) -> Element:
    return lambda i: element(place(i))


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
    parts = zip(slices(low.states), low.states, strict=True)
    states = [value_at("x->x", part.start, shape) for part, shape in parts]
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
    functions = [
        c_function(head, *part, constants)
        for head, part in zip(_STEP_FUNCTIONS, parts, strict=True)
    ]
    body = "\n".join(text for text, _ in functions)
    title = re.sub(r"[^A-Za-z0-9 _.,:-]", "_", f"{model.problem}: {model.use} of run {model.name}")
    top = [f"/* {title}. */", '#include "model.h"', *preamble(body, constants)]
    return "\n".join([*top, body]), max(size for _, size in functions)


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


def c_function(
    head: str, program: Program, inputs: list[Value], outputs: list[Value], constants: Constants
) -> tuple[str, int]:
    code = Statements(constants)
    found = code.run(program, inputs)
    # Outputs may overwrite inputs: values outside `w` are copied there first.
    kept = [code.own(value) for value in found]
    for target, value in zip(outputs, kept, strict=True):
        code.copy(target.at, value.at, math.prod(value.shape))
    lines = [head, "{"]
    if code.memory.size:
        lines.append(f"    asia_real w[{code.memory.size}];")
    if code.loops:
        lines.append(f"    int {', '.join(f'i{d}' for d in range(code.loops))};")
    text = "\n".join(code.lines)
    unused = [n for n in re.findall(r"\*(\w+)[,)]", head) if not re.search(rf"\b{n}\b", text)]
    lines += [text, *(f"    (void){n};" for n in unused), "}", ""]
    return "\n".join(lines), code.memory.size


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
