"""Lowering rules, one a JAX primitive.

JAX itself computes the values that depend on constants only, so that only primitives which signals
pass through need a rule.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from asia.lowering import moves
from asia.lowering.building import CannotLowerError, Rule, Step, Value, Values, number
from asia.lowering.program import Builder


def in_single_precision(jaxpr: Any) -> bool:
    """Return whether any part of a jaxpr is computed in float32."""
    for equation in jaxpr.eqns:
        if any(getattr(v.aval, "dtype", None) == np.float32 for v in equation.outvars):
            return True
        for inner in _inner(equation.params):
            if in_single_precision(inner):
                return True
    return False


def _inner(params: dict[str, Any]) -> list[Any]:
    found: list[Any] = []
    for value in params.values():
        for one in value if isinstance(value, tuple | list) else (value,):
            jaxpr = getattr(one, "jaxpr", one)
            if hasattr(jaxpr, "eqns"):
                found.append(jaxpr)
    return found


class Lowering:
    """Translation of a jaxpr into operations of a program."""

    def __init__(self, build: Builder) -> None:
        self.build = build

    def run(self, jaxpr: Any, consts: Sequence[Any], given: Values) -> Values:
        """Compute the values of the jaxpr's outputs from those of its inputs."""
        env: dict[Any, Value] = {}
        env.update(zip(jaxpr.constvars, (np.asarray(c) for c in consts), strict=True))
        env.update(zip(jaxpr.invars, given, strict=True))

        def read(v: Any) -> Value:
            return np.asarray(v.val) if hasattr(v, "val") else env[v]

        for equation in jaxpr.eqns:
            values = [read(v) for v in equation.invars]
            found = self._equation(equation, values)
            for variable, value in zip(equation.outvars, found, strict=True):
                env[variable] = value
        return [read(v) for v in jaxpr.outvars]

    def _equation(self, equation: Any, values: Values) -> Values:
        name, params = equation.primitive.name, equation.params
        if all(not isinstance(v, int) for v in values):
            return _computed(equation, values)
        if all(math.prod(v.aval.shape) == 0 for v in equation.outvars):
            return [np.zeros(v.aval.shape) for v in equation.outvars]
        if name in _INLINED:
            return self._inlined(params, values)
        if name == "scan":
            return self._scan(params, values)
        if name == "cond":
            return self._cond(params, values, equation)
        if name not in _RULES:
            raise CannotLowerError(
                f"cannot be exported: {name}; write the step without it (docs/use/export.md lists "
                "what can be exported)"
            )
        for variable in equation.outvars:
            if np.dtype(variable.aval.dtype).kind == "c":
                raise CannotLowerError(
                    f"cannot be exported: {name} of complex numbers; keep real and imaginary parts "
                    "apart in the state"
                )
        return _RULES[name](Step(self.build, equation), values)

    def _inlined(self, params: dict[str, Any], values: Values) -> Values:
        inner = next(params[k] for k in ("jaxpr", "call_jaxpr", "fun_jaxpr") if k in params)
        closed = inner if hasattr(inner, "consts") else None
        jaxpr = inner if closed is None else closed.jaxpr
        return self.run(jaxpr, () if closed is None else closed.consts, values)

    def _cond(self, params: dict[str, Any], values: Values, equation: Any) -> Values:
        which, rest = values[0], values[1:]
        branches = params["branches"]
        if not isinstance(which, int):
            chosen = branches[int(np.clip(which, 0, len(branches) - 1))]
            return self.run(chosen.jaxpr, chosen.consts, rest)
        if len(branches) != 2:
            raise CannotLowerError("cannot be exported: a choice among more than two branches")
        no, yes = (self.run(b.jaxpr, b.consts, rest) for b in branches)
        at = Step(self.build, equation)
        pairs = zip(yes, no, equation.outvars, strict=True)
        return [at.choose(which, a, b, v.aval.shape) for a, b, v in pairs]

    def _scan(self, params: dict[str, Any], values: Values) -> Values:
        closed, length = params["jaxpr"], params["length"]
        same, carried = params["num_consts"], params["num_carry"]
        at = Step(self.build, None)
        rows = values[same + carried :]
        if params["reverse"]:
            rows = [at.reversed_rows(r) for r in rows]
        free = [i for i, v in enumerate(values[:same]) if isinstance(v, int)]
        carry = [number(self.build, v) for v in values[same : same + carried]]
        passed = [number(self.build, values[i]) for i in free]
        stacked = [number(self.build, r) for r in rows]
        shapes = [self.build.shape(i) for i in (*passed, *carry)]
        body = Builder((*shapes, *(self.build.shape(r)[1:] for r in stacked)))
        given: list[Value] = list(values[:same])
        for place, i in enumerate(free):
            given[i] = place
        given += list(range(len(free), len(body.inputs)))
        found = Lowering(body).run(closed.jaxpr, closed.consts, given)
        program = body.program([number(body, v) for v in found])
        attrs = (length, len(free), carried)
        loop = self.build.add("loop", (*passed, *carry, *stacked), attrs, program)
        parts: list[Value] = [self.build.add("part", (loop,), (k,)) for k in range(len(found))]
        if params["reverse"]:
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


