"""MATLAB functions and their numbers; Octave runs them too.

Every value is a column: the numbers of its array, row after row.
"""

import io
import math
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from asia.data.segment import SimulatedSegment
from asia.errors import InternalError
from asia.export.model import ExportModel, Printed
from asia.export.target import Answers, Target
from asia.export.targets.indices import (
    inside_places,
    joined_places,
    reduced_places,
    slices,
    source_places,
    values_of,
)
from asia.lowering.program import Node, Program, Shape

_INFIX = {"add": "+", "sub": "-", "mul": ".*", "div": "./", "pow": ".^"}
_COMPARED = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "~="}
_REDUCED = {"rsum": "sum({}, 2)", "rprod": "prod({}, 2)", "rmax": "max({}, [], 2)"}
_REDUCED["rmin"] = "min({}, [], 2)"
_MOST_INDICES = 12
_LOAD = """persistent k
if isempty(k)
    k = load(fullfile(fileparts(mfilename('fullpath')), 'asia_constants.mat'));
end
"""
_SIMULATE = """function y = asia_simulate(past_u, past_y, u)
% Open loop, physical units: past_u (n_past_u, nu), past_y (n_past_y, ny), u (H, nu) -> (H, ny).
x = asia_initial(past_u, past_y, u(1, :));
y = zeros(size(u, 1), {ny});
for n = 1:size(u, 1)
    [y(n, :), x] = asia_step(x, u(n, :));
end
end
"""
_TRIAL = """addpath('{folder}');
w = load('{given}');
y = cell(1, numel(w.u));
tic;
for i = 1:numel(w.u)
    y{{i}} = asia_simulate(w.past_u{{i}}, w.past_y{{i}}, w.u{{i}});
end
seconds = toc;
save('-v6', '{found}', 'y', 'seconds');
"""


class MatlabTarget(Target):
    """Target `matlab`: `asia_initial.m`, `asia_output.m`, `asia_update.m`, `asia_step.m`,
    `asia_simulate.m`, `asia_constants.mat`."""

    name = "matlab"
    usage = """```matlab
y = asia_simulate(past_u, past_y, u);            % a row a sample
x = asia_initial(past_u, past_y, u(1, :));       % or sample by sample
y1 = asia_output(x, u(1, :));
x = asia_update(x, u(1, :));                     % [y1, x] = asia_step(x, u(1, :)) does both
```
`x` is a column. Octave runs the files too. In Simulink, call `asia_step` from a MATLAB Function
block or import the target fmu."""

    def print(self, model: ExportModel) -> Printed:
        """Print the files."""
        low, numbers = model.lowered, dict[str, Any]()
        window = ["reshape(past_u.', [], 1)", "reshape(past_y.', [], 1)", "u(:)"]
        states = [f"x({part.start + 1}:{part.stop})" for part in slices(low.states)]
        files = {
            "asia_initial": ("x", "past_u, past_y, u", low.initial, window),
            "asia_output": ("y", "x, u", low.output, [*states, "u(:)"]),
            "asia_update": ("x_next", "x, u", low.update, [*states, "u(:)"]),
            "asia_step": ("[y, x_next]", "x, u", low.step, [*states, "u(:)"]),
        }
        printed = {f"{n}.m": _function(n, *parts, numbers) for n, parts in files.items()}
        printed["asia_simulate.m"] = _SIMULATE.format(ny=low.ny)
        numbers["sampling_time"] = model.sampling_time
        return Printed(
            {name: text.encode() for name, text in printed.items()}
            | {"asia_constants.mat": _mat(numbers)}
        )

    def run(self, folder: Path, windows: Sequence[SimulatedSegment]) -> list[Answers] | str:
        """Simulate with Octave, if it is installed."""
        octave = shutil.which("octave-cli") or shutil.which("octave")
        if octave is None:
            return "no Octave here: not compared"
        from scipy.io import loadmat

        with tempfile.TemporaryDirectory(prefix="asia-octave-") as made:
            given, found, trial = (Path(made) / n for n in ("given.mat", "found.mat", "trial.m"))
            sides = ("past_u", "past_y", "u")
            cells = {side: np.empty(len(windows), object) for side in sides}
            for side, cell in cells.items():
                for k, window in enumerate(windows):
                    cell[k] = getattr(window, side)
            given.write_bytes(_mat(cells))
            trial.write_text(_TRIAL.format(folder=folder, given=given, found=found))
            done = subprocess.run(
                [octave, "--no-gui", "--norc", str(trial)],
                capture_output=True, text=True, check=False, timeout=600,
            )  # fmt: skip
            if done.returncode != 0 or not found.exists():
                raise InternalError(f"the printed MATLAB code does not run: {done.stderr[:1000]}")
            kept: Any = loadmat(str(found))
        y_hat = tuple(np.asarray(y, np.float64) for y in kept["y"].reshape(-1))
        return [Answers("double", y_hat, float(np.squeeze(kept["seconds"])))]


