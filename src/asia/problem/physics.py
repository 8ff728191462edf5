"""Equations from the problem file: types, parser, checks."""

from __future__ import annotations

import ast
import operator
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite, pi
from typing import Annotated, Any, TypeVar

from annotated_types import MinLen

from asia._syntax import expression_tree
from asia._text import nearest
from asia.errors import UserError

# Equations of a problem file with the ranges of their parameters.


@dataclass(frozen=True)
class ParameterRange:
    """Search range of a physical parameter."""

    min: float
    """The least starting value; above 0 the range is searched on a log scale."""
    max: float


@dataclass(frozen=True)
class Bounds:
    """Physical range of a state."""

    min: float | None = None
    max: float | None = None


@dataclass(frozen=True)
class Prior:
    """Prior of a combination of parameters: a normal distribution."""

    mean: float
    """The most probable value, in the unit of the combination."""
    deviation: float
    """Standard deviation, above 0, in the same unit."""
    reason: str = ""


@dataclass(frozen=True)
class Correction:
    """An unknown effect at a place in the equations, learned from the records."""

    scale: float
    """Typical size, above 0, in the unit of its equation."""


@dataclass(frozen=True)
class Physics:
    """Equations of a problem.

    Expressions are text in the names of states, inputs, parameters, constants and definitions;
    `expressions.py` lists what they may hold.
    """

    states: Annotated[tuple[str, ...], MinLen(1)]
    dynamics: Mapping[str, str]
    """Time derivative of every state."""
    parameters: Mapping[str, ParameterRange] = field(default_factory=dict[str, ParameterRange])
    """Ranges of the numbers that are fitted."""
    constants: Mapping[str, float] = field(default_factory=dict[str, float])
    definitions: Mapping[str, str] = field(default_factory=dict[str, str])
    observation: Mapping[str, str] = field(default_factory=dict[str, str])
    """Outputs from states; default: the state of the same name."""
    bounds: Mapping[str, Bounds] = field(default_factory=dict[str, Bounds])
    """Physical ranges of states, which the simulator keeps to."""
    priors: Mapping[str, Prior] = field(default_factory=dict[str, Prior])
    """Priors of parameters, by an expression in them and in constants."""
    corrections: Mapping[str, Correction] = field(default_factory=dict[str, Correction])
    """Names in the equations that represent unknown effects: 0 until a model learns them."""


# Physics expressions: text, through an `ast` whitelist, to a small tree of our own.
#
# Nothing in the text is ever executed. The tree knows no array library: the evaluating code
# supplies the values of its names and the functions.


T = TypeVar("T")

_UNARY = (
    "sqrt", "exp", "log", "sin", "cos", "tan", "arcsin", "arccos", "arctan", "sinh", "cosh", "tanh",
    "sigmoid", "softplus", "abs", "sign",
)  # fmt: skip
FUNCTIONS: Mapping[str, tuple[int, int | None]] = {
    **dict.fromkeys(_UNARY, (1, 1)),
    "arctan2": (2, 2),
    "min": (2, None),
    "max": (2, None),
    "clip": (3, 3),
}
"""Functions an expression may call, with their least and greatest number of arguments."""

MEMORY: Mapping[str, tuple[int, int | None]] = {
    "delay": (2, 2),
    "plug_flow": (3, 4),
    "plug_mean": (3, 4),
    "lag": (2, 2),
}
"""Operators of equations whose value depends on past samples, with their numbers of arguments."""

NAMED_NUMBERS: Mapping[str, float] = {"pi": pi}
"""Names reserved for numbers."""


@dataclass(frozen=True)
class Number:
    """A literal."""

    value: float


@dataclass(frozen=True)
class Name:
    """A symbol: state, input, parameter, constant or definition."""

    name: str


@dataclass(frozen=True)
class Negative:
    """Unary minus."""

    operand: Node


@dataclass(frozen=True)
class Binary:
    """One of + - * / **."""

    symbol: str
    left: Node
    right: Node


@dataclass(frozen=True)
class Call:
    """A function of the table."""

    function: str
    arguments: tuple[Node, ...]


Node = Number | Name | Negative | Binary | Call

_SYMBOLS: Mapping[type[ast.operator], str] = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**",
}  # fmt: skip
_OPERATIONS: Mapping[str, Callable[[Any, Any], Any]] = {
    "+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv,
    "**": operator.pow,
}  # fmt: skip


