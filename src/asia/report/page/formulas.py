"""Equations as MathML, which browsers typeset by themselves."""

from __future__ import annotations

import re

from markupsafe import Markup

from asia.problem.physics import (
    Binary,
    Call,
    Expression,
    Name,
    Negative,
    Node,
    Number,
    Physics,
    parse_expression,
)

_SHORT = re.compile(r"([A-Za-z])(\d+|_\w{1,3})?")
_WORD = re.compile(r"([A-Za-z]{2,}?)(\d+|_\w{1,3})")
_NAMES = (
    "alpha beta gamma delta epsilon zeta eta theta kappa lambda mu nu xi rho sigma tau phi chi psi "
    "omega Gamma Delta Theta Sigma Phi Psi Omega"
)
_GREEK: dict[str, str] = dict(zip(_NAMES.split(), "αβγδεζηθκλμνξρστφχψωΓΔΘΣΦΨΩ", strict=True))
_STRENGTH = {"+": 1, "-": 1, "*": 2, "/": 2, "**": 4}
_UNARY = 3


def equations(physics: Physics) -> tuple[tuple[str, Markup], ...]:
    """Format the equations of a problem as (description, formula): definitions, dynamics and
    outputs.
    """
    rows = [("definition", symbol(name), text) for name, text in physics.definitions.items()]
    for name in physics.states:
        slope = _tag("mfrac", _tag("mi", "d"), _tag("mrow", _tag("mi", "d"), _tag("mi", "t")))
        rows.append(("dynamics", slope + symbol(name), physics.dynamics[name]))
    rows += [("output", symbol(name), text) for name, text in physics.observation.items()]
    found: list[tuple[str, Markup]] = []
    for kind, left, text in rows:
        right = formula(parse_expression(text, "physics", memory=True))
        line = _tag("mrow", left, _tag("mo", "="), right)
        found.append((kind, _tag("math", line, display="block")))
    return tuple(found)


def formula(expression: Expression) -> Markup:
    """Format an expression with its terms in the order of the problem file."""
    return _node(expression.root)


def symbol(name: str) -> Markup:
    """A short name with its digits as a subscript, a long one upright."""
    if name in _GREEK:
        return _tag("mi", _GREEK[name])
    if found := _SHORT.fullmatch(name):
        letter, below = found.groups()
        head = _tag("mi", letter)
        return head if below is None else _below(head, below.lstrip("_"))
    if (found := _WORD.fullmatch(name)) and found[1] in _GREEK:
        return _below(_tag("mi", _GREEK[found[1]]), found[2].lstrip("_"))
    return _tag("mi", name.replace("_", " "), mathvariant="normal")


def _below(head: Markup, below: str) -> Markup:
    return _tag("msub", head, _tag("mn" if below.isdecimal() else "mi", below))


def _node(node: Node) -> Markup:
    match node:
        case Number(value):
            return _tag("mn", f"{value:g}")
        case Name(name):
            return symbol(name)
        case Negative(operand):
            return _tag("mrow", _tag("mo", "−"), _inside(operand, _UNARY))
        case Binary("/", left, right):
            return _tag("mfrac", _tag("mrow", _node(left)), _tag("mrow", _node(right)))
        case Binary("**", left, right):
            base = _inside(left, _STRENGTH["**"] + 1)
            return _tag("msup", _tag("mrow", base), _tag("mrow", _node(right)))
        case Binary(sign, left, right):
            strength = _STRENGTH[sign]
            shown = {"*": "\N{INVISIBLE TIMES}", "-": "−"}.get(sign, sign)
            if sign == "*" and (isinstance(right, Number | Negative) or _is_word(left, right)):
                shown = "·"
            other = _inside(right, strength + (sign == "-"))
            room = {"·": "0.25em", "\N{INVISIBLE TIMES}": "0.12em"}.get(shown)
            mark = _tag("mo", shown, lspace=room, rspace=room)
            return Markup("").join((_inside(left, strength), mark, other))
        case Call("sqrt", (argument, *_)):
            return _tag("msqrt", _node(argument))
        case Call("abs", (argument, *_)):
            return _tag("mrow", _tag("mo", "|"), _node(argument), _tag("mo", "|"))
        case Call(function, arguments):
            name = _tag("mi", function, mathvariant="normal")
            inner = _tag("mo", ",").join(map(_node, arguments))
            return _tag("mrow", name, _tag("mo", "("), inner, _tag("mo", ")"))


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


def _inside(node: Node, strength: int) -> Markup:
    """The node, in parentheses if it binds less than `strength`."""
    own = 5
    if isinstance(node, Negative):
        own = _UNARY
    elif isinstance(node, Binary) and node.symbol != "/":
        own = _STRENGTH[node.symbol]
    inner = _node(node)
    return inner if own >= strength else _tag("mrow", _tag("mo", "("), inner, _tag("mo", ")"))


def _tag(name: str, *children: str, **attributes: str | None) -> Markup:
    """An element; attributes with None are left out."""
    given = [Markup(' {}="{}"').format(k, v) for k, v in attributes.items() if v is not None]
    parts = Markup("").join(given), Markup("").join(children)
    return Markup("<{0}{1}>{2}</{0}>").format(Markup(name), *parts)
