"""Equations from the problem file as functions of NumPy or JAX arrays, state first: x (nx, ...)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce
from types import MappingProxyType
from typing import Any, TypeAlias, cast

import numpy as np

from asia.models._arrays import AnyArray, labelled, namespace, rows, sigmoid, softplus
from asia.problem.memory import LEAST_TIME, TransportDelay, expanded
from asia.problem.physics import (
    Binary,
    Call,
    Expression,
    Name,
    Negative,
    Node,
    Number,
    Physics,
    check_physics,
    names_in,
)

Derivative: TypeAlias = Callable[[AnyArray, AnyArray], AnyArray]
"""d/dt (nx, ...) of x (nx, ...) with u (nu, ...)."""
_Request: TypeAlias = "str | tuple[str, ...] | tuple[int, int]"
Evaluator: TypeAlias = Callable[[AnyArray, AnyArray, AnyArray], AnyArray]
"""Values (n, ...) from parameters (np, ...), x (nx, ...) and u (nu, ...)."""

# Argument below which a square root continues as a straight line through 0.
_SMALL = 1e-6


def functions(xp: Any) -> Mapping[str, Callable[..., AnyArray]]:
    """Function table of the expressions; xp is numpy or jax.numpy."""

    def sqrt(x: AnyArray) -> AnyArray:
        """Square root with a finite derivative at 0, so that an empty tank can fill; 0 below."""
        line = xp.maximum(x, 0.0) * _SMALL**-0.5
        return xp.minimum(xp.sqrt(xp.maximum(x, _SMALL)), line)

    same = ("exp", "sin", "cos", "tan", "arcsin", "arccos", "arctan", "arctan2", "sinh", "cosh")
    return MappingProxyType(
        {
            **{name: getattr(xp, name) for name in (*same, "tanh", "abs", "sign")},
            "sqrt": sqrt,
            "log": lambda x: xp.log(xp.maximum(x, 1e-12)),
            "sigmoid": sigmoid,
            "softplus": softplus,
            "min": lambda *x: reduce(xp.minimum, x),
            "max": lambda *x: reduce(xp.maximum, x),
            "clip": lambda x, low, high: xp.minimum(xp.maximum(x, low), high),
        }
    )


def _functions_of_numbers() -> Mapping[str, Callable[..., Any]]:
    """The same table for single numbers. Where one raises an error, NumPy's has inf or nan."""

    def sign(x: float) -> float:
        return float((x > 0) - (x < 0))

    def sqrt(x: float) -> float:
        return min(math.sqrt(max(x, _SMALL)), max(x, 0.0) * _SMALL**-0.5)

    def log(x: float) -> float:
        return math.log(max(x, 1e-12))

    def sigmoid(x: float) -> float:
        return 0.5 * math.tanh(0.5 * x) + 0.5

    def softplus(x: float) -> float:
        return max(x, 0.0) + math.log1p(math.exp(-abs(x)))

    def clip(x: float, low: float, high: float) -> float:
        return min(max(x, low), high)

    same = ("exp", "sin", "cos", "tan", "sinh", "cosh", "tanh")
    inverse = ("sin", "cos", "tan", "tan2")
    own = (sign, sqrt, log, sigmoid, softplus, clip, abs, min, max)
    return {
        **{name: getattr(math, name) for name in same},
        **{f"arc{name}": getattr(math, f"a{name}") for name in inverse},
        **{f.__name__: f for f in own},
    }


