"""C99 without allocation: one file of functions, a header, and a program that runs a CSV file."""

from __future__ import annotations

import ctypes
import math
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from asia.data import Array
from asia.errors import InternalError
from asia.export._model import ExportModel, Printed, TrainingWindow
from asia.export._target import Answers
from asia.export.targets.c_files import (
    FLOAT,
    HARNESS,
    MAKEFILE,
    NO_FLOAT,
    example_csv,
    header,
    main_file,
)
from asia.export.targets.c_program import Constants, Statements, Value
from asia.lowering import Program

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
