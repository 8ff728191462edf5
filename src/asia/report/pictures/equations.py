"""Picture of a problem's equations, set as formulas."""

import re
from collections.abc import Callable, Iterator
from typing import Any

import sympy
from matplotlib.figure import Figure
from sympy.printing.latex import greek_letters_set, latex

from asia.problem.physics import MEMORY, Physics, parse_expression
from asia.report.drawing.style import INK, QUIET, picture_width

_SHORT_NAME = re.compile(r"[A-Za-z]{1,2}\d*(_\w{1,3})?")
_WHOLE_FLOAT = re.compile(r"(?<![\d.])(\d+)\.0(?!\d)")
_ROW = 0.42
_TOP = 0.35

_RENAMED = {"arcsin": "asin", "arccos": "acos", "arctan": "atan", "arctan2": "atan2", "abs": "Abs"}
_KNOWN = [
    "sqrt",
    "exp",
    "log",
    "sin",
    "cos",
    "tan",
    "arcsin",
    "arccos",
    "arctan",
    "arctan2",
    "sinh",
    "cosh",
    "tanh",
    "abs",
    "sign",
]
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: getattr(sympy, _RENAMED.get(name, name)) for name in _KNOWN},
    **{
        name: sympy.Function(name)
        for name in ("sigmoid", "softplus", "min", "max", "clip", *MEMORY)
    },
}


def draw_equations(physics: Physics) -> Figure:
    """Definitions, dynamics, observation and bounds, one a row."""
    rows = list(_rows(physics))
    height = _TOP + _ROW * len(rows)
    figure = Figure(figsize=(picture_width(), height))
    for i, (kind, formula) in enumerate(rows):
        y = 1 - (_TOP + _ROW * (i + 0.3)) / height
        figure.text(0.02, y, kind, color=QUIET, va="center")
        figure.text(0.2, y, f"${formula}$", color=INK, va="center", fontsize=11, parse_math=True)
    figure.text(0.02, 1 - 0.18 / height, "Equations as understood", weight="bold", va="center")
    return figure


def _rows(physics: Physics) -> Iterator[tuple[str, str]]:
    for name, text in physics.definitions.items():
        yield "definition", f"{_symbol(name)} = {typeset(text)}"
    for name in physics.states:
        yield "dynamics", rf"\frac{{d}}{{dt}}\,{_symbol(name)} = {typeset(physics.dynamics[name])}"
    for name, text in physics.observation.items():
        yield "output", rf"{_symbol(name)} = {typeset(text)}"
    for name, bound in physics.bounds.items():
        low = "" if bound.min is None else rf"{bound.min:g} \leq "
        high = "" if bound.max is None else rf" \leq {bound.max:g}"
        yield "bounds", f"{low}{_symbol(name)}{high}"


def typeset(text: str) -> str:
    """Convert a physics expression to LaTeX, with terms and factors in the order of the problem
    file.
    """
    expression = parse_expression(text, "physics", memory=True)
    values = {name: sympy.Symbol(name) for name in expression.names}
    with sympy.evaluate(False):
        formula = _flat(sympy.sympify(expression.evaluate(values, _FUNCTIONS)))
    names = {symbol: _symbol(name) for name, symbol in values.items()}
    text = str(latex(formula, order="none", full_prec=False, symbol_names=names, mul_symbol=r"\,"))
    return _WHOLE_FLOAT.sub(r"\1", text)


def _flat(formula: Any) -> Any:
    """Sums of sums and products of products as one, so that they need no parentheses."""
    if not formula.args:
        return formula
    parts: list[Any] = []
    for part in map(_flat, formula.args):
        nested = formula.func in (sympy.Add, sympy.Mul) and part.func is formula.func
        parts += part.args if nested else [part]
    return formula.func(*parts, evaluate=False)


def _symbol(name: str) -> str:
    """Short names as symbols with subscripts, words upright."""
    letter, _, below = name.partition("_")
    is_greek = letter.lower() in greek_letters_set and len(below) <= 3
    if _SHORT_NAME.fullmatch(name) or is_greek:
        return str(latex(sympy.Symbol(name)))
    return rf"\mathrm{{{name.replace('_', chr(92) + '_')}}}"
