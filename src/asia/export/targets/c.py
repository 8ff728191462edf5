"""C99 without allocation: model, header, command-line program."""

from __future__ import annotations

import ctypes
import math
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asia.data.trajectory import Array
from asia.errors import InternalError
from asia.export.model import ExportModel, Printed, TrainingWindow
from asia.export.target import Answers
from asia.lowering.program import Node, Program, Shape

# Files around `model.c`.


MAKEFILE = """# make; ./model example.csv
CFLAGS ?= -std=c99 -Wall -Wextra -pedantic -Werror -O2

model: main.c model.c model.h
\t$(CC) $(CFLAGS) main.c model.c -o model -lm

clean:
\trm -f model

.PHONY: clean
"""

HARNESS = """#include "model.h"

void asia_run(const asia_real *past_u, const asia_real *past_y, const asia_real *u, asia_real *y,
              long samples);

void asia_run(const asia_real *past_u, const asia_real *past_y, const asia_real *u, asia_real *y,
              long samples)
{
    asia_state x;
    long k;
    asia_init(&x, past_u, past_y, u);
    for (k = 0; k < samples; ++k)
        asia_step(&x, u + k * ASIA_INPUTS, y + k * ASIA_OUTPUTS);
}
"""

FLOAT = "typedef float asia_real;"
"""Line of `model.h` that selects single precision; it is replaced by an error where single
precision is not good enough."""
NO_FLOAT = '#error "in float this model differs too much from its simulation in double, see USE.md"'

_HEADER = (
    """/* {title}
 *
 * Sampling time {sampling_time!r} s; inputs are held between samples.
{signals}
 */
#ifndef ASIA_MODEL_H
#define ASIA_MODEL_H

#ifdef ASIA_FLOAT
"""
    + FLOAT
    + """
#else
typedef double asia_real;
#endif

#define ASIA_INPUTS {nu}
#define ASIA_OUTPUTS {ny}
#define ASIA_PAST_INPUTS {past_u}
#define ASIA_PAST_OUTPUTS {past_y}
#define ASIA_SAMPLING_TIME {sampling_time!r}

typedef struct {{
    asia_real x[{states}];
}} asia_state;

/* past_u[ASIA_PAST_INPUTS][ASIA_INPUTS] and past_y[ASIA_PAST_OUTPUTS][ASIA_OUTPUTS], the oldest
 * sample first; u: the input of the first sample to simulate. */
void asia_init(asia_state *x, const asia_real *past_u, const asia_real *past_y,
               const asia_real *u);
/* y of the sample that u belongs to. */
void asia_output(const asia_state *x, const asia_real *u, asia_real *y);
/* From this sample to the next. */
void asia_update(asia_state *x, const asia_real *u);
/* asia_output, then asia_update, in one computation. */
void asia_step(asia_state *x, const asia_real *u, asia_real *y);

#endif
"""
)

_MAIN = r"""/* Simulates a CSV file: a row of names, then rows of inputs and outputs. Outputs of the
 * first rows start the model, the others are compared with. */
#include "model.h"
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define PAST (ASIA_PAST_INPUTS > ASIA_PAST_OUTPUTS ? ASIA_PAST_INPUTS : ASIA_PAST_OUTPUTS)
#define COLUMNS (ASIA_INPUTS + ASIA_OUTPUTS)

static int next_row(FILE *file, asia_real *row)
{
    char line[65536];
    char *at = line;
    int i;
    if (fgets(line, sizeof line, file) == NULL)
        return 0;
    for (i = 0; i < COLUMNS; ++i) {
        char *end;
        row[i] = (asia_real)strtod(at, &end);
        if (end == at)
            return 0;
        at = *end == ',' ? end + 1 : end;
    }
    return 1;
}

int main(int argc, char **argv)
{
    static asia_real past_u[ASIA_PAST_INPUTS * ASIA_INPUTS + 1];
    static asia_real past_y[ASIA_PAST_OUTPUTS * ASIA_OUTPUTS + 1];
    asia_real row[COLUMNS], y[ASIA_OUTPUTS], worst = 0;
    asia_state x;
    char names[65536], *at;
    long k, i;
    FILE *file = argc == 2 ? fopen(argv[1], "r") : NULL;
    if (file == NULL) {
        fprintf(stderr, "usage: model record.csv (%d inputs, then %d outputs)\n", ASIA_INPUTS,
                ASIA_OUTPUTS);
        return 2;
    }
    for (i = 1, at = fgets(names, sizeof names, file); at != NULL && *at != '\0'; ++at)
        i += *at == ',';
    if (i != COLUMNS) {
        fprintf(stderr, "%s: expected the columns {columns}, separated by commas\n", argv[1]);
        return 2;
    }
    printf("{names}\n");
    for (k = 0; next_row(file, row); ++k) {
        long from_u = k - (PAST - ASIA_PAST_INPUTS), from_y = k - (PAST - ASIA_PAST_OUTPUTS);
        if (k < PAST) {
            if (from_u >= 0)
                memcpy(past_u + from_u * ASIA_INPUTS, row, ASIA_INPUTS * sizeof *row);
            if (from_y >= 0)
                memcpy(past_y + from_y * ASIA_OUTPUTS, row + ASIA_INPUTS,
                       ASIA_OUTPUTS * sizeof *row);
            continue;
        }
        if (k == PAST)
            asia_init(&x, past_u, past_y, row);
        asia_step(&x, row, y);
        for (i = 0; i < ASIA_OUTPUTS; ++i) {
            double gap = fabs((double)(y[i] - row[ASIA_INPUTS + i]));
            printf("%s%.17g", i ? "," : "", (double)y[i]);
            if (gap > (double)worst)
                worst = (asia_real)gap;
        }
        printf("\n");
    }
    fclose(file);
    if (k <= PAST) {
        fprintf(stderr, "%s: expected more than %d rows of numbers, found %ld\n", argv[1], PAST, k);
        return 2;
    }
    fprintf(stderr, "%ld samples, largest difference from the file %.3g\n", k - PAST,
            (double)worst);
    return 0;
}
"""


