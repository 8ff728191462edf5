"""Readable Python file that needs only NumPy."""

import math
import re
import runpy
import textwrap
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from asia.data.segment import SimulatedSegment
from asia.data.trajectory import Array
from asia.export.model import ExportModel, Printed
from asia.export.target import Answers, Target
from asia.lowering.program import LoweredModel, Node, Program

_SYMBOLS = {"add": "+", "sub": "-", "mul": "*", "div": "/", "matmul": "@"}
_COMPARED = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
_NAMES = {
    "max": "maximum",
    "min": "minimum",
    "pow": "power",
    "asin": "arcsin",
    "acos": "arccos",
    "atan": "arctan",
    "atan2": "arctan2",
}
_REDUCED = {"rsum": "sum", "rmax": "max", "rmin": "min", "rprod": "prod"}
_WIDEST = 76
_FILE = "model.py"


class NumpyTarget(Target):
    """Target `numpy`: `model.py`."""

    name = "numpy"
    usage = """```python
from model import simulate
y_hat = simulate(past_u, past_y, u)      # (n_past_u, nu), (n_past_y, ny), (H, nu) -> (H, ny)
```
Sample by sample: `x = initial(past_u, past_y, u)`, then `y = output(x, u)` and
`x = update(x, u)`, where `u` (nu,) is the input of the present sample."""

    def print(self, model: ExportModel) -> Printed:
        """Print `model.py`."""
        return Printed({_FILE: _source(model).encode()})

    def run(self, folder: Path, windows: Sequence[SimulatedSegment]) -> list[Answers] | str:
        """Simulate with the file as a user runs it."""
        simulate = runpy.run_path(str(folder / _FILE))["simulate"]
        begin = time.perf_counter()
        y_hat = tuple(simulate(w.past_u, w.past_y, w.u) for w in windows)
        return [Answers("double", y_hat, time.perf_counter() - begin)]


def _source(model: ExportModel) -> str:
    return "\n".join([_head(model), *model_functions(model.lowered), _SIMULATE])


def model_functions(low: LoweredModel) -> list[str]:
    """Print the constants of a model, and its functions `initial`, `output`, `update` and `step`;
    they use NumPy as `np`."""
    writer = _Constants()
    states = [f"x{i}" for i in range(len(low.states))]
    first = [f"    {', '.join(states)}{',' if len(states) == 1 else ''} = x"] if states else []
    window, inputs = ["past_u", "past_y", "u"], [*states, "u"]
    parts = [
        _function("initial(past_u, past_y, u)", low.initial, window, writer, []),
        _function("output(x, u)", low.output, inputs, writer, first),
        _function("update(x, u)", low.update, inputs, writer, first),
        _function("step(x, u)", low.step, inputs, writer, first),
    ]
    return [*writer.lines, "", *parts]


_SIMULATE = '''
def simulate(past_u, past_y, u):
    """Open loop, physical units: past_u (n_past_u, nu), past_y (n_past_y, ny), u (H, nu)."""
    u = np.asarray(u, float)
    x = initial(np.asarray(past_u, float), np.asarray(past_y, float), u[0])
    y = np.empty((len(u), len(OUTPUTS)))
    with np.errstate(all="ignore"):
        for k in range(len(u)):
            y[k], x = step(x, u[k])
    return y
'''


def _head(model: ExportModel) -> str:
    names = [s.name for s in model.inputs], [s.name for s in model.outputs]
    units = [s.unit for s in model.inputs], [s.unit for s in model.outputs]
    notes = "".join(f"\n{n}" for n in model.notes)
    title = re.sub(r"[^A-Za-z0-9 _.,:-]", "_", f"{model.use} of run {model.name}")
    return f'''"""Simulation model: {title}.

x = initial(past_u, past_y, u); y = output(x, u); x = update(x, u): u is the input of the present
sample, held until the next one. step(x, u) gives both at once.{notes}
"""

import numpy as np

SAMPLING_TIME = {model.sampling_time!r}  # s
INPUTS = {names[0]!r}
INPUT_UNITS = {units[0]!r}
INPUT_RANGE = {model.input_range.tolist()!r}  # of the training records
OUTPUTS = {names[1]!r}
OUTPUT_UNITS = {units[1]!r}
OUTPUT_RANGE = {model.output_range.tolist()!r}
BANDS = {[(b.level, b.half_width.tolist()) for b in model.bands]!r}  # level, half width
PAST_INPUTS, PAST_OUTPUTS = {model.lowered.n_past_u}, {model.lowered.n_past_y}
'''


