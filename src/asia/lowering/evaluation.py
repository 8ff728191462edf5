"""NumPy interpreter of lowered programs: the reference for every printer."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from asia.data.trajectory import Array
from asia.lowering.program import BINARY, REDUCTIONS, UNARY, Attributes, LoweredModel, Program


def evaluate(program: Program, inputs: Sequence[Array]) -> list[Array]:
    """Compute the outputs of a program for these inputs."""
    values: list[object] = [*(np.asarray(x, np.float64) for x in inputs), *program.constants]
    with np.errstate(all="ignore"):
        for node in program.nodes:
            read: list[object] = [values[i] for i in node.operands]
            if node.op == "loop":
                assert node.body is not None
                values.append(_looped(node.body, node.attrs, [np.asarray(v) for v in read]))
            elif node.op == "part":
                parts: Sequence[Array] = read[0]  # pyright: ignore[reportAssignmentType]
                values.append(parts[node.attrs[0]])
            else:
                values.append(np.asarray(_COMPUTED[node.op](node.attrs, *read), np.float64))
    return [np.asarray(values[i]) for i in program.outputs]


def simulate(model: LoweredModel, past_u: Array, past_y: Array, u: Array) -> Array:
    """Simulate one case.

    Args:
        model: lowered model.
        past_u: past inputs (n_past_u, nu).
        past_y: past outputs (n_past_y, ny).
        u: inputs (H, nu).

    Returns:
        Outputs (H, ny).
    """
    states = evaluate(model.initial, [past_u, past_y, u[0]])
    result = np.empty((len(u), model.ny))
    for k, row in enumerate(u):
        result[k], *states = evaluate(model.step, [*states, row])
    return result


def _looped(body: Program, attrs: Attributes, values: Sequence[Array]) -> list[Array]:
    length, same, carried = attrs
    fixed, carry = values[:same], list(values[same : same + carried])
    rows = values[same + carried :]
    stacked: list[list[Array]] = [[] for _ in body.outputs[carried:]]
    for k in range(length):
        found = evaluate(body, [*fixed, *carry, *(r[k] for r in rows)])
        carry = found[:carried]
        for place, value in zip(stacked, found[carried:], strict=True):
            place.append(value)
    shapes = body.output_shapes[carried:]
    ends = [np.array(p).reshape(length, *s) for p, s in zip(stacked, shapes, strict=True)]
    return [*carry, *ends]


def _broadcast(attrs: Attributes, x: Array) -> Array:
    wide, axes = attrs[1 : 1 + attrs[0]], attrs[1 + attrs[0] :]
    shape = [1] * len(wide)
    for axis, size in zip(axes, x.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(x.reshape(shape), wide)


def _slice(attrs: Attributes, x: Array) -> Array:
    rank = x.ndim
    return x[tuple(slice(attrs[i], attrs[rank + i], attrs[2 * rank + i]) for i in range(rank))]


def _pick(attrs: Attributes, x: Array) -> Array:
    return x.reshape(-1)[np.array(attrs[1 + attrs[0] :], int)].reshape(attrs[1 : 1 + attrs[0]])


def _pad(attrs: Attributes, x: Array, value: Array) -> Array:
    rank = x.ndim
    counts = [(attrs[i], attrs[rank + i]) for i in range(rank)]
    return np.pad(x, counts, constant_values=np.asarray(value).item()) if rank else x


_NAMES = {
    "neg": "negative",
    "max": "maximum",
    "min": "minimum",
    "pow": "power",
    "sub": "subtract",
    "mul": "multiply",
    "div": "divide",
    "asin": "arcsin",
    "acos": "arccos",
    "atan": "arctan",
    "atan2": "arctan2",
    "lt": "less",
    "le": "less_equal",
    "gt": "greater",
    "ge": "greater_equal",
    "eq": "equal",
    "ne": "not_equal",
}


def _by_name(name: str) -> Callable[..., Array]:
    function = getattr(np, name)
    return lambda attrs, *x: function(*x)


def _reducing(name: str) -> Callable[..., Array]:
    function = getattr(np, name)
    return lambda attrs, x: function(x, axis=tuple(attrs))


_COMPUTED: dict[str, Callable[..., Array]] = {
    **{op: _by_name(_NAMES.get(op, op)) for op in UNARY | BINARY},
    **{op: _reducing(op.removeprefix("r")) for op in REDUCTIONS},
    "select": lambda attrs, c, a, b: np.where(c != 0, a, b),
    "reshape": lambda attrs, x: x.reshape(attrs),
    "transpose": lambda attrs, x: x.transpose(attrs),
    "concat": lambda attrs, *x: np.concatenate(x, axis=attrs[0]),
    "matmul": lambda attrs, a, b: a @ b,
    "broadcast": _broadcast,
    "slice": _slice,
    "pick": _pick,
    "pad": _pad,
}


def operations(program: Program) -> int:
    """Count the numbers that the program computes, those of a loop once an iteration: a measure of
    its cost."""
    shapes, total = program.shapes, 0
    for node in program.nodes:
        if node.op == "loop" and node.body is not None:
            total += node.attrs[0] * operations(node.body)
        elif node.op == "matmul":
            total += 2 * math.prod(node.shape) * shapes[node.operands[0]][-1]
        else:
            total += math.prod(node.shape)
    return total
