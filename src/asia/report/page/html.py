"""HTML as escaped values: formulas, numbers with their source in the ledger."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from html import escape
from typing import Any, Final

from matplotlib.figure import Figure

from asia._text import one_line, printable
from asia._timer import duration
from asia.errors import InternalError
from asia.ledger.evidence import FOLD_QUANTILE, interval_ends, jackknife_error
from asia.ledger.text import MOST_DECIMALS, error_value
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
from asia.report.drawing.inline import WIDE, svg_of

_VOID = frozenset({"meta", "br", "input"})


class Html(str):
    """Text that is HTML already."""

    __slots__ = ()


def tag(name: str, /, *children: str | None, **attributes: object) -> Html:
    """Write an element. Children that are not `Html` are escaped, None is left out. Attributes:
    `class_` is class, `data_from` is data-from, True has no value, None and False are left out.
    """
    words = [name]
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        plain = key.rstrip("_").replace("_", "-")
        words.append(plain if value is True else f'{plain}="{escape(printable(str(value)))}"')
    opening = f"<{' '.join(words)}>"
    if name in _VOID:
        return Html(opening)
    return Html(f"{opening}{join(children)}</{name}>")


def join(parts: Iterable[str | None], between: str = "") -> Html:
    """Concatenate parts; None is left out."""
    return Html(text(between).join(text(part) for part in parts if part is not None))


def text(part: str) -> Html:
    """The same, escaped unless it is `Html`."""
    return part if isinstance(part, Html) else Html(escape(printable(part), quote=False))


def said(words: str, most: int = 300) -> Html:
    """Quote a foreign text on one line: a name, a title, a text of an agent. The audit ignores its
    numbers.
    """
    return tag("span", one_line(words, most), class_="said")


def fixed(words: str) -> Html:
    """A number that belongs to the method, such as the level of an interval, and not to a
    result."""
    return tag("span", words, class_="fixed")


def region(element: str, *children: str | None, label: str, **attributes: object) -> Html:
    """An element that scrolls by itself, with a name for screen readers."""
    return tag(element, *children, **attributes, tabindex="0", role="region", aria_label=label)


def picture(draw: Callable[[], Figure], alt: str, width: float = WIDE) -> Html:
    """A picture, as wide as the page unless `width` in inches says otherwise; a wide one scrolls
    sideways where the page is narrow. alt: the picture in words."""
    svg = Html(svg_of(draw, alt, width))
    return tag("figure", region("div", svg, class_="wide", label=alt) if width == WIDE else svg)


def section(key: str, title: str, *inner: str | None) -> Html | None:
    """A part of a page with its heading; None without anything in it."""
    if all(part is None for part in inner):
        return None
    heading = f"h-{key}"
    return tag("section", tag("h2", title, id=heading), *inner, id=key, aria_labelledby=heading)


def table(head: Iterable[str], rows: Iterable[Iterable[str | None]], caption: str) -> Html:
    """A table that scrolls sideways where the page is narrow. The first column names the rows."""
    headings = [tag("th", cell, scope="col") for cell in head]
    body: list[Html] = []
    for row in rows:
        first, *others = ("" if cell is None else cell for cell in row)
        cells = [tag("th", first, scope="row"), *(tag("td", cell) for cell in others)]
        body.append(tag("tr", *cells))
    inner = tag(
        "table",
        tag("caption", said(caption)),
        tag("thead", tag("tr", *headings)),
        tag("tbody", *body),
    )
    return region("div", inner, class_="scroll", label=caption)


def facts(pairs: Iterable[tuple[str, str | None]]) -> Html:
    """Names and what they are; pairs with None are left out."""
    found = [join((tag("dt", k), tag("dd", v))) for k, v in pairs if v is not None]
    return tag("dl", *found, class_="facts")


# Equations as MathML, which browsers typeset by themselves.


_SHORT = re.compile(r"([A-Za-z])(\d+|_\w{1,3})?")
_WORD = re.compile(r"([A-Za-z]{2,}?)(\d+|_\w{1,3})")
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
    found: list[tuple[str, Html]] = []
    for kind, left, text in rows:
        right = formula(parse_expression(text, "physics"))
        line = tag("mrow", left, tag("mo", "="), right)
        found.append((kind, tag("math", line, display="block")))
    return tuple(found)


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
        return _below(tag("mi", _GREEK[found[1]]), found[2].lstrip("_"))
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
            return tag("mfrac", tag("mrow", _node(left)), tag("mrow", _node(right)))
        case Binary("**", left, right):
            base = _inside(left, _STRENGTH["**"] + 1)
            return tag("msup", tag("mrow", base), tag("mrow", _node(right)))
        case Binary(sign, left, right):
            strength = _STRENGTH[sign]
            shown = {"*": "\N{INVISIBLE TIMES}", "-": "−"}.get(sign, sign)
            if sign == "*" and (isinstance(right, Number | Negative) or _is_word(left, right)):
                shown = "·"
            other = _inside(right, strength + (sign == "-"))
            room = {"·": "0.25em", "\N{INVISIBLE TIMES}": "0.12em"}.get(shown)
            mark = tag("mo", shown, lspace=room, rspace=room)
            return join((_inside(left, strength), mark, other))
        case Call("sqrt", (argument, *_)):
            return tag("msqrt", _node(argument))
        case Call("abs", (argument, *_)):
            return tag("mrow", tag("mo", "|"), _node(argument), tag("mo", "|"))
        case Call(function, arguments):
            name = tag("mi", function, mathvariant="normal")
            inner = join(map(_node, arguments), tag("mo", ","))
            return tag("mrow", name, tag("mo", "("), inner, tag("mo", ")"))


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


def _inside(node: Node, strength: int) -> Html:
    """The node, in parentheses if it binds less than `strength`."""
    own = 5
    if isinstance(node, Negative):
        own = _UNARY
    elif isinstance(node, Binary) and node.symbol != "/":
        own = _STRENGTH[node.symbol]
    inner = _node(node)
    return inner if own >= strength else tag("mrow", tag("mo", "("), inner, tag("mo", ")"))


# Numbers that name where they stand in the ledger, and how they are made from it.
#
# A number on the page is an element with `data-from`, one or several sources as `SOURCE:PATH` with
# a blank between them, `data-rule`, what is made of them, and `data-as`, how the result is
# written:
#
# <data data-from="21:outcome.value" data-as="error">0.0264</data> <data data-from="3:outcome.value
# 21:outcome.value" data-rule="ratio" data-as="sig3">7.3</data>
#
# SOURCE is the sequence number of an event; the name of a kind of event, for all of them in order;
# or the sha256 of a JSON artifact. PATH has a dot before each name or index, and may end in
# `name=value`, which holds where the two are equal, or in `*` for all of a sequence.


ONE: Final = "one"

FORMS: Final[dict[str, Callable[[Any], str]]] = {
    "error": error_value,
    **{f"error{k}": partial(error_value, decimals=k) for k in range(5, MOST_DECIMALS + 1)},
    "sig2": lambda v: f"{v:.2g}",
    "sig3": lambda v: f"{v:.3g}",
    "sig4": lambda v: f"{v:.4g}",
    "sig5": lambda v: f"{v:.5g}",
    "signed_fixed3": lambda v: f"{v:+.3f}",
    "fixed2": lambda v: f"{v:.2f}",
    "percent": lambda v: f"{v:.1f} %",
    "share": lambda v: f"{100 * v:.1f} %",
    "signed_share": lambda v: f"{100 * v:+.1f} %",
    "signed_error": lambda v: f"{v:+.4f}" if 5e-5 <= abs(v) < 1e4 or v == 0 else f"{v:+.1e}",
    "micro": lambda v: f"{1e6 * v:.3g}",
    "times": lambda v: f"{v:.2g}" if v < 100 else f"{v:.0f}",
    "number": lambda v: f"#{v:02d}",
    "count": lambda v: f"{v:d}",
    "duration": duration,
    "dollars": lambda v: f"{v:.4f} USD",
    "text": str,
}
"""Formats of values."""


def _by_folds(values: Sequence[Any]) -> tuple[float, float]:
    """values: fitted, low, high, lower end of the range, then the value of each fold model."""
    value, low, high, lower = values[:4]
    wide = FOLD_QUANTILE * jackknife_error(value, values[4:])
    return interval_ends(value, low, high, lower, wide)


def _single(values: Sequence[Any]) -> Any:
    if len(values) != 1:
        raise ValueError(f"{len(values)} values where one is expected")
    return values[0]


RULES: Final[dict[str, Callable[[Sequence[Any]], Any]]] = {
    ONE: _single,
    "count": len,
    "sum": lambda v: math.fsum(v) if any(isinstance(x, float) for x in v) else sum(v),
    "least": min,
    "greatest": max,
    "ratio": lambda values: values[0] / values[1],
    "jackknife": lambda values: jackknife_error(values[0], values[1:]),
    "folds_low": lambda values: _by_folds(values)[0],
    "folds_high": lambda values: _by_folds(values)[1],
    "effect_low": lambda values: interval_ends(*values)[0],
    "effect_high": lambda values: interval_ends(*values)[1],
    "change": lambda values: (values[0] - values[1]) / values[1],
}
"""Functions that combine the values of the sources."""


def follow(value: Any, path: str) -> list[Any]:
    """Return the values at a path of nested mappings, sequences or dataclasses.

    A plain path gives one value; with `name=value` at the end, one or none; with `*` at the end,
    all of a sequence.

    Raises:
        KeyError: the path does not exist.
    """
    for step in path.split("."):
        if step == "*":
            return list(value)
        name, equals, expected = step.partition("=")
        if isinstance(value, dict):
            value = value[name]
        elif isinstance(value, list | tuple):
            value = value[int(name)]
        else:
            value = getattr(value, name)
        if equals:
            return [value] if str(value) == expected else []
    return [value]


def write_number(values: Sequence[Any], sources: str, rule: str, form: str) -> Html:
    """The element of a number. values: those of the sources, in their order."""
    try:
        result = RULES[rule](values)
        shown = FORMS[form](result)
    except (KeyError, TypeError, ValueError, IndexError, ArithmeticError) as error:
        raise InternalError(f"no number '{form}' of '{rule}' from {sources}: {error!r}") from error
    made = "" if rule == ONE else f", {rule}"
    return tag(
        "data",
        shown,
        value=result,
        data_from=sources,
        data_rule=None if rule == ONE else rule,
        data_as=form,
        title=f"ledger {sources}{made}",
    )