def header(model: ExportModel) -> str:
    """Text of `model.h`."""
    low = model.lowered
    rows = [
        f" * {side} {i}: {_plain_files(s.name)} {_plain_files(s.unit)}, trained from {a:g} to {b:g}"
        for side, signals, span in (
            ("input", model.inputs, model.input_range),
            ("output", model.outputs, model.output_range),
        )
        for i, (s, (a, b)) in enumerate(zip(signals, span.tolist(), strict=True))
    ]
    return _HEADER.format(
        title=_plain_files(f"{model.problem}: {model.use} of run {model.name}"),
        signals="\n".join(rows),
        sampling_time=model.sampling_time,
        nu=low.nu,
        ny=low.ny,
        past_u=low.n_past_u,
        past_y=low.n_past_y,
        states=max(sum(math.prod(s) for s in low.states), 1),
    )


def main_file(model: ExportModel) -> str:
    """Text of `main.c`."""
    columns = ",".join(_plain_files(s.name) for s in (*model.inputs, *model.outputs))
    names = ",".join(_plain_files(s.name) for s in model.outputs)
    return _MAIN.replace("{names}", names).replace("{columns}", columns)


def example_csv(model: ExportModel, window: TrainingWindow) -> str:
    """Window in the CSV format of `main.c`: the outputs after its past are those of ASIA's
    simulation."""
    past = max(len(window.past_u), len(window.past_y))
    u = np.concatenate([np.zeros((past - len(window.past_u), model.lowered.nu)), window.past_u])
    y = np.concatenate([np.zeros((past - len(window.past_y), model.lowered.ny)), window.past_y])
    rows = np.concatenate(
        [np.concatenate([u, window.u]), np.concatenate([y, window.y_hat])], axis=1
    )
    names = ",".join(_plain_files(s.name) for s in (*model.inputs, *model.outputs))
    return "\n".join([names, *(",".join(repr(float(v)) for v in row) for row in rows), ""])


def _plain_files(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9 _.:/^-]", "_", text)


# Index arithmetic of array operations in printed C.


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

    def places(self, array: NDArray[np.int64]) -> str:
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


class CTarget:
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

    def missing(self) -> str | None:
        """Return None: printing needs nothing."""
        return None

    def print(self, model: ExportModel) -> Printed:
        """Print the files; the sizes are those of `double`."""
        source, work = c_source(model)
        files = {
            "model.c": source.encode(),
            "model.h": header(model).encode(),
            "main.c": main_file(model).encode(),
            "Makefile": MAKEFILE.encode(),
        }
        if model.example is not None:
            files["example.csv"] = example_csv(model, model.example).encode()
        states = sum(math.prod(s) for s in model.lowered.states)
        sizes = {"state_ram": 8 * max(states, 1), "stack_ram": 8 * work}
        code = _code_bytes(files)
        return Printed(files, sizes | ({} if code is None else {"code": code}))

    def run(self, folder: Path, windows: Sequence[TrainingWindow]) -> list[Answers] | str:
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
    states = [_place("x->x", start, s) for start, s in _starts(low.states)]
    u, y = _place("u", 0, (low.nu,)), _place("y", 0, (low.ny,))
    window = [
        _place("past_u", 0, (low.n_past_u, low.nu)),
        _place("past_y", 0, (low.n_past_y, low.ny)),
        u,
    ]
    parts = [
        _function("init", low.initial, window, states, constants),
        _function("output", low.output, [*states, u], [y], constants),
        _function("update", low.update, [*states, u], states, constants),
        _function("step", low.step, [*states, u], [y, *states], constants),
    ]
    body = "\n".join(text for text, _ in parts)
    helpers = "\n".join(text for name, text in _HELPERS.items() if f"{name}(" in body)
    top = [
        f"/* {_plain(model.problem)}: {_plain(model.use)} of run {_plain(model.name)}. */",
        '#include "model.h"',
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
        helpers,
    ]
    return "\n".join([*top, body]), max(size for _, size in parts)


