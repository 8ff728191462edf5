"""Equations as MathML, which browsers typeset by themselves."""

from __future__ import annotations

import re

from asia.problem import Physics
from asia.problem.physics.expressions import (
    Binary,
    Call,
    Expression,
    Name,
    Negative,
    Node,
    Number,
    parse_expression,
)
from asia.report._page.html import Html, join, tag

_SHORT = re.compile(r"([A-Za-z])(\d+|_\w{1,3})?")
_WORD = re.compile(r"([A-Za-z]{2,}?)_?(\d+)")
_NAMES = (
    "alpha beta gamma delta epsilon zeta eta theta kappa lambda mu nu xi rho sigma tau phi chi psi "
    "omega Gamma Delta Theta Sigma Phi Psi Omega"
)
_GREEK: dict[str, str] = dict(zip(_NAMES.split(), "αβγδεζηθκλμνξρστφχψωΓΔΘΣΦΨΩ", strict=True))
_STRENGTH = {"+": 1, "-": 1, "*": 2, "/": 2, "**": 4}
_UNARY = 3


def equations(physics: Physics) -> tuple[tuple[str, Html], ...]:
    """Format the equations of a problem as (description, formula): definitions, dynamics and
    outputs.
    """
    rows = [("definition", symbol(name), text) for name, text in physics.definitions.items()]
    for name in physics.states:
        slope = tag("mfrac", tag("mi", "d"), tag("mrow", tag("mi", "d"), tag("mi", "t")))
        rows.append(("dynamics", join((slope, symbol(name))), physics.dynamics[name]))
    rows += [("output", symbol(name), text) for name, text in physics.observation.items()]
    return tuple((kind, equation(left, text)) for kind, left, text in rows)


def equation(left: Html, text: str) -> Html:
    """`left = text`, where `text` is an expression of a problem file."""
    right = formula(parse_expression(text, "physics"))
    return tag("math", tag("mrow", left, tag("mo", "="), right), display="block")


def formula(expression: Expression) -> Html:
    """Format an expression with its terms in the order of the problem file."""
    return _node(expression.root)


def symbol(name: str) -> Html:
    """A short name with its digits as a subscript, a long one upright."""
    if name in _GREEK:
        return tag("mi", _GREEK[name])
    if found := _SHORT.fullmatch(name):
        letter, below = found.groups()
        head = tag("mi", letter)
        return head if below is None else _below(head, below.lstrip("_"))
    if (found := _WORD.fullmatch(name)) and found[1] in _GREEK:
        return _below(tag("mi", _GREEK[found[1]]), found[2])
    return tag("mi", name.replace("_", " "), mathvariant="normal")


def _below(head: Html, below: str) -> Html:
    return tag("msub", head, tag("mn" if below.isdecimal() else "mi", below))


def _node(node: Node) -> Html:
    match node:
        case Number(value):
            return tag("mn", f"{value:g}")
        case Name(name):
            return symbol(name)
        case Negative(operand):
            return tag("mrow", tag("mo", "−"), _inside(operand, _UNARY))
        case Binary("/", left, right):
            return tag("mfrac", _row(_node(left)), _row(_node(right)))
        case Binary("**", left, right):
            return tag("msup", _row(_inside(left, _STRENGTH["**"] + 1)), _row(_node(right)))
        case Binary(sign, left, right):
            strength = _STRENGTH[sign]
            shown = {"*": "\N{INVISIBLE TIMES}", "-": "−"}.get(sign, sign)
            if sign == "*" and (isinstance(right, Number | Negative) or _is_word(left, right)):
                shown = "·"
            other = _inside(right, strength + (sign == "-"))
            room = {"·": "0.25em", "\N{INVISIBLE TIMES}": "0.12em"}.get(shown)
            mark = tag("mo", shown, lspace=room, rspace=room)
            return join((_inside(left, strength), mark, other))
        case Call(function, arguments):
            return _call(function, [_node(argument) for argument in arguments])


def _is_word(*factors: Node) -> bool:
    """Return whether one of the factors ends or begins with a word, which a space would not
    separate.
    """
    last, first = factors
    while isinstance(last, Binary) and last.symbol == "*":
        last = last.right
    names = [n.name for n in (last, first) if isinstance(n, Name)]
    calls = isinstance(first, Call) and first.function not in ("sqrt", "abs")
    return calls or any(n not in _GREEK and not _SHORT.fullmatch(n) for n in names)


def _call(function: str, arguments: list[Html]) -> Html:
    if function == "sqrt":
        return tag("msqrt", arguments[0])
    if function == "abs":
        return tag("mrow", tag("mo", "|"), arguments[0], tag("mo", "|"))
    return tag(
        "mrow",
        tag("mi", function, mathvariant="normal"),
        tag("mo", "("),
        join(arguments, tag("mo", ",")),
        tag("mo", ")"),
    )


def _inside(node: Node, strength: int) -> Html:
    own = _UNARY
    if isinstance(node, Binary):
        own = 5 if node.symbol == "/" else _STRENGTH[node.symbol]
    elif not isinstance(node, Negative):
        own = 5
    inner = _node(node)
    if own >= strength:
        return inner
    return tag("mrow", tag("mo", "("), inner, tag("mo", ")"))


def _row(inner: Html) -> Html:
    return tag("mrow", inner)
