"""NumPy interpreter of lowered programs: the reference for every printer."""

import math
import operator
import weakref
from collections.abc import Callable, Sequence
from functools import partial
from operator import itemgetter
from typing import Any, TypeAlias

import numpy as np

from asia.data.trajectory import Array
from asia.lowering.program import (
    BINARY,
    REDUCTIONS,
    UNARY,
    Attributes,
    LoweredModel,
    Node,
    Program,
    Shape,
)

# Numbers in an array that a prepared program keeps: a program may be a stranger's.
_KEPT = 4096
_Function: TypeAlias = Callable[..., list[Any]]
_functions: dict[int, _Function] = {}
"""Prepared programs by identity."""


def evaluate(program: Program, inputs: Sequence[Array]) -> list[Array]:
    """Compute the outputs of a program for these inputs. It is prepared once."""
    key = id(program)
    function = _functions.get(key)
    if function is None:
        function = _functions[key] = _prepared(program.plain)
        weakref.finalize(program, _functions.pop, key, None)
    with np.errstate(all="ignore"):
        found = function(*(np.asarray(x, np.float64) for x in inputs))
    # Copies: a value may be one that the prepared program keeps.
    return [np.array(value) for value in found]


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


def _prepared(program: Program) -> _Function:
    """Bind the attributes of all operations; what constants alone give is computed once."""
    count = len(program.inputs)
    known: dict[int, Any] = dict(enumerate(program.constants, count))
    plan: list[tuple[int, Callable[..., Any], tuple[int, ...]]] = []
    with np.errstate(all="ignore"):
        for number, node in enumerate(program.nodes, program.first_node):
            function = _bound(node)
            small = node.op not in ("loop", "part") and math.prod(node.shape) <= _KEPT
            if small and all(i in known for i in node.operands):
                known[number] = function(*(known[i] for i in node.operands))
            else:
                plan.append((number, function, node.operands))
    # The function keeps no reference to the program, so that both are freed.
    outputs = program.outputs
    rest = [known.get(k) for k in range(count, program.first_node + len(program.nodes))]

    def run(*inputs: Array) -> list[Any]:
        values: list[Any] = [*inputs, *rest]
        for number, function, operands in plan:
            values[number] = function(*[values[i] for i in operands])
        return [values[i] for i in outputs]

    return run


def _bound(node: Node) -> Callable[..., Any]:
    """The function of an operation with its attributes."""
    op, attrs = node.op, node.attrs
    if op == "loop":
        assert node.body is not None
        body, shapes = _prepared(node.body), node.body.output_shapes
        return lambda *values: _looped(body, attrs, shapes, values)
    if op == "part":
        return itemgetter(attrs[0])
    if op in UNARY | BINARY:
        function = _BY_OPERATOR.get(op) or getattr(np, _NAMES.get(op, op))
        # Truths are numbers.
        return (lambda *x: np.asarray(function(*x), np.float64)) if op in _TRUTHS else function
    if op == "slice":
        rank = len(attrs) // 3
        each = zip(attrs[:rank], attrs[rank : 2 * rank], attrs[2 * rank :], strict=True)
        return itemgetter(tuple(slice(*one) for one in each))
    if op == "pick":
        places, shape = np.array(attrs[1 + attrs[0] :], int), node.shape
        return lambda x: x.reshape(-1)[places].reshape(shape)
    if op == "reshape":
        return lambda x: x.reshape(attrs)
    if op == "broadcast":
        wide = node.shape
        if math.prod(wide) > _KEPT:
            return lambda x: np.broadcast_to(_sides(attrs, x), wide)
        ones = np.ones(wide)
        return lambda x: _sides(attrs, x) * ones
    return partial(_COMPUTED[op], attrs)


def _looped(
    body: _Function, attrs: Attributes, shapes: Sequence[Shape], values: Sequence[Array]
) -> list[Array]:
    length, same, carried = attrs
    fixed, carry = values[:same], list(values[same : same + carried])
    rows = values[same + carried :]
    stacked: list[list[Array]] = [[] for _ in shapes[carried:]]
    for k in range(length):
        found = body(*fixed, *carry, *(r[k] for r in rows))
        carry = found[:carried]
        for place, value in zip(stacked, found[carried:], strict=True):
            place.append(value)
    ends = [np.array(p).reshape(length, *s) for p, s in zip(stacked, shapes[carried:], strict=True)]
    return [*carry, *ends]


def _sides(attrs: Attributes, x: Array) -> Array:
    """Array with sides of 1 for those that a broadcast adds."""
    shape = [1] * attrs[0]
    for axis, size in zip(attrs[1 + attrs[0] :], x.shape, strict=True):
        shape[axis] = size
    return x.reshape(shape)


def _pad(attrs: Attributes, x: Array, value: Array) -> Array:
    rank = x.ndim
    counts = [(attrs[i], attrs[rank + i]) for i in range(rank)]
    return np.pad(x, counts, constant_values=np.asarray(value).item()) if rank else x


# The same as the functions of NumPy, and faster for numbers.
_BY_OPERATOR: dict[str, Callable[..., Any]] = {
    "add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv,
    "neg": operator.neg,
}  # fmt: skip
_TRUTHS = frozenset(("lt", "le", "gt", "ge", "eq", "ne", "isfinite"))
_NAMES = {
    "max": "maximum",
    "min": "minimum",
    "lt": "less",
    "le": "less_equal",
    "gt": "greater",
    "ge": "greater_equal",
    "eq": "equal",
    "ne": "not_equal",
}


def _reducing(name: str) -> Callable[..., Array]:
    function = getattr(np, name)
    return lambda attrs, x: function(x, axis=tuple(attrs))


_COMPUTED: dict[str, Callable[..., Array]] = {
    **{op: _reducing(op.removeprefix("r")) for op in REDUCTIONS},
    "select": lambda attrs, c, a, b: np.where(c != 0, a, b),
    "transpose": lambda attrs, x: x.transpose(attrs),
    "concat": lambda attrs, *x: np.concatenate(x, axis=attrs[0]),
    "matmul": lambda attrs, a, b: a @ b,
    "pad": _pad,
}


def operations(program: Program) -> int:
    """Count the numbers that the program computes, those of a loop once an iteration: a measure of
    its cost."""
    shapes, total = program.shapes, 0
    for node in program.nodes:
        if node.body is not None:
            total += (node.attrs[0] if node.op == "loop" else 1) * operations(node.body)
        elif node.op == "matmul":
            total += 2 * math.prod(node.shape) * shapes[node.operands[0]][-1]
        else:
            total += math.prod(node.shape)
    return total
