"""Physics expressions: text, through an `ast` whitelist, to a small tree of our own.

Nothing in the text is ever executed. The tree knows no array library: the evaluating code supplies
the values of its names and the functions.
"""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import isfinite, pi
from types import MappingProxyType
from typing import Any, TypeVar

from asia._nearest import nearest
from asia._syntax import expression_tree
from asia.errors import UserError

T = TypeVar("T")

_OF_ONE = (
    "sqrt", "exp", "log", "sin", "cos", "tan", "arcsin", "arccos", "arctan", "sinh", "cosh", "tanh",
    "sigmoid", "softplus", "abs", "sign",
)  # fmt: skip
FUNCTIONS: Mapping[str, tuple[int, int | None]] = MappingProxyType(
    dict.fromkeys(_OF_ONE, (1, 1))
    | {"arctan2": (2, 2), "min": (2, None), "max": (2, None), "clip": (3, 3)}
)
"""Functions an expression may call, with their least and greatest number of arguments."""

NAMED_NUMBERS: Mapping[str, float] = MappingProxyType({"pi": pi})
"""Names reserved for numbers."""

_LONGEST = 4000


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

_SYMBOLS: Mapping[type[ast.operator], str] = MappingProxyType(
    {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**"}
)
_OPERATIONS: Mapping[str, Callable[[Any, Any], Any]] = MappingProxyType(
    {
        "+": operator.add,
        "-": operator.sub,
        "*": operator.mul,
        "/": operator.truediv,
        "**": operator.pow,
    }
)


@dataclass(frozen=True)
class Expression:
    """Parsed expression; `text` is the source text, `names` the symbols in it."""

    text: str
    root: Node
    names: frozenset[str]

    def evaluate(self, values: Mapping[str, T], functions: Mapping[str, Callable[..., T]]) -> T:
        """The value, with `values` for every name and `functions` for every function of the
        table that the expression calls. Works for floats, NumPy and JAX arrays alike."""
        return _evaluate(self.root, values, functions)


def parse_expression(text: str, where: str) -> Expression:
    """Parse `text`; `where` names its field in messages.

    Raises:
        UserError: when the text does not parse, holds anything except names, numbers, + - * /
            **, parentheses and calls of the table's functions, or is longer than 4000
            characters
    """
    if len(text) > _LONGEST:
        raise UserError(
            f"{where}: the expression has {len(text)} characters, at most {_LONGEST} are "
            "allowed; split it into [physics.definitions]"
        )
    if "^" in text:
        power = text.replace("^", "**")
        raise UserError(f"{where}: '^' is not a power: write ** as in '{power}'")
    try:
        tree = expression_tree(text.strip())
        root = _convert(tree.body, where)
        names = frozenset(_names(root))
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


def _with_product(text: str) -> str | None:
    """The text with `*` between factors side by side, such as `b w1`, and parentheses behind the
    name of a function; None where that does not make it an expression."""
    changed = re.sub(r"(?<=[\w)])\s+(?=[A-Za-z_(])|(?<=\))(?=[\w(])", "*", text.strip())
    changed = re.sub(r"(?<![\w.])(\d+\.?\d*)(?=(?![eE][-+]?\d)[A-Za-z_(])", r"\1*", changed)
    called = "|".join(FUNCTIONS)
    changed = re.sub(rf"\b({called})\*(\w+)", r"\1(\2)", changed)
    if changed == text.strip():
        return None
    try:
        expression_tree(changed)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return None
    return changed


def _convert(node: ast.expr, where: str) -> Node:
    match node:
        case ast.Constant(value=bool() | str() | bytes() | complex() | None):
            raise UserError(f"{where}: {ast.unparse(node)} is not a real number")
        case ast.Constant(value=int() | float() as value):
            return _literal(value, where)
        case ast.Name(id=name):
            return Number(NAMED_NUMBERS[name]) if name in NAMED_NUMBERS else Name(name)
        case ast.UnaryOp(op=ast.UAdd()):
            return _convert(node.operand, where)
        case ast.UnaryOp(op=ast.USub()):
            operand = _convert(node.operand, where)
            return Number(-operand.value) if isinstance(operand, Number) else Negative(operand)
        case ast.BinOp(op=op) if type(op) in _SYMBOLS:
            left, right = _convert(node.left, where), _convert(node.right, where)
            return _binary(_SYMBOLS[type(op)], left, right, where)
        case ast.Call():
            return _call(node, where)
        case _:
            raise UserError(
                f"{where}: '{ast.unparse(node)}' is not allowed; an expression holds names, "
                "numbers, + - * / **, parentheses and function calls"
            )


def _literal(value: float, where: str) -> Number:
    try:
        return _number(float(value), where)
    except OverflowError:
        raise UserError(f"{where}: a number in the expression is too large") from None


def _number(value: float, where: str) -> Number:
    if not isfinite(value):
        raise UserError(f"{where}: a number in the expression is too large")
    return Number(value)


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


def _call(node: ast.Call, where: str) -> Call:
    if not isinstance(node.func, ast.Name):
        raise UserError(f"{where}: '{ast.unparse(node.func)}' cannot be called")
    name = node.func.id
    if name not in FUNCTIONS:
        product = ""
        if len(node.args) == 1 and not node.keywords:
            product = f"; for a product write '{name}*({ast.unparse(node.args[0])})'"
        raise UserError(
            f"{where}: there is no function '{name}'{nearest(name, FUNCTIONS)}{product}"
        )
    least, greatest = FUNCTIONS[name]
    count = len(node.args)
    starred = any(isinstance(argument, ast.Starred) for argument in node.args)
    if node.keywords or starred or count < least or (greatest is not None and count > greatest):
        expected = f"{least}" if greatest == least else f"{least} or more"
        raise UserError(
            f"{where}: '{ast.unparse(node)}': {name} takes {expected} plain "
            f"argument{'s' if expected != '1' else ''}"
        )
    return Call(name, tuple(_convert(argument, where) for argument in node.args))


def _names(node: Node) -> set[str]:
    match node:
        case Number():
            return set()
        case Name(name):
            return {name}
        case Negative(operand):
            return _names(operand)
        case Binary(_, left, right):
            return _names(left) | _names(right)
        case Call(_, arguments):
            return set[str]().union(*(_names(argument) for argument in arguments))


def _evaluate(
    node: Node, values: Mapping[str, Any], functions: Mapping[str, Callable[..., Any]]
) -> Any:
    match node:
        case Number(value):
            return value
        case Name(name):
            return values[name]
        case Negative(operand):
            return -_evaluate(operand, values, functions)
        case Binary("**", left, Number(power)) if power.is_integer() and abs(power) <= 64:
            # A whole exponent keeps derivatives at zero finite in JAX.
            return _evaluate(left, values, functions) ** int(power)
        case Binary(symbol, left, right):
            a = _evaluate(left, values, functions)
            return _OPERATIONS[symbol](a, _evaluate(right, values, functions))
        case Call(function, arguments):
            return functions[function](*(_evaluate(a, values, functions) for a in arguments))
