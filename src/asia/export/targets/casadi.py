"""CasADi functions of the initial state and of one sample, for optimal control and estimation."""

import math
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from asia.data.segment import SimulatedSegment
from asia.data.trajectory import Array
from asia.export.model import ExportModel, Printed
from asia.export.target import Answers, missing_package
from asia.export.targets.indices import (
    Places,
    inside_places,
    joined_places,
    reduced_places,
    slices,
    source_places,
    values_of,
)
from asia.lowering.program import Node, Program, Shape

_SCRIPT = '''"""initial(past_u, past_y, u) -> x, step(x, u) -> (x at the next sample, y), CasADi:
past_u is n_past_u by nu, past_y n_past_y by ny, all else are columns."""

from pathlib import Path

import casadi

_HERE = Path(__file__).parent
initial = casadi.Function.load(str(_HERE / "initial.casadi"))
step = casadi.Function.load(str(_HERE / "step.casadi"))
SAMPLING_TIME = {sampling_time!r}  # s
'''
_LARGEST = 1.7976931348623157e308
# Numbers that a program may compute to be written as scalar expressions, 30 bytes each.
_MOST_UNROLLED = 4_000


class CasadiTarget:
    """Target `casadi`: `initial.casadi`, `step.casadi` and `model.py`, which loads them."""

    name = "casadi"
    usage = """```python
from model import initial, step
x = initial(past_u, past_y, u0)
x, y = step(x, u)                       # y of this sample, x at the next
```
`step` can be differentiated exactly and used in `nlpsol`, `Opti`, do-mpc and acados
(`disc_dyn_expr`). It is made of SX expressions, and of MX expressions where the model iterates so
often within a sample that the file would be large: call it with MX symbols then. Choices, limits
and absolute values have no second derivative where they switch."""

    def missing(self) -> str | None:
        """Return a sentence if CasADi is not installed."""
        return missing_package("casadi")

    def print(self, model: ExportModel) -> Printed:
        """Print the files."""
        files = {"model.py": _SCRIPT.format(sampling_time=model.sampling_time).encode()}
        with tempfile.TemporaryDirectory(prefix="asia-casadi-") as made:
            for function in _functions(model):
                path = Path(made) / f"{function.name()}.casadi"
                function.save(str(path))
                files[path.name] = path.read_bytes()
        return Printed(files)

    def run(self, folder: Path, windows: Sequence[SimulatedSegment]) -> list[Answers] | str:
        """Simulate with the saved functions, all samples of a window in one call."""
        import casadi as ca

        initial: Any = ca.Function.load(str(folder / "initial.casadi"))
        step: Any = ca.Function.load(str(folder / "step.casadi"))
        y_hat: list[Any] = []
        begin = time.perf_counter()
        for window in windows:
            x = initial(window.past_u, window.past_y, window.u[0])
            if step.size1_in(0) == 0:
                y_hat.append(np.stack([np.array(step(x, u)[1])[:, 0] for u in window.u]))
                continue
            many = step.mapaccum(len(window.u))
            y_hat.append(np.array(many(x, window.u.T)[1]).T)
        return [Answers("double", tuple(y_hat), time.perf_counter() - begin)]


def _functions(model: ExportModel) -> list[Any]:
    import casadi as ca

    low = model.lowered
    kind = _symbols(low.initial)
    past_u = kind.sym("past_u", low.n_past_u, low.nu)
    past_y = kind.sym("past_y", low.n_past_y, low.ny)
    u = kind.sym("u", low.nu)
    start = _run(low.initial, [ca.vec(past_u.T), ca.vec(past_y.T), u], kind)
    initial = ca.Function(
        "initial", [past_u, past_y, u], [ca.vertcat(*start)], ["past_u", "past_y", "u"], ["x"]
    )
    kind = _symbols(low.step)
    u = kind.sym("u", low.nu)
    x = kind.sym("x", sum(math.prod(s) for s in low.states))
    y, *after = _run(low.step, [*(x[part] for part in slices(low.states)), u], kind)
    step = ca.Function("step", [x, u], [ca.vertcat(*after), y], ["x", "u"], ["x_next", "y"])
    return [initial, step]


def _symbols(program: Program) -> Any:
    """SX with loops unrolled; MX, where loops call their body, if that would be long."""
    import casadi as ca

    return ca.SX if _numbers(program) <= _MOST_UNROLLED else ca.MX


def _numbers(program: Program) -> int:
    """How many numbers a program computes."""
    nodes = program.plain.nodes
    return sum(
        math.prod(node.shape) if node.body is None else node.attrs[0] * _numbers(node.body)
        for node in nodes
        if node.op != "part"
    )


