"""Lowering of JAX programs: one rule a primitive."""

import math
import re
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asia.errors import UserError
from asia.lowering import wire
from asia.lowering.program import (
    BINARY,
    FUNCTION,
    UNARY,
    Builder,
    LoweredModel,
    Program,
    Shape,
    ShapeError,
)

# Building blocks of the lowering rules: values, steps and their errors.


Value: TypeAlias = "int | np.ndarray[Any, Any] | np.generic"
"""Number of a value that depends on the signals, or a constant."""
Values: TypeAlias = Sequence[Value]


class CannotLowerError(Exception):
    """Model that cannot be lowered, with the obstacle and the remedy."""


def number(build: Builder, value: Value) -> int:
    """Number of a value in a program; a constant is added to it."""
    return value if isinstance(value, int) else build.constant(value)


class Step:
    """One operation of a jaxpr under lowering, with the program that it is added to."""

    def __init__(self, build: Builder, equation: Any) -> None:
        self.build = build
        self.equation = equation
        self.params: dict[str, Any] = equation.params
        self.shape: Shape = equation.outvars[0].aval.shape

    def add(self, op: str, *values: Value, attrs: Sequence[int] = ()) -> int:
        numbers = [number(self.build, v) for v in values]
        return self.build.add(op, numbers, tuple(int(a) for a in attrs))

    def wise(self, op: str, *values: Value) -> int:
        """Apply an operation elementwise; a scalar that was broadcast stays a scalar."""
        narrow = [self.narrowed(v) for v in values]
        shapes = [self.shape_of(v) for v in narrow if self.shape_of(v)]
        wide = np.broadcast_shapes(*shapes)
        found = self.add(op, *(self.filling(v, wide) for v in narrow))
        return self.spread(found, np.broadcast_shapes(*(self.shape_of(v) for v in values)))

    def filling(self, value: Value, shape: Shape) -> Value:
        """Broadcast a value to this shape, unless it is a scalar."""
        own = self.shape_of(value)
        if own in ((), shape):
            return value
        if not isinstance(value, int):
            return np.broadcast_to(value, shape)
        return self.add("broadcast", value, attrs=(len(shape), *shape, *range(len(shape))))

    def spread(self, value: int, shape: Shape) -> int:
        if self.build.shape(value) == shape:
            return value
        return self.add("broadcast", value, attrs=(len(shape), *shape))

    def narrowed(self, value: Value) -> Value:
        if isinstance(value, int):
            node = self.build.node(value)
            if node is not None and node.op == "broadcast":
                inner = node.operands[0]
                if self.build.shape(inner) == ():
                    return inner
            return value
        flat = np.asarray(value).reshape(-1)
        if flat.size > 0 and np.ndim(value) and (flat == flat[0]).all():
            return flat[0]
        return value

    def shape_of(self, value: Value) -> Shape:
        return self.build.shape(value) if isinstance(value, int) else np.shape(value)

    def choose(self, which: Value, yes: Value, no: Value, shape: Shape) -> int:
        found = self.add("select", self.narrowed(which), self.narrowed(yes), self.narrowed(no))
        return self.spread(found, shape)

    def reversed_rows(self, value: Value) -> Value:
        if not isinstance(value, int):
            return np.asarray(value)[::-1]
        return _picked(self, value, lambda x: x[::-1])


Rule = Callable[[Step, Values], Values]


def _picked(at: Step, value: int, move: Callable[[NDArray[np.int64]], Any]) -> int:
    """Rearrange the numbers of a value as `move` rearranges those of an array."""
    shape = at.build.shape(value)
    places = np.asarray(move(np.arange(math.prod(shape)).reshape(shape)))
    attrs = (places.ndim, *places.shape, *places.reshape(-1))
    return at.add("pick", value, attrs=attrs)


# Lowering rules for primitives that move, sum and multiply arrays.


def _broadcast(at: Step, v: Values) -> Values:
    """Lower `broadcast_in_dim`: the operand lies along given axes of the result."""
    axes, shape = at.params["broadcast_dimensions"], at.params["shape"]
    if math.prod(at.shape_of(v[0])) == math.prod(shape):
        return [at.add("reshape", v[0], attrs=shape)]
    return [at.add("broadcast", v[0], attrs=(len(shape), *shape, *axes))]