class _Constants:
    """Arrays at the top of the file, equal ones once."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._names: dict[bytes, str] = {}

    def of(self, array: Array) -> str:
        if array.ndim == 0:
            return _number(float(array))
        key = str(array.shape).encode() + array.tobytes()
        if key not in self._names:
            name = f"K{len(self._names)}"
            self._names[key] = name
            numbers = ", ".join(_number(float(v)) for v in array.reshape(-1))
            text = textwrap.fill(numbers, 96, initial_indent="    ", subsequent_indent="    ")
            shape = f".reshape{array.shape}" if array.ndim > 1 else ""
            self.lines.append(f"{name} = np.array([\n{text}\n]){shape}")
        return self._names[key]


def _number(value: float) -> str:
    if math.isinf(value):
        return "np.inf" if value > 0 else "-np.inf"
    return repr(value)


def _function(
    head: str, program: Program, inputs: Sequence[str], constants: _Constants, first: list[str]
) -> str:
    body = _Body(constants)
    results = body.write(program.plain, list(inputs), "    ")
    name = head.partition("(")[0]
    if name == "output":
        end = f"    return {results[0]}"
    elif name == "step":
        end = f"    return {results[0]}, ({_tuple(results[1:])})"
    else:
        end = f"    return ({_tuple(results)})"
    lines = [f"def {head}:", *first, *body.lines, end]
    return "\n".join(lines) + "\n\n"


def _tuple(names: Sequence[str]) -> str:
    return f"{names[0]}," if len(names) == 1 else ", ".join(names)


class _Body:
    """Statements of one function; a short value that is used once is written inline."""

    def __init__(self, constants: _Constants) -> None:
        self.lines: list[str] = []
        self._constants = constants
        self._count = 0

    def write(self, program: Program, inputs: list[str], indent: str) -> list[str]:
        names = [*inputs, *(self._constants.of(c) for c in program.constants)]
        uses = Counter(i for node in program.nodes for i in node.operands)
        uses.update(program.outputs)
        for place, node in enumerate(program.nodes, program.first_node):
            read = [names[i] for i in node.operands]
            if node.op == "loop":
                names.append(self._loop(node, read, indent))
                continue
            text = f"{read[0]}_{node.attrs[0]}" if node.op == "part" else _expression(node, read)
            short = node.op == "part" or (uses[place] == 1 and len(text) < _WIDEST)
            names.append(text if short else self._named(text, indent))
        return [names[i] for i in program.outputs]

    def _named(self, text: str, indent: str) -> str:
        self._count += 1
        name = f"v{self._count}"
        self.lines.append(f"{indent}{name} = {text}")
        return name

    def _loop(self, node: Node, read: list[str], indent: str) -> str:
        assert node.body is not None
        self._count += 1
        name, (length, same, carried) = f"w{self._count}", node.attrs
        fixed, carry, rows = read[:same], read[same : same + carried], read[same + carried :]
        results = [f"{name}_{k}" for k in range(len(node.body.outputs))]
        for place, value in enumerate(carry):
            self.lines.append(f"{indent}{results[place]} = {value}")
        stacked = node.body.output_shapes[carried:]
        for place, shape in zip(results[carried:], stacked, strict=True):
            self.lines.append(f"{indent}{place} = np.empty({(length, *shape)})")
        self.lines.append(f"{indent}for i{name} in range({length}):")
        inner = indent + "    "
        inputs = [*fixed, *results[:carried], *(f"{r}[i{name}]" for r in rows)]
        found = self.write(node.body, inputs, inner)
        for place, value in zip(results[carried:], found[carried:], strict=True):
            self.lines.append(f"{inner}{place}[i{name}] = {value}")
        if carried:
            left = ", ".join(results[:carried])
            self.lines.append(f"{inner}{left} = {', '.join(found[:carried])}")
        elif not stacked:
            self.lines.append(f"{inner}pass")
        return name


def _expression(node: Node, read: list[str]) -> str:
    op, a, x = node.op, node.attrs, read[0]
    if op in _SYMBOLS:
        return f"({x} {_SYMBOLS[op]} {read[1]})"
    if op in _COMPARED:
        return f"(({x} {_COMPARED[op]} {read[1]}) * 1.0)"
    if op in _REDUCED:
        return f"{x}.{_REDUCED[op]}(axis={tuple(a)})"
    match op:
        case "neg":
            return f"(-{x})"
        case "isfinite":
            return f"(np.isfinite({x}) * 1.0)"
        case "select":
            return f"np.where({x}, {read[1]}, {read[2]})"
        case "reshape":
            return f"np.reshape({x}, {tuple(a)})"
        case "transpose":
            return f"{x}.transpose({tuple(a)})"
        case "concat":
            return f"np.concatenate([{', '.join(read)}], axis={a[0]})"
        case "broadcast":
            wide, axes = tuple(a[1 : 1 + a[0]]), a[1 + a[0] :]
            if not axes:
                return f"np.full({wide}, {x})"
            places = ", ".join(":" if axis in axes else "None" for axis in range(len(wide)))
            return f"np.broadcast_to({x}[{places}], {wide})"
        case "slice":
            rank = len(a) // 3
            cuts = zip(a[:rank], a[rank : 2 * rank], a[2 * rank :], strict=True)
            indices = [f"{i}:{j}" + (f":{step}" if step != 1 else "") for i, j, step in cuts]
            return f"{x}[{', '.join(indices)}]"
        case "pick":
            wide, picked = tuple(a[1 : 1 + a[0]]), list(a[1 + a[0] :])
            return f"{x}.reshape(-1)[{picked}].reshape({wide})"
        case "pad":
            rank = len(a) // 2
            counts = list(zip(a[:rank], a[rank:], strict=True))
            return f"np.pad({x}, {counts}, constant_values={read[1]})"
        case _:
            return f"np.{_NAMES.get(op, op)}({', '.join(read)})"