def _plain(op: str) -> Rule:
    return lambda at, v: [at.wise(op, *v)]


def _same(at: Step, v: Values) -> Values:
    return [v[0]]


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


def _clamp(at: Step, v: Values) -> Values:
    low, x, high = v
    return [at.wise("min", at.wise("max", x, low), high)]


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


def _not(at: Step, v: Values) -> Values:
    return [at.wise("sub", np.float64(1.0), v[0])]


def _or(at: Step, v: Values) -> Values:
    return [at.wise("max", *v)]


def _and(at: Step, v: Values) -> Values:
    return [at.wise("mul", *v)]


_INLINED_NAMES = (
    "pjit jit closed_call core_call custom_jvp_call custom_vjp_call custom_vjp_call_jaxpr remat2 "
    "checkpoint custom_jvp_call_jaxpr"
)
_INLINED = frozenset(_INLINED_NAMES.split())
_UNARY = "neg abs sign floor sqrt exp log log1p expm1 tanh sin cos tan asin acos atan sinh cosh"
_BINARY = "add sub mul max min pow atan2 lt le gt ge eq ne"
_RULES: dict[str, Rule] = {
    **{name: _plain(name) for name in (*_UNARY.split(), *_BINARY.split())},
    **{f"reduce_{n}": moves.reduce("r" + n) for n in ("sum", "max", "min", "prod")},
    **dict.fromkeys(("copy", "copy_p", "stop_gradient", "optimization_barrier"), _same),
    **dict.fromkeys(("reshape", "squeeze", "expand_dims"), moves.reshape),
    "add_any": _plain("add"),
    "is_finite": _plain("isfinite"),
    "rsqrt": lambda at, v: [at.wise("div", np.float64(1.0), at.wise("sqrt", v[0]))],
    "square": lambda at, v: [at.wise("mul", v[0], v[0])],
    "div": _division,
    "logistic": _logistic,
    "integer_pow": _power,
    "select_n": _select,
    "clamp": _clamp,
    "convert_element_type": _convert,
    "not": _not,
    "or": _or,
    "and": _and,
    "broadcast_in_dim": moves.broadcast,
    "transpose": moves.transpose,
    "slice": moves.sliced,
    "dynamic_slice": moves.dynamic_slice,
    "gather": moves.gather,
    "rev": moves.reverse,
    "concatenate": moves.concat,
    "stack": moves.stack,
    "split": moves.split,
    "pad": moves.pad,
    "dot_general": moves.dot,
}
PRIMITIVES = tuple(sorted((*_RULES, "scan", "cond")))
"""The JAX primitives that signals may pass through."""