@dataclass(frozen=True)
class Expression:
    """Parsed expression; `text` is the source text, `names` the symbols in it."""

    text: str
    root: Node
    names: frozenset[str]

    def evaluate(self, values: Mapping[str, T], functions: Mapping[str, Callable[..., T]]) -> T:
        """The value, with `values` for every name and `functions` for every function of the
        table that the expression calls. Works for floats, NumPy and JAX arrays alike."""
        return self.compiled(functions)(values)

    def compiled(self, functions: Mapping[str, Callable[..., T]]) -> Callable[[Mapping[str, T]], T]:
        """`evaluate` as a function of the values, for many calls."""
        return _compiled(self.root, functions)


def parse_expression(text: str, where: str, *, memory: bool = False) -> Expression:
    """Parse `text`; `where` names its field in messages, and `memory` allows the operators that
    remember past samples.

    Raises:
        UserError: when the text does not parse, holds anything except names, numbers, + - * /
            **, parentheses and calls of the table's functions, or is longer than 4000
            characters
    """
    if len(text) > 4000:
        raise UserError(
            f"{where}: the expression has {len(text)} characters, at most 4000 are allowed; "
            "split it into [physics.definitions]"
        )
    if "^" in text:
        power = text.replace("^", "**")
        raise UserError(f"{where}: '^' is not a power: write ** as in '{power}'")
    try:
        tree = expression_tree(text.strip())
        root = _Parser(where, {**FUNCTIONS, **MEMORY} if memory else FUNCTIONS).node(tree.body)
        names = names_in(root)
    except (SyntaxError, ValueError) as error:
        product = _with_product(text)
        advice = f": write '{product}'" if product else ""
        raise UserError(
            f"{where}: '{text}' is not an expression ({error.args[0]}){advice}"
        ) from None
    except (RecursionError, MemoryError):
        raise UserError(
            f"{where}: the expression is nested too deeply; split it into [physics.definitions]"
        ) from None
    return Expression(text, root, names)


def _with_product(text: str) -> str:
    """The text with `*` between factors side by side, such as `b w1`, and parentheses behind the
    name of a function; "" where that does not make it an expression."""
    text = text.strip()
    changed = re.sub(r"(?<=[\w)])\s+(?=[A-Za-z_(])|(?<=\))(?=[\w(])", "*", text)
    changed = re.sub(r"(?<![\w.])(\d+\.?\d*)(?=(?![eE][-+]?\d)[A-Za-z_(])", r"\1*", changed)
    changed = re.sub(rf"\b({'|'.join(FUNCTIONS)})\*(\w+)", r"\1(\2)", changed)
    try:
        expression_tree(changed)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return ""
    return changed if changed != text else ""


def _number(value: float, where: str) -> Number:
    if not abs(value) <= sys.float_info.max:
        raise UserError(f"{where}: a number in the expression is too large")
    return Number(float(value))


def _binary(symbol: str, left: Node, right: Node, where: str) -> Node:
    if isinstance(left, Number) and isinstance(right, Number):
        try:
            value = _OPERATIONS[symbol](left.value, right.value)
        except (ZeroDivisionError, OverflowError) as error:
            raise UserError(
                f"{where}: {left.value} {symbol} {right.value} has no value ({error})"
            ) from None
        if isinstance(value, complex):
            raise UserError(f"{where}: {left.value} {symbol} {right.value} is not a real number")
        return _number(value, where)
    if symbol == "**" and right == Number(0.5):
        return Call("sqrt", (left,))
    return Binary(symbol, left, right)