_HEADS = {
    "init": "void asia_init(asia_state *x, const asia_real *past_u, const asia_real *past_y, "
    "const asia_real *u)",
    "output": "void asia_output(const asia_state *x, const asia_real *u, asia_real *y)",
    "update": "void asia_update(asia_state *x, const asia_real *u)",
    "step": "void asia_step(asia_state *x, const asia_real *u, asia_real *y)",
}


def _function(
    name: str, program: Program, inputs: list[Value], outputs: list[Value], constants: Constants
) -> tuple[str, int]:
    code = Statements(constants)
    found = code.run(program, inputs)
    # Outputs may overwrite inputs: values outside `w` are copied there first.
    kept = [code.own(value) for value in found]
    for target, value in zip(outputs, kept, strict=True):
        code.copy(target.at, value.at, math.prod(value.shape))
    lines = [_HEADS[name], "{"]
    if code.memory.size:
        lines.append(f"    asia_real w[{code.memory.size}];")
    if code.loops:
        lines.append(f"    int {', '.join(f'i{d}' for d in range(code.loops))};")
    text = "\n".join(code.lines)
    unused = [
        n for n in re.findall(r"\*(\w+)[,)]", _HEADS[name]) if not re.search(rf"\b{n}\b", text)
    ]
    lines += [text, *(f"    (void){n};" for n in unused), "}", ""]
    return "\n".join(lines), code.memory.size


def _place(name: str, start: int, shape: tuple[int, ...]) -> Value:
    if start == 0:
        return Value(lambda i: f"{name}[{i}]", shape)
    return Value(lambda i: f"{name}[{start} + {i}]", shape)


def _starts(shapes: Sequence[tuple[int, ...]]) -> list[tuple[int, tuple[int, ...]]]:
    found: list[tuple[int, tuple[int, ...]]] = []
    start = 0
    for shape in shapes:
        found.append((start, shape))
        start += math.prod(shape)
    return found


def _plain(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9 _.,:-]", "_", text)


def _simulated(
    compiler: str, folder: Path, windows: Sequence[TrainingWindow], *, single: bool
) -> Answers:
    with tempfile.TemporaryDirectory(prefix="asia-c-") as made:
        library = compiled(compiler, folder, Path(made), single=single)
        kind, real = (np.float32, ctypes.c_float) if single else (np.float64, ctypes.c_double)
        run = ctypes.CDLL(str(library)).asia_run
        run.argtypes = [*[ctypes.POINTER(real)] * 4, ctypes.c_long]
        run.restype = None
        y_hat: list[Array] = []
        seconds = 0.0
        for window in windows:
            arrays: list[Any] = [
                np.ascontiguousarray(a, kind) for a in (window.past_u, window.past_y, window.u)
            ]
            y = np.empty(window.y_hat.shape, kind)
            pointers = [a.ctypes.data_as(ctypes.POINTER(real)) for a in (*arrays, y)]
            begin = time.perf_counter()
            run(*pointers, len(y))
            seconds += time.perf_counter() - begin
            y_hat.append(y.astype(np.float64))
    if not single:
        return Answers("double", tuple(y_hat), seconds)
    refused = (folder / "model.h").read_text().replace(FLOAT, NO_FLOAT).encode()
    return Answers("float", tuple(y_hat), seconds, True, {"model.h": refused})


def compiled(compiler: str, folder: Path, made: Path, *, single: bool) -> Path:
    """Compile a library of the functions and of one that runs a whole simulation."""
    harness, library = made / "harness.c", made / ("float.so" if single else "double.so")
    harness.write_text(HARNESS)
    command = [compiler, *FLAGS, "-fPIC", "-shared", f"-I{folder}", str(folder / "model.c")]
    command += [str(harness), "-o", str(library), "-lm"]
    if single:
        command.append("-DASIA_FLOAT")
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    if done.returncode != 0:
        raise InternalError(f"the printed C does not compile: {done.stderr[:1000]}")
    return library


def _code_bytes(files: dict[str, bytes]) -> int | None:
    """Size of the instructions and constants of `model.c`, as compiled for size here."""
    compiler, size = c_compiler(), shutil.which("size")
    if compiler is None or size is None:
        return None
    with tempfile.TemporaryDirectory(prefix="asia-c-") as made:
        for name in ("model.c", "model.h"):
            (Path(made) / name).write_bytes(files[name])
        command = [compiler, "-std=c99", "-Os", "-c", "model.c", "-o", "model.o"]
        done = subprocess.run(command, cwd=made, capture_output=True, check=False, timeout=300)
        if done.returncode != 0:
            return None
        completed = subprocess.run(
            [size, "model.o"], cwd=made, capture_output=True, text=True, check=False, timeout=60
        )
        found = re.search(r"\n\s*(\d+)\s+(\d+)", completed.stdout)
        return int(found[1]) + int(found[2]) if found else None