@dataclass(frozen=True)
class Equations:
    """Parsed physics: hashable, so that it can be the key of functions and programs made of it."""

    states: tuple[str, ...]  # Names of the states, in the order of x
    inputs: tuple[str, ...]  # Names of the inputs, in the order of u
    outputs: tuple[str, ...]  # Names of the outputs, in the order of y
    parameters: tuple[str, ...]  # Names of the fitted parameters
    constants: tuple[tuple[str, float], ...]  # Names and values of the constants
    definitions: tuple[tuple[str, Expression], ...]
    """Names and expressions of the definitions, each after those it uses."""
    dynamics: tuple[Expression, ...]  # d/dt of each state
    observation: tuple[Expression, ...]  # Expression of each output
    rest: tuple[Expression, ...] = ()
    """Value at rest of each hidden state of a lag; these states come last."""
    delays: tuple[TransportDelay, ...] = ()
    """Transport delays, each after those it reads, first those that read no state. Their signals
    follow the inputs in u."""
    driven: int = 0  # Number of delays that read no state

    def __hash__(self) -> int:
        # A hash of all expressions would cost more than a step of a simulation.
        return hash((self.states, self.inputs, self.outputs, self.parameters))

    def rates(self, xp: Any, dtype: Any = np.float64) -> Evaluator:
        """Return the function that gives d/dt of the states, for arrays of xp, numpy or
        jax.numpy."""
        return _evaluator(self, "dynamics", xp, np.dtype(dtype))

    def observe(self, parameters: AnyArray, x: AnyArray, u: AnyArray) -> AnyArray:
        """Outputs (ny, ...), from parameters (np, ...), states x (nx, ...) and inputs u (nu,
        ...)."""
        return self._values("observation", parameters, x, u)

    def passage(
        self, k: int, parameters: AnyArray, x: AnyArray, u: AnyArray
    ) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
        """Signal that enters delay k, flow, volume and dispersion, each (...)."""
        # Separate arrays, so that a constant volume stays a constant in a lowered program.
        found = (self._values((k, i), parameters, x, u)[0] for i in range(4))
        value, flow, volume, dispersion = found
        return value, flow, volume, dispersion

    def at_rest(self, parameters: AnyArray, x: AnyArray, u: AnyArray) -> AnyArray:
        """Values at rest (n, ...) of the hidden states of lags."""
        return self._values("rest", parameters, x, u)

    def named(
        self, names: tuple[str, ...], parameters: AnyArray, x: AnyArray, u: AnyArray
    ) -> AnyArray:
        """Values (len(names), ...) of states, inputs, parameters or definitions."""
        return self._values(names, parameters, x, u)

    def closure(self, expression: Expression) -> frozenset[str]:
        """All names an expression depends on, definitions followed."""
        known = dict(self.definitions)
        found, left = set[str](), set(expression.names)
        while left:
            name = left.pop()
            found.add(name)
            if name in known:
                left |= known[name].names - found
        return frozenset(found)

    def _values(
        self, requested: _Request, parameters: AnyArray, x: AnyArray, u: AnyArray
    ) -> AnyArray:
        xp = namespace(parameters, x, u)
        return _evaluator(self, requested, xp, np.dtype(x.dtype))(parameters, x, u)


@lru_cache(maxsize=256)
def _evaluator(system: Equations, requested: _Request, xp: Any, dtype: np.dtype[Any]) -> Evaluator:
    """Compile a Python function of a field's expressions, of a delay's, or of names.

    Its source holds nothing of the user's text: every name becomes a numbered variable, and the
    tree knows only numbers, + - * / ** and the functions of the table.
    """
    if isinstance(requested, str):
        expressions: tuple[Expression, ...] = getattr(system, requested)
    elif len(requested) == 2 and isinstance(requested[0], int):
        number, part = cast("tuple[int, int]", requested)
        one = system.delays[number]
        expressions = (of_node(one.parts[part]),)
    else:
        wanted = cast("tuple[str, ...]", requested)
        expressions = tuple(Expression(n, Name(n), frozenset((n,))) for n in wanted)
    source, needed = _Source({}), frozenset[str]().union(*(system.closure(e) for e in expressions))
    for i, (name, _) in enumerate(system.constants):
        source.places[name] = f"c_{i}"
    signals = (*system.inputs, *(one.name for one in system.delays))
    labels: list[str] = []

    def named(name: str, value: str) -> str:
        if xp is np:
            return source.line(value)
        labels.append(name)
        return source.line(f"label({value}, {len(labels) - 1})")

    for group, names in (("p", system.parameters), ("u", signals), ("x", system.states)):
        for i, name in enumerate(names):
            if name in needed:
                source.places[name] = named(name, f"{group}[{i}]")
    for name, expression in system.definitions:
        if name in needed:
            source.places[name] = named(name, source.of(expression.root))
    results = "".join(f"{source.of(e.root)}, " for e in expressions)
    lines = ["def evaluate(p, x, u):", *source.lines, f"return rows(({results}), x)"]
    code = compile("\n    ".join(lines), "<equations>", "exec")

    def label(value: AnyArray, place: int) -> AnyArray:
        return labelled(value, labels[place])

    def compiled(
        table: Mapping[str, Callable[..., Any]],
        number: Callable[[float], Any],
        stacked: Callable[[Any, Any], Any],
    ) -> Evaluator:
        constants = {f"c_{i}": number(value) for i, (_, value) in enumerate(system.constants)}
        own = {f"f_{k}": f for k, f in table.items()}
        scope = {"rows": stacked, "label": label, **own, **constants}
        exec(code, scope)
        return cast(Evaluator, scope["evaluate"])

    many = compiled(functions(xp), dtype.type, rows)
    if xp is not np or dtype != np.float64:
        return many
    single = compiled(_functions_of_numbers(), float, lambda values, _: values)

    def evaluate(p: AnyArray, x: AnyArray, u: AnyArray) -> AnyArray:
        # A single case is computed in numbers, which is faster than arrays of one element.
        if all(a.size == len(a) for a in (p, x, u)):
            try:
                values = np.array(single(*(a.ravel().tolist() for a in (p, x, u))))
            except (ArithmeticError, ValueError, TypeError):  # TypeError: a complex root
                return many(p, x, u)
            if values.dtype == np.float64:
                return values.reshape(len(values), *x.shape[1:])
        return many(p, x, u)

    return evaluate