def _transposed(at: Step, value: Value, axes: Sequence[int]) -> Value:
    if list(axes) == sorted(axes):
        return value
    if not isinstance(value, int):
        return np.transpose(value, axes)
    shape = at.build.shape(value)
    moved = [a for a in axes if shape[a] != 1]
    if moved == sorted(moved):
        return at.add("reshape", value, attrs=[shape[a] for a in axes])
    return at.add("transpose", value, attrs=axes)


def _reshaped(at: Step, value: Value, shape: Sequence[int]) -> Value:
    if not isinstance(value, int):
        return np.reshape(value, shape)
    return at.add("reshape", value, attrs=shape)


def _sliced(at: Step, v: Values) -> Values:
    starts, ends = at.params["start_indices"], at.params["limit_indices"]
    steps = at.params["strides"] or (1,) * len(starts)
    return [at.add("slice", v[0], attrs=(*starts, *ends, *steps))]


def _segment(at: Step, value: Value, starts: Sequence[int], ends: Sequence[int]) -> int:
    return at.add("slice", value, attrs=(*starts, *ends, *(1 for _ in starts)))


def _dynamic_slice(at: Step, v: Values) -> Values:
    """Lower `dynamic_slice` with constant start indices."""
    if any(isinstance(i, int) for i in v[1:]):
        raise CannotLowerError(
            "cannot be exported: dynamic_slice at a place that is computed; shift a buffer instead"
        )
    sizes, shape = at.params["slice_sizes"], at.shape_of(v[0])
    requested = [int(np.asarray(i)) for i in v[1:]]
    starts = [min(max(i, 0), n - m) for i, n, m in zip(requested, shape, sizes, strict=True)]
    ends = [a + n for a, n in zip(starts, sizes, strict=True)]
    return [_segment(at, v[0], starts, ends)]


def _gather(at: Step, v: Values) -> Values:
    """Lower `gather` with constant indices, which JAX itself evaluates."""
    if not isinstance(v[0], int) or isinstance(v[1], int):
        raise CannotLowerError(
            "cannot be exported: gather at places that are computed; use a sum over a one-hot row"
        )
    import jax

    equation = at.equation

    def move(places: NDArray[np.int64]) -> NDArray[np.int64]:
        # Indices outside the array give the fill value, nan.
        with jax.ensure_compile_time_eval():
            operand = jax.numpy.asarray(places, np.float64)
            found = equation.primitive.bind(operand, jax.numpy.asarray(v[1]), **equation.params)
        return np.asarray(found).astype(np.int64)

    return [_picked(at, v[0], move)]


def _concat(at: Step, v: Values) -> Values:
    full = [x for x in v if math.prod(at.shape_of(x))]
    return [full[0] if len(full) == 1 else at.add("concat", *full, attrs=(at.params["dimension"],))]


def _stack(at: Step, v: Values) -> Values:
    axis, shape = at.params["axis"], at.shape
    one = (*shape[:axis], 1, *shape[axis + 1 :])
    rows = [at.add("reshape", x, attrs=one) for x in v]
    return [at.add("concat", *rows, attrs=(axis,))]


def _split(at: Step, v: Values) -> Values:
    axis, shape, found, start = at.params["axis"], at.shape_of(v[0]), list[Value](), 0
    for size in at.params["sizes"]:
        starts = [start if a == axis else 0 for a in range(len(shape))]
        ends = [start + size if a == axis else n for a, n in enumerate(shape)]
        found.append(_segment(at, v[0], starts, ends))
        start += size
    return found


def _pad(at: Step, v: Values) -> Values:
    counts = at.params["padding_config"]
    if any(inner for _, _, inner in counts):
        raise CannotLowerError("cannot be exported: pad between the numbers of an array")
    shape, value = at.shape_of(v[0]), v[0]
    if any(low < 0 or high < 0 for low, high, _ in counts):
        starts = [max(-low, 0) for low, _, _ in counts]
        ends = [n - max(-high, 0) for n, (_, high, _) in zip(shape, counts, strict=True)]
        value = _segment(at, value, starts, ends)
    before, behind = [max(c[0], 0) for c in counts], [max(c[1], 0) for c in counts]
    if not any((*before, *behind)):
        return [value]
    return [at.add("pad", value, v[1], attrs=(*before, *behind))]