def _run(program: Program, inputs: Sequence[Any], kind: Any) -> list[Any]:
    """Values as columns, row after row of their arrays. kind: SX or MX."""
    import casadi as ca

    def constant(array: Array) -> Any:
        return kind(ca.DM(array.reshape(-1)))

    def loop(node: Node, read: list[Any], shapes: list[Shape]) -> list[Any]:
        return _looped(node, read, kind)

    return values_of(program, inputs, constant, _value, loop)


def _looped(node: Node, read: list[Any], kind: Any) -> list[Any]:
    import casadi as ca

    assert node.body is not None
    length, same, carried = node.attrs
    fixed, carry, stacked = read[:same], read[same : same + carried], read[same + carried :]
    rows = [ca.reshape(r, r.numel() // length, length) for r in stacked]
    if kind is ca.SX:
        passes: list[list[Any]] = []
        for k in range(length):
            found = _run(node.body, [*fixed, *carry, *(r[:, k] for r in rows)], kind)
            carry = found[:carried]
            passes.append(found[carried:])
        return [*carry, *(ca.vertcat(*values) for values in zip(*passes, strict=True))]
    inside = _symbols(node.body)
    kept = [inside.sym("kept", r.numel()) for r in fixed]
    before = [inside.sym("before", r.numel()) for r in carry]
    row = [inside.sym("row", r.size1()) for r in rows]
    after = _run(node.body, [*kept, *before, *row], inside)
    body = ca.Function("body", [*before, *kept, *row], after)
    many = body.mapaccum("loop", length, carried) if carried else body.map(length)
    found = many.call([*carry, *(ca.repmat(r, 1, length) for r in fixed), *rows])
    last = [value[:, length - 1] for value in found[:carried]]
    return [*last, *(ca.vec(value) for value in found[carried:])]


def _value(node: Node, read: list[Any], shapes: list[Shape]) -> Any:
    import casadi as ca

    op, x = node.op, read[0]
    if op == "reshape":
        return x
    if op == "matmul":
        (*_, m, k), n = shapes[0], node.shape[-1]
        products: list[Any] = []
        for b in range(math.prod(node.shape[:-2])):
            left = ca.reshape(read[0][b * m * k : (b + 1) * m * k], k, m)
            right = ca.reshape(read[1][b * k * n : (b + 1) * k * n], n, k)
            products.append(ca.vec(right @ left))
        return ca.vertcat(*products)
    if op == "broadcast" and not shapes[0]:
        return ca.repmat(x, math.prod(node.shape), 1)
    if op == "concat":
        return _picked(ca.vertcat(*read), joined_places(node, shapes))
    if op == "pad":
        target = ca.repmat(read[1], math.prod(node.shape), 1)
        target[inside_places(node, shapes[0]).tolist()] = x
        return target
    if op in ("slice", "transpose", "pick", "broadcast"):
        return _picked(x, source_places(node, shapes[0]))
    if op in _REDUCED:
        first, *others = reduced_places(node, shapes[0]).T
        total = _picked(x, first)
        for places in others:
            total = _REDUCED[op](ca, total, _picked(x, places))
        return total
    if op in _FUNCTIONS:
        return _FUNCTIONS[op](ca, *read)
    return getattr(ca, _RENAMED.get(op, op))(*read)


def _picked(x: Any, places: Places) -> Any:
    """Column of the picked numbers, of a single one too, for which CasADi returns a row."""
    import casadi as ca

    return ca.vec(x[places.tolist()])


_REDUCED: dict[str, Callable[..., Any]] = {
    "rsum": lambda ca, a, b: a + b,
    "rprod": lambda ca, a, b: a * b,
    "rmax": lambda ca, a, b: ca.fmax(a, b),
    "rmin": lambda ca, a, b: ca.fmin(a, b),
}
_RENAMED = {"abs": "fabs", "max": "fmax", "min": "fmin", "pow": "power"}
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "neg": lambda ca, a: -a,
    "add": lambda ca, a, b: a + b,
    "sub": lambda ca, a, b: a - b,
    "mul": lambda ca, a, b: a * b,
    "div": lambda ca, a, b: a / b,
    "lt": lambda ca, a, b: a < b,
    "le": lambda ca, a, b: a <= b,
    "gt": lambda ca, a, b: a > b,
    "ge": lambda ca, a, b: a >= b,
    "eq": lambda ca, a, b: a == b,
    "ne": lambda ca, a, b: a != b,
    "isfinite": lambda ca, a: ca.fabs(a) <= _LARGEST,
    "select": lambda ca, c, a, b: ca.if_else(c != 0, a, b),
}
