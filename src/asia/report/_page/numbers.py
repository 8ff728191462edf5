"""Numbers that name where they stand in the ledger, and how they are made from it.

A number on the page is an element with `data-from`, one or several sources as `SOURCE:PATH` with a
blank between them, `data-rule`, what is made of them, and `data-as`, how the result is written:

    <data data-from="21:outcome.value" data-as="error">0.0264</data>
    <data data-from="3:outcome.value 21:outcome.value" data-rule="ratio" data-as="sig3">7.3</data>

SOURCE is the sequence number of an event; the name of a kind of event, for all of them in order;
`lock` for the problem's lock file; or the sha256 of a JSON artifact. PATH has a dot before each
name or index, and may end in `name=value`, which holds where the two are equal, or in `*` for all
of a sequence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Final

from asia._stopwatch import duration
from asia.errors import InternalError
from asia.ledger import FOLD_QUANTILE, error_value, interval_ends, jackknife_error
from asia.report._page.html import Html, tag

ONE: Final = "one"


def _text(value: Any) -> str:
    return str(value)


FORMS: Final[dict[str, Callable[[Any], str]]] = {
    "error": error_value,
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
    "times": lambda v: f"{v:.2g}" if v < 100 else f"{v:.0f}",
    "number": lambda v: f"#{v:02d}",
    "count": lambda v: f"{v:d}",
    "duration": duration,
    "dollars": lambda v: f"{v:.4f} USD",
    "text": _text,
    "short": lambda v: str(v)[:12],
}
"""Formats of values."""

RULES: Final[dict[str, Callable[[Sequence[Any]], Any]]] = {
    ONE: lambda values: values[0] if len(values) == 1 else _not_one(values),
    "count": len,
    "sum": lambda values: math.fsum(values) if _floats(values) else sum(values),
    "mean": lambda values: math.fsum(values) / len(values),
    "least": min,
    "most": max,
    "ratio": lambda values: values[0] / values[1],
    "difference": lambda values: values[0] - values[1],
    "jackknife": lambda values: jackknife_error(values[0], values[1:]),
    "folds_low": lambda values: _by_folds(values)[0],
    "folds_high": lambda values: _by_folds(values)[1],
    "effect_low": lambda values: interval_ends(*values)[0],
    "effect_high": lambda values: interval_ends(*values)[1],
    "change": lambda values: (values[0] - values[1]) / values[1],
}
"""Functions that combine the values of the sources."""


def _floats(values: Sequence[Any]) -> bool:
    return any(isinstance(value, float) for value in values)


def _by_folds(values: Sequence[Any]) -> tuple[float, float]:
    """values: fitted, low, high, lower end of the range, then the value of each fold model."""
    value, low, high, lower = values[:4]
    wide = FOLD_QUANTILE * jackknife_error(value, values[4:])
    return interval_ends(value, low, high, lower, wide)


def _not_one(values: Sequence[Any]) -> Any:
    raise ValueError(f"{len(values)} values where one is expected")


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