def _reduce(op: str) -> Rule:
    def rule(at: Step, v: Values) -> Values:
        axes, shape = at.params["axes"], at.shape_of(v[0])
        if all(shape[a] == 1 for a in axes):
            return [at.add("reshape", v[0], attrs=at.shape)]
        return [at.add(op, v[0], attrs=axes)]

    return rule


def _dot(at: Step, v: Values) -> Values:
    """Lower `dot_general` to a product of matrices."""
    (left_sum, right_sum), (left_batch, right_batch) = at.params["dimension_numbers"]
    shapes = [at.shape_of(x) for x in v]
    sides: list[Value] = []
    kept: list[list[int]] = []
    if 0 in (*shapes[0], *shapes[1]):
        return [np.zeros(at.shape)]
    stack = [shapes[0][a] for a in left_batch]
    inner = math.prod(shapes[0][a] for a in left_sum)
    for side, (value, shape, batch, summed) in enumerate(
        zip(v, shapes, (left_batch, right_batch), (left_sum, right_sum), strict=True)
    ):
        free = [a for a in range(len(shape)) if a not in batch and a not in summed]
        order = (*batch, *free, *summed) if side == 0 else (*batch, *summed, *free)
        wide = math.prod(shape[a] for a in free)
        ends = [wide, inner] if side == 0 else [inner, wide]
        front = [math.prod(stack)] if math.prod(stack) != 1 else []
        sides.append(_reshaped(at, _transposed(at, value, order), [*front, *ends]))
        kept.append([shape[a] for a in free])
    product = at.add("matmul", *sides)
    return [_reshaped(at, product, [*stack, *kept[0], *kept[1]])]


# Lowering rules, one a JAX primitive.
#
# JAX itself computes the values that depend on constants only, so that only primitives which
# signals pass through need a rule.


def in_single_precision(jaxpr: Any) -> bool:
    """Return whether any part of a jaxpr is computed in float32."""
    for equation in jaxpr.eqns:
        if any(getattr(v.aval, "dtype", None) == np.float32 for v in equation.outvars):
            return True
        for value in equation.params.values():
            for one in value if isinstance(value, tuple | list) else (value,):
                inner = getattr(one, "jaxpr", one)
                if hasattr(inner, "eqns") and in_single_precision(inner):
                    return True
    return False