@dataclass(frozen=True)
class _Parser:
    """Conversion of Python's tree to ours."""

    where: str
    functions: Mapping[str, tuple[int, int | None]]

    def node(self, node: ast.expr) -> Node:
        where = self.where
        match node:
            case ast.Constant(value=bool() | str() | bytes() | complex() | None):
                raise UserError(f"{where}: {ast.unparse(node)} is not a real number")
            case ast.Constant(value=int() | float() as value):
                return _number(value, where)
            case ast.Name(id=name):
                return Number(NAMED_NUMBERS[name]) if name in NAMED_NUMBERS else Name(name)
            case ast.UnaryOp(op=ast.UAdd()):
                return self.node(node.operand)
            case ast.UnaryOp(op=ast.USub()):
                operand = self.node(node.operand)
                return Number(-operand.value) if isinstance(operand, Number) else Negative(operand)
            case ast.BinOp(op=op) if type(op) in _SYMBOLS:
                return _binary(
                    _SYMBOLS[type(op)], self.node(node.left), self.node(node.right), where
                )
            case ast.Call():
                return self._call(node)
            case _:
                raise UserError(
                    f"{where}: '{ast.unparse(node)}' is not allowed; an expression holds names, "
                    "numbers, + - * / **, parentheses and function calls"
                )

    def _call(self, node: ast.Call) -> Call:
        where = self.where
        if not isinstance(node.func, ast.Name):
            raise UserError(f"{where}: '{ast.unparse(node.func)}' cannot be called")
        name = node.func.id
        if name in MEMORY and name not in self.functions:
            raise UserError(
                f"{where}: {name} remembers past samples; use it in [physics.definitions], "
                "[physics.dynamics] or [physics.observation]"
            )
        if name not in self.functions:
            product = ""
            if len(node.args) == 1 and not node.keywords:
                product = f"; for a product write '{name}*({ast.unparse(node.args[0])})'"
            raise UserError(
                f"{where}: there is no function '{name}'{nearest(name, self.functions)}{product}"
            )
        least, greatest = self.functions[name]
        count = len(node.args)
        starred = any(isinstance(argument, ast.Starred) for argument in node.args)
        if node.keywords or starred or count < least or (greatest is not None and count > greatest):
            expected = f"{least}" if greatest == least else f"{least} or {greatest or 'more'}"
            raise UserError(
                f"{where}: '{ast.unparse(node)}': {name} takes {expected} plain "
                f"argument{'s' if expected != '1' else ''}"
            )
        return Call(name, tuple(self.node(argument) for argument in node.args))


def names_in(node: Node) -> frozenset[str]:
    """All names of a tree."""
    match node:
        case Number():
            return frozenset()
        case Name(name):
            return frozenset((name,))
        case Negative(operand):
            return names_in(operand)
        case Binary(_, left, right):
            return names_in(left) | names_in(right)
        case Call(_, arguments):
            return frozenset[str]().union(*(names_in(argument) for argument in arguments))


def _compiled(
    node: Node, functions: Mapping[str, Callable[..., Any]]
) -> Callable[[Mapping[str, Any]], Any]:
    match node:
        case Number(value):
            return lambda values: value
        case Name(name):
            return operator.itemgetter(name)
        case Negative(operand):
            inner = _compiled(operand, functions)
            return lambda values: -inner(values)
        case Binary("**", left, Number(power)) if power.is_integer() and abs(power) <= 64:
            # A whole exponent keeps derivatives at zero finite in JAX.
            base, whole = _compiled(left, functions), int(power)
            return lambda values: base(values) ** whole
        case Binary(symbol, left, right):
            a, b = _compiled(left, functions), _compiled(right, functions)
            operation = _OPERATIONS[symbol]
            return lambda values: operation(a(values), b(values))
        case Call(function, arguments):
            call = functions[function]
            parts = [_compiled(argument, functions) for argument in arguments]
            return lambda values: call(*[part(values) for part in parts])


# Checks of the `[physics]` section, before anything is spent on it.