class _Source:
    """Lines of Python, one operation each, and the variables that hold the names' values."""

    def __init__(self, places: dict[str, str]) -> None:
        self.places = places
        self._variables: dict[str, str] = {}

    @property
    def lines(self) -> list[str]:
        """Lines in their order."""
        return [f"{variable} = {value}" for value, variable in self._variables.items()]

    def line(self, value: str) -> str:
        """Variable that holds a value; an expression that occurs twice is computed once."""
        return self._variables.setdefault(value, f"v_{len(self._variables)}")

    def of(self, node: Node) -> str:
        """Variable or literal with the value of a tree."""
        match node:
            case Number(value):
                return f"({value!r})"
            case Name(name):
                return self.places[name]
            case Negative(operand):
                return self.line(f"-{self.of(operand)}")
            case Binary("**", left, Number(power)) if power.is_integer() and abs(power) <= 64:
                # A whole exponent keeps derivatives at zero finite in JAX.
                return self.line(f"{self.of(left)} ** {int(power)}")
            case Binary(symbol, left, right):
                return self.line(f"{self.of(left)} {symbol} {self.of(right)}")
            case Call(function, arguments):
                values = ", ".join(self.of(a) for a in arguments)
                return self.line(f"f_{function}({values})")


def equations(physics: Physics, inputs: Sequence[str], outputs: Sequence[str]) -> Equations:
    """Parse and check `physics` for these signals.

    Raises:
        UserError: if they do not fit.
    """
    check_physics(physics, inputs, outputs)
    found = expanded(physics, outputs)
    return Equations(
        states=found.states,
        inputs=tuple(inputs),
        outputs=tuple(outputs),
        parameters=tuple(physics.parameters),
        # Corrections are 0 without their learned values.
        constants=(
            *physics.constants.items(),
            *((name, 0.0) for name in physics.corrections),
            *([(LEAST_TIME, 0.0)] if found.rest else []),
        ),
        definitions=tuple((name, of_node(node)) for name, node in found.definitions),
        dynamics=tuple(of_node(node) for node in found.dynamics),
        observation=tuple(of_node(node) for node in found.observation),
        rest=tuple(of_node(node) for node in found.rest),
        delays=found.delays,
        driven=found.driven,
    )


def of_node(node: Node) -> Expression:
    """Expression of a tree."""
    return Expression("", node, names_in(node))


def runge_kutta(derivative: Derivative, x: AnyArray, u: AnyArray, step: AnyArray) -> AnyArray:
    """Advance states x (nx, ...) by one classical fourth-order Runge-Kutta step, a number or (...)
    in s, with the inputs u (3, nu, ...) at its start, middle and end."""
    k1 = derivative(x, u[0])
    k2 = derivative(x + 0.5 * step * k1, u[1])
    k3 = derivative(x + 0.5 * step * k2, u[1])
    k4 = derivative(x + step * k3, u[2])
    return x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