def _lowered_values(build: Builder, jaxpr: Any, consts: Sequence[Any], given: Values) -> Values:
    """Add the operations of a jaxpr to a program; return its outputs from its inputs."""
    env: dict[Any, Value] = {}
    env.update(zip(jaxpr.constvars, (np.asarray(c) for c in consts), strict=True))
    env.update(zip(jaxpr.invars, given, strict=True))

    def read(v: Any) -> Value:
        return np.asarray(v.val) if hasattr(v, "val") else env[v]

    for equation in jaxpr.eqns:
        values = [read(v) for v in equation.invars]
        name, results = equation.primitive.name, equation.outvars
        if all(not isinstance(v, int) for v in values):
            found = _computed(equation, values)
        elif all(math.prod(v.aval.shape) == 0 for v in results):
            found = [np.zeros(v.aval.shape) for v in results]
        elif name in _CONTROL:
            found = _CONTROL[name](Step(build, equation), values)
        elif name not in _RULES:
            raise CannotLowerError(
                f"cannot be exported: {name}; write the step without it (docs/use/export.md lists "
                "what can be exported)"
            )
        elif any(np.dtype(v.aval.dtype).kind == "c" for v in results):
            raise CannotLowerError(
                f"cannot be exported: {name} of complex numbers; keep real and imaginary parts "
                "apart in the state"
            )
        else:
            found = _RULES[name](Step(build, equation), values)
        env.update(zip(results, found, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _called(at: Step, v: Values) -> Values:
    if at.params.get("name", "").startswith(FUNCTION):
        return _function(at, v)
    keys = ("jaxpr", "call_jaxpr", "fun_jaxpr")
    inner = next(at.params[key] for key in keys if key in at.params)
    if hasattr(inner, "consts"):
        return _lowered_values(at.build, inner.jaxpr, inner.consts, v)
    return _lowered_values(at.build, inner, (), v)


def _function(at: Step, v: Values) -> Values:
    """Lower a function of `asia.models._arrays.function` as a call. Numbers that differ from model
    to model are its inputs, so that models of one structure share it."""
    closed = at.params["jaxpr"]
    passed = [isinstance(x, int) or (np.asarray(x).dtype.kind == "f" and np.size(x) > 0) for x in v]
    operands = [number(at.build, x) for x, is_input in zip(v, passed, strict=True) if is_input]
    body = Builder(tuple(at.build.shape(i) for i in operands))
    inputs = iter(range(len(operands)))
    given = [next(inputs) if is_input else x for x, is_input in zip(v, passed, strict=True)]
    found = _lowered_values(body, closed.jaxpr, closed.consts, given)
    program = body.program([number(body, x) for x in found])
    title, *names = at.params["name"].removeprefix(FUNCTION).split()
    named = zip(names, passed[len(v) - len(names) :], strict=True)
    text = " ".join([title, *(name for name, is_input in named if is_input)])
    call = at.build.add("call", operands, tuple(text.encode("ascii")), program)
    return [at.build.add("part", (call,), (k,)) for k in range(len(found))]


def _labelled(at: Step, v: Values) -> Values:
    name = re.sub(r"[^A-Za-z0-9_]", "_", at.params["name"]) or "_"
    return [at.add("label", v[0], attrs=name.encode("ascii"))]


def _cond(at: Step, v: Values) -> Values:
    which, branches = v[0], at.params["branches"]
    if not isinstance(which, int):
        chosen = branches[int(np.clip(which, 0, len(branches) - 1))]
        return _lowered_values(at.build, chosen.jaxpr, chosen.consts, v[1:])
    if len(branches) != 2:
        raise CannotLowerError("cannot be exported: a choice among more than two branches")
    no, yes = (_lowered_values(at.build, b.jaxpr, b.consts, v[1:]) for b in branches)
    pairs = zip(yes, no, at.equation.outvars, strict=True)
    return [at.choose(which, a, b, result.aval.shape) for a, b, result in pairs]


def _scan(at: Step, v: Values) -> Values:
    closed, length, build = at.params["jaxpr"], at.params["length"], at.build
    same, carried = at.params["num_consts"], at.params["num_carry"]
    rows = v[same + carried :]
    if at.params["reverse"]:
        rows = [at.reversed_rows(r) for r in rows]
    free = [i for i, value in enumerate(v[:same]) if isinstance(value, int)]
    carry = [number(build, value) for value in v[same : same + carried]]
    passed = [number(build, v[i]) for i in free]
    stacked = [number(build, r) for r in rows]
    shapes = [build.shape(i) for i in (*passed, *carry)]
    body = Builder((*shapes, *(build.shape(r)[1:] for r in stacked)))
    given: list[Value] = list(v[:same])
    for place, i in enumerate(free):
        given[i] = place
    given += list(range(len(free), len(body.inputs)))
    found = _lowered_values(body, closed.jaxpr, closed.consts, given)
    program = body.program([number(body, value) for value in found])
    attrs = (length, len(free), carried)
    loop = build.add("loop", (*passed, *carry, *stacked), attrs, program)
    parts: list[Value] = [build.add("part", (loop,), (k,)) for k in range(len(found))]
    if at.params["reverse"]:
        parts[carried:] = [at.reversed_rows(p) for p in parts[carried:]]
    return parts


def _computed(equation: Any, values: Values) -> Values:
    import jax

    with jax.ensure_compile_time_eval():
        arrays = [
            jax.numpy.asarray(x, v.aval.dtype) for x, v in zip(values, equation.invars, strict=True)
        ]
        primitive = equation.primitive
        # Parameters of inner functions, separate in JAX before 0.8.
        bound = primitive.get_bind_params(equation.params)
        inside, params = bound if isinstance(bound, tuple) else ((), bound)
        found = primitive.bind(*inside, *arrays, **params)
    many = found if primitive.multiple_results else [found]
    return [np.asarray(v) for v in many]


def _elementwise(op: str) -> Rule:
    return lambda at, v: [at.wise(op, *v)]


def _logistic(at: Step, v: Values) -> Values:
    half = np.float64(0.5)
    inner = at.wise("tanh", at.wise("mul", v[0], half))
    return [at.wise("add", at.wise("mul", inner, half), half)]


def _power(at: Step, v: Values) -> Values:
    exponent, value = int(at.params["y"]), v[0]
    result: Value = np.float64(1.0)
    square, left = value, abs(exponent)
    while left:
        if left & 1:
            result = at.wise("mul", square, result) if isinstance(result, int) else square
        left >>= 1
        if left:
            square = at.wise("mul", square, square)
    if exponent < 0:
        result = at.wise("div", np.float64(1.0), result)
    return [at.spread(number(at.build, result), at.shape)]


def _select(at: Step, v: Values) -> Values:
    if len(v) != 3:
        raise CannotLowerError("cannot be exported: a choice among more than two arrays")
    return [at.choose(v[0], v[2], v[1], at.shape)]


def _convert(at: Step, v: Values) -> Values:
    new, old = np.dtype(at.params["new_dtype"]), np.dtype(at.equation.invars[0].aval.dtype)
    if new.kind in "iu" and old.kind == "f":
        raise CannotLowerError(
            "cannot be exported: convert_element_type to whole numbers; use floor"
        )
    if new.kind == "b" and old.kind != "b":
        return [at.wise("ne", v[0], np.float64(0.0))]
    return [v[0]]


def _division(at: Step, v: Values) -> Values:
    if np.dtype(at.equation.outvars[0].aval.dtype).kind in "iu":
        raise CannotLowerError("cannot be exported: div of whole numbers; divide real ones")
    return [at.wise("div", *v)]


_CALLS = (
    "pjit jit closed_call core_call custom_jvp_call custom_vjp_call custom_vjp_call_jaxpr remat2 "
    "checkpoint custom_jvp_call_jaxpr"
)
_CONTROL: dict[str, Rule] = {**dict.fromkeys(_CALLS.split(), _called), "scan": _scan, "cond": _cond}
_RULES: dict[str, Rule] = {
    **{name: _elementwise(name) for name in UNARY | BINARY},
    **{f"reduce_{n}": _reduce("r" + n) for n in ("sum", "max", "min", "prod")},
    **dict.fromkeys(
        ("copy", "copy_p", "stop_gradient", "optimization_barrier"), lambda at, v: [v[0]]
    ),
    **dict.fromkeys(
        ("reshape", "squeeze", "expand_dims"),
        lambda at, v: [at.add("reshape", v[0], attrs=at.shape)],
    ),
    "add_any": _elementwise("add"),
    "is_finite": _elementwise("isfinite"),
    "rsqrt": lambda at, v: [at.wise("div", np.float64(1.0), at.wise("sqrt", v[0]))],
    "square": lambda at, v: [at.wise("mul", v[0], v[0])],
    "div": _division,
    "logistic": _logistic,
    "integer_pow": _power,
    "select_n": _select,
    "clamp": lambda at, v: [at.wise("min", at.wise("max", v[1], v[0]), v[2])],
    "convert_element_type": _convert,
    "name": _labelled,
    "not": lambda at, v: [at.wise("sub", np.float64(1.0), v[0])],
    "or": _elementwise("max"),
    "and": _elementwise("mul"),
    "broadcast_in_dim": _broadcast,
    "transpose": lambda at, v: [_transposed(at, v[0], at.params["permutation"])],
    "slice": _sliced,
    "dynamic_slice": _dynamic_slice,
    "gather": _gather,
    "rev": lambda at, v: [
        _picked(at, number(at.build, v[0]), lambda x: np.flip(x, at.params["dimensions"]))
    ],
    "concatenate": _concat,
    "stack": _stack,
    "split": _split,
    "pad": _pad,
    "dot_general": _dot,
}


# Trace a fitted model with JAX and lower it to programs.
#
# Tracing runs where the candidate runs; the result is bytes, which `wire` reads in the parent.


def lowered_bytes(
    model: Any, n_past_u: int, n_past_y: int, nu: int, ny: int, parameters: Sequence[str] = ()
) -> bytes:
    """Lower a model; return it packed by `wire.pack`, or the reason why it cannot be lowered.

    Args:
        parameters: names of parameters that the last state of the program holds, by the model's own
            `with_parameters(names)`, which returns such a step model
    """
    import jax

    # Set before the model makes arrays of its numbers.
    jax.config.update("jax_enable_x64", True)
    if not all(callable(getattr(model, name, None)) for name in ("initial", "step")):
        return wire.pack_refusal(
            f"{type(model).__name__} has no initial() and step(): give the model both methods of "
            "asia.candidate.StepModel"
        )
    try:
        if parameters:
            if not callable(getattr(model, "with_parameters", None)):
                raise CannotLowerError(
                    f"{type(model).__name__} has no parameters that can change in time "
                    "(with_parameters); a grey-box model has"
                )
            model = model.with_parameters(tuple(parameters))
        return wire.pack(lowered(model, n_past_u, n_past_y, nu, ny))
    except (CannotLowerError, UserError) as error:
        return wire.pack_refusal(str(error))
    except ShapeError as error:
        return wire.pack_refusal(f"the steps do not fit together: {error}")
    except Exception as error:  # noqa: BLE001 - the border to candidate code
        return wire.pack_refusal(f"tracing the steps raised {type(error).__name__}: {error}")


def lowered(model: Any, n_past_u: int, n_past_y: int, nu: int, ny: int) -> LoweredModel:
    """Lower an `asia.candidate.StepModel` to programs for one case; jax_enable_x64 must be on.
    Raises CannotLowerError with the obstacle."""
    import jax

    def begin(*signals: Any) -> Any:
        return jax.tree.map(_row, model.initial(*(signal[None] for signal in signals)))

    def traced(function: Callable[..., Any], arguments: Sequence[Any]) -> tuple[Any, Any]:
        return jax.make_jaxpr(function, return_shape=True)(*arguments)

    def array(*shape: int) -> Any:
        return jax.ShapeDtypeStruct(shape, np.float64)

    start, state = traced(begin, [array(n_past_u, nu), array(n_past_y, ny), array(nu)])
    leaves, tree = jax.tree.flatten(state)
    # Empty arrays are no states.
    kept = [i for i, leaf in enumerate(leaves) if leaf.size]

    def step(*signals: Any) -> Any:
        given = [jax.numpy.zeros(leaf.shape, leaf.dtype) for leaf in leaves]
        for place, signal in zip(kept, signals[:-1], strict=True):
            given[place] = signal
        state = jax.tree.unflatten(tree, [leaf[None] for leaf in given])
        after, y = model.step(state, signals[-1][None])
        found, shape = jax.tree.flatten(after)
        if shape != tree:
            raise CannotLowerError("step gives a state of another structure than it takes")
        return [_row(y), *(_row(found[i]) for i in kept)]

    def program(closed: Any, outputs: Sequence[int]) -> Program:
        build = Builder(tuple(v.aval.shape for v in closed.jaxpr.invars))
        given = list(range(len(build.inputs)))
        found = _lowered_values(build, closed.jaxpr, closed.consts, given)
        return build.program([number(build, found[i]) for i in outputs])

    one, _ = traced(step, [*(leaves[i] for i in kept), array(nu)])
    programs = program(start, kept), program(one, range(1 + len(kept)))
    single = any(in_single_precision(p.jaxpr) for p in (start, one))
    return LoweredModel(n_past_u, n_past_y, nu, ny, single, *programs)


def _row(batch: Any) -> Any:
    """Only row of a batch."""
    import jax

    batch = jax.numpy.asarray(batch)
    if batch.shape[:1] != (1,):
        raise CannotLowerError(
            f"an output or a state has shape {batch.shape} for a batch of 1: the batch comes first"
        )
    return batch.reshape(batch.shape[1:])