def _mat(values: dict[str, Any]) -> bytes:
    from scipy.io import savemat

    written = io.BytesIO()
    savemat(written, values)
    # The header contains the time of writing; without it the same model gives the same bytes.
    data = bytearray(written.getvalue())
    data[:116] = b"MATLAB 5.0 MAT-file".ljust(116)
    return bytes(data)


def _function(
    name: str,
    result: str,
    arguments: str,
    program: Program,
    inputs: list[str],
    numbers: dict[str, Any],
) -> str:
    body = _MatlabBody(numbers)
    found = body.run(program, inputs)
    lines = [f"function {result} = {name}({arguments})", _LOAD.rstrip(), *body.lines]
    if result.startswith("["):
        lines += [f"y = reshape({found[0]}, 1, []);", f"x_next = [{'; '.join(found[1:])}];"]
    elif result == "y":
        lines.append(f"y = reshape({found[0]}, 1, []);")
    else:
        lines.append(f"{result} = [{'; '.join(found)}];")
    return "\n".join([*lines, "end", ""])


class _MatlabBody:
    """Statements of a function."""

    def __init__(self, numbers: dict[str, Any]) -> None:
        self.lines: list[str] = []
        self._numbers = numbers
        self._count = 0
        self._indent = ""

    def run(self, program: Program, inputs: Sequence[str]) -> list[str]:
        """Print a program and return the names of its outputs."""

        def value(node: Node, read: list[str], shapes: list[Shape]) -> str:
            return read[0] if node.op == "reshape" else self._named(self._text(node, read, shapes))

        return values_of(program, inputs, self._constant, value, self._loop)

    def _named(self, text: str) -> str:
        self._count += 1
        self._line(f"v{self._count} = {text};")
        return f"v{self._count}"

    def _line(self, text: str) -> None:
        self.lines.append(self._indent + text)

    def _constant(self, array: Any) -> str:
        if array.size == 1:
            value = float(array.reshape(-1)[0])
            return f"({value!r})" if math.isfinite(value) else ("Inf" if value > 0 else "(-Inf)")
        if array.size == 0:
            return "zeros(0, 1)"
        return self._kept(array.reshape(-1, 1))

    def _kept(self, array: Any) -> str:
        for name, known in self._numbers.items():
            if np.array_equal(known, array):
                return f"k.{name}"
        name = f"k{len(self._numbers) + 1}"
        self._numbers[name] = array
        return f"k.{name}"

    def _places(self, places: Any) -> str:
        """Index vector that counts from 1."""
        numbers = np.asarray(places).reshape(-1) + 1
        if len(numbers) > 1 and (np.diff(numbers) == 1).all():
            return f"{numbers[0]}:{numbers[-1]}"
        if len(numbers) <= _MOST_INDICES:
            return f"[{' '.join(map(str, numbers.tolist()))}]"
        return self._kept(numbers.astype(float).reshape(-1, 1))

    def _text(self, node: Node, read: list[str], shapes: list[Shape]) -> str:
        op = node.op
        if op in _INFIX:
            return f"{read[0]} {_INFIX[op]} {read[1]}"
        if op in _COMPARED:
            return f"double({read[0]} {_COMPARED[op]} {read[1]})"
        if op == "neg":
            return f"-{read[0]}"
        if op == "isfinite":
            return f"double(isfinite({read[0]}))"
        if op == "select":
            count = math.prod(node.shape)
            which, yes, no = (
                text if shape else f"repmat({text}, {count}, 1)"
                for text, shape in zip(read, shapes, strict=True)
            )
            name, which, other = self._named(no), self._named(which), self._named(yes)
            self._line(f"{name}({which} ~= 0) = {other}({which} ~= 0);")
            return name
        if op == "broadcast" and not shapes[0]:
            return f"repmat({read[0]}, {math.prod(node.shape)}, 1)"
        if op == "matmul":
            (*_, m, k), n = shapes[0], node.shape[-1]
            left, right = (self._value(r) for r in read)
            parts: list[str] = []
            for b in range(math.prod(node.shape[:-2])):
                one = f"reshape({left}({b * m * k + 1}:{(b + 1) * m * k}), {k}, {m})"
                two = f"reshape({right}({b * k * n + 1}:{(b + 1) * k * n}), {n}, {k})"
                parts.append(f"reshape({two} * {one}, [], 1)")
            return parts[0] if len(parts) == 1 else f"[{'; '.join(parts)}]"
        if op == "concat":
            order, together = joined_places(node, shapes), f"[{'; '.join(read)}]"
            if (order == np.arange(len(order))).all():
                return together
            return f"{self._named(together)}({self._places(order)}, 1)"
        if op == "pad":
            name = self._named(f"repmat({read[1]}, {math.prod(node.shape)}, 1)")
            places = self._places(inside_places(node, shapes[0]))
            self._line(f"{name}({places}) = {read[0]};")
            return name
        if op in ("slice", "transpose", "pick", "broadcast"):
            return f"{self._value(read[0])}({self._places(source_places(node, shapes[0]))}, 1)"
        if op in _REDUCED:
            places = reduced_places(node, shapes[0])
            picked = f"{self._value(read[0])}({self._places(places)})"
            return _REDUCED[op].format(f"reshape({picked}, [], {len(places)}).'")
        return f"{op}({', '.join(read)})"

    def _value(self, text: str) -> str:
        """Name of a value, so that it can be indexed."""
        return text if text.isidentifier() else self._named(text)

    def _loop(self, node: Node, read: list[str], shapes: list[Shape]) -> list[str]:
        assert node.body is not None
        length, same, carried = node.attrs
        carry = [self._named(r) for r in read[same : same + carried]]
        ends = node.body.output_shapes[carried:]
        stacked = [self._named(f"zeros({length * math.prod(s)}, 1)") for s in ends]
        rows = [self._value(r) for r in read[same + carried :]]
        self._count += 1
        index = f"n{self._count}"
        self._line(f"for {index} = 1:{length}")
        self._indent += "    "
        sizes = [math.prod(s[1:]) for s in shapes[same + carried :]]
        now = [
            self._named(f"{r}(({index} - 1) * {n} + (1:{n}), 1)")
            for r, n in zip(rows, sizes, strict=True)
        ]
        found = self.run(node.body, [*read[:same], *carry, *now])
        for place, value, shape in zip(stacked, found[carried:], ends, strict=True):
            n = math.prod(shape)
            self._line(f"{place}(({index} - 1) * {n} + (1:{n}), 1) = {value};")
        after = [self._named(value) for value in found[:carried]]
        for place, value in zip(carry, after, strict=True):
            self._line(f"{place} = {value};")
        self._indent = self._indent[:-4]
        self._line("end")
        return [*carry, *stacked]