def check_physics(physics: Physics, inputs: Sequence[str], outputs: Sequence[str]) -> None:
    """Raise UserError, naming the field, at the first thing that does not fit together.

    Args:
        inputs, outputs: the signal names of the problem
    """
    symbols = _symbols(physics, inputs)
    for name, value in physics.parameters.items():
        if not (isfinite(value.min) and isfinite(value.max) and value.min < value.max):
            raise UserError(
                f"[physics.parameters] {name}: min {value.min} must be below max {value.max}, "
                "both finite"
            )
    for name, constant in physics.constants.items():
        if not isfinite(constant):
            raise UserError(f"[physics.constants] {name}: expected a finite number")
    _check_known("bounds", physics.bounds, "state", physics.states)
    for name, bounds in physics.bounds.items():
        low, high = bounds.min, bounds.max
        if low is not None and high is not None and not low < high:
            raise UserError(f"[physics.bounds] {name}: min {low} must be below max {high}")
    for text, prior in physics.priors.items():
        where = f"[physics.priors] {text}"
        names = _parse(text, where, {*physics.parameters, *physics.constants}).names
        if not names & set(physics.parameters):
            raise UserError(f"{where}: names no parameter; write an expression in parameters")
        if not (isfinite(prior.mean) and isfinite(prior.deviation) and prior.deviation > 0):
            raise UserError(
                f"{where}: expected a finite mean and a deviation above 0, got {prior.mean} and "
                f"{prior.deviation}"
            )
    for name in physics.states:
        if name not in physics.dynamics:
            raise UserError(f"[physics.dynamics] {name}: missing; give d/dt of every state")
    _check_known("dynamics", physics.dynamics, "state", physics.states)
    _check_known("observation", physics.observation, "output", outputs)
    for name in outputs:
        if name not in physics.observation and name not in physics.states:
            raise UserError(
                f"[physics.observation] {name}: missing; no state has this output's name, so say "
                "how it follows from the states"
            )
    sections = {
        "definitions": physics.definitions,
        "dynamics": physics.dynamics,
        "observation": physics.observation,
    }
    used = {
        symbol
        for section, entries in sections.items()
        for name, text in entries.items()
        for symbol in _parse(text, f"[physics.{section}] {name}", symbols, memory=True).names
    }
    for name, correction in physics.corrections.items():
        if name not in used:
            raise UserError(
                f"[physics.corrections] {name}: no equation uses it; write it where the unknown "
                "effect enters"
            )
        if not (isfinite(correction.scale) and correction.scale > 0):
            raise UserError(
                f"[physics.corrections] {name}: expected a scale above 0, its typical size"
            )
    definition_order(physics)


def definition_order(physics: Physics) -> tuple[str, ...]:
    """Names of the definitions, each after those it uses.

    Raises:
        UserError: on a cycle
    """
    uses = {
        name: parse_expression(text, f"[physics.definitions] {name}", memory=True).names
        & physics.definitions.keys()
        for name, text in physics.definitions.items()
    }
    ordered: list[str] = []
    while len(ordered) < len(uses):
        ready = [name for name in uses if name not in ordered and uses[name] <= set(ordered)]
        if not ready:
            cycle = sorted(set(uses) - set(ordered))
            raise UserError(
                f"[physics.definitions]: {', '.join(cycle)} refer to each other in a circle; "
                "write one of them in terms of states, inputs and parameters only"
            )
        ordered.extend(ready)
    return tuple(ordered)


def _symbols(physics: Physics, inputs: Sequence[str]) -> set[str]:
    """Everything an expression may name; refuses names that clash or cannot be written."""
    if not physics.states:
        raise UserError("[physics] states: at least one state is needed")
    owners: dict[str, str] = dict.fromkeys(FUNCTIONS, "a function")
    owners |= dict.fromkeys(NAMED_NUMBERS, "a number with a fixed name")
    groups = (
        ("an input", inputs, "inputs"),
        ("a state", physics.states, "[physics] states"),
        ("a parameter", physics.parameters, "[physics.parameters]"),
        ("a constant", physics.constants, "[physics.constants]"),
        ("a definition", physics.definitions, "[physics.definitions]"),
        ("a correction", physics.corrections, "[physics.corrections]"),
    )
    for kind, names, where in groups:
        for name in names:
            # An input whose name is not an identifier is of use to black-box models only.
            if not name.isidentifier() and kind != "an input":
                raise UserError(
                    f"{where}: '{name}' cannot be written in an expression; use letters, digits "
                    "and underscores"
                )
            if name in owners:
                raise UserError(f"{where}: '{name}' is already {owners[name]}; choose another name")
            owners[name] = kind
    return set(owners) - set(FUNCTIONS) - set(NAMED_NUMBERS)


def _check_known(table: str, names: Iterable[str], kind: str, known: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            raise UserError(
                f"[physics.{table}] {name}: there is no such {kind}{nearest(name, known)}"
            )


def _parse(text: str, where: str, symbols: set[str], *, memory: bool = False) -> Expression:
    """Parse an expression that names nothing but `symbols`."""
    expression = parse_expression(text, where, memory=memory)
    for name in sorted(expression.names - symbols):
        if name in FUNCTIONS:
            raise UserError(f"{where}: '{name}' is a function: call it with its argument")
        raise UserError(f"{where}: undefined symbol '{name}'{nearest(name, sorted(symbols))}")
    return expression
