"""What was identified, in lines of text and as an object for scripts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from asia._text import one_line
from asia.ledger.evidence.parameters import IdentifiedModel, IdentifiedParameter

_MOST_PAIRS = 5


def identified_lines(found: IdentifiedModel) -> Iterator[str]:
    """The equations with their numbers, a row a parameter, and what cannot be told apart."""
    if found.equations:
        yield "equations with the fitted numbers:"
        yield from (f"  {one_line(line, 600)}" for line in found.equations)
    if not found.parameters:
        return
    yield "parameters, fitted to all training records:"
    rows = [_row(one) for one in found.parameters]
    heads = ("", "value", "unit", "s.e.", "95 % interval", "s.e. by folds", "")
    widths = [max(len(row[k]) for row in (heads, *rows)) for k in range(len(heads))]
    for row in (heads, *rows):
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        yield f"  {'  '.join(cells).rstrip()}"
    for first, second, rho in found.entangled[:_MOST_PAIRS]:
        yield (
            f"  the errors of {second} and {first} have correlation {rho:+.3f}: the records tell "
            "the two apart badly"
        )
    if len(found.entangled) > _MOST_PAIRS:
        yield f"  ... {len(found.entangled) - _MOST_PAIRS} more pairs like that"


def identified_object(found: IdentifiedModel) -> dict[str, Any]:
    """The same for scripts: `parameters`, `correlation`, `equations`."""
    return {
        "parameters": [_object(one) for one in found.parameters],
        "correlation": [list(row) for row in found.correlation],
        "equations": list(found.equations),
    }


def _row(one: IdentifiedParameter) -> tuple[str, ...]:
    fitted = one.fitted
    interval = ""
    if fitted.low is not None and fitted.high is not None:
        interval = f"{fitted.low:.4g} to {fitted.high:.4g}"
    return (
        fitted.name,
        f"{fitted.value:.5g}",
        fitted.unit,
        _figure(fitted.standard_error),
        interval,
        _figure(one.fold_error),
        _remark(one),
    )


def _remark(one: IdentifiedParameter) -> str:
    fitted = one.fitted
    remarks = [] if fitted.identifiable else ["not identifiable from these records"]
    if fitted.at_bound:
        end = fitted.lower if fitted.at_bound == "lower" else fitted.upper
        remarks.append(f"at the {fitted.at_bound} end of its range, {end:g}")
    return "; ".join(remarks)


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.2g}"


def _object(one: IdentifiedParameter) -> dict[str, Any]:
    fitted = one.fitted
    return {
        "name": fitted.name,
        "value": fitted.value,
        "unit": fitted.unit,
        "standard_error": fitted.standard_error,
        "interval_95": None if fitted.low is None else [fitted.low, fitted.high],
        "range": [fitted.lower, fitted.upper],
        "at_bound": fitted.at_bound or None,
        "identifiable": fitted.identifiable,
        "data_share": fitted.data_share,
        "folds": list(one.folds),
        "standard_error_by_folds": one.fold_error,
    }
