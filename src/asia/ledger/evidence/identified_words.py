"""Identified model as lines of text and as an object for scripts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from asia._text import one_line
from asia.ledger.evidence.parameters import IdentifiedModel, IdentifiedParameter
from asia.scoring.dossier.records import listed

_MOST_PAIRS = 5


def identified_lines(found: IdentifiedModel, *, equations: bool = True) -> Iterator[str]:
    """Yield the equations with their numbers, one row a parameter, and the parameters that cannot
    be distinguished.
    """
    if found.equations and equations:
        yield "equations with the fitted numbers:"
        yield from (f"  {one_line(line, 600)}" for line in found.equations)
    if not found.parameters:
        return
    yield "parameters, fitted to all training records:"
    rows = [_row(one) for one in found.parameters]
    heads = ("", "value", "unit", "s.e.", "s.e. by folds", "95 % interval", "decided by", "")
    widths = [max(len(row[k]) for row in (heads, *rows)) for k in range(len(heads))]
    for row in (heads, *rows):
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        yield f"  {'  '.join(cells).rstrip()}"
    yield from (f"  {line}" for line in disagreement_lines(found))
    for first, second, rho in found.entangled[:_MOST_PAIRS]:
        yield (
            f"  the errors of {second} and {first} have correlation {rho:+.3f}: the records "
            f"hardly distinguish the two"
        )
    if len(found.entangled) > _MOST_PAIRS:
        yield f"  ... {len(found.entangled) - _MOST_PAIRS} more such pairs"


def disagreement_lines(found: IdentifiedModel) -> Iterator[str]:
    """Why an interval is wider than noise makes it."""
    apart = found.disagreeing
    if apart:
        verb = "differs" if len(apart) == 1 else "differ"
        yield (
            f"{listed(apart)} {verb} significantly between the folds: the system "
            "drifts, or an effect is missing"
        )
    if any(one.fitted.misfit_error > 0 for one in found.parameters):
        yield (
            "the residuals are correlated with the input: an effect is missing, and the intervals "
            "include the bias that it may cause"
        )


def identified_object(found: IdentifiedModel) -> dict[str, Any]:
    """The same for scripts: `parameters`, `correlation`, `equations`, `remarks`."""
    return {
        "parameters": [_object(one) for one in found.parameters],
        "correlation": [list(row) for row in found.correlation],
        "equations": list(found.equations),
        "remarks": list(disagreement_lines(found)),
    }


def _row(one: IdentifiedParameter) -> tuple[str, ...]:
    fitted, ends = one.fitted, one.interval
    return (
        fitted.name,
        f"{fitted.value:.5g}",
        fitted.unit,
        _figure(fitted.standard_error),
        _figure(one.fold_error),
        "" if ends is None else f"{ends[0]:.4g} to {ends[1]:.4g}",
        "" if ends is None else one.decided_by,
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
        "interval_95": None if one.interval is None else list(one.interval),
        "decided_by": None if one.interval is None else one.decided_by,
        "range": [fitted.lower, fitted.upper],
        "at_bound": fitted.at_bound or None,
        "identifiable": fitted.identifiable,
        "data_share": fitted.data_share,
        "folds": list(one.folds),
        "standard_error_by_folds": one.fold_error,
        "folds_disagree": one.disagrees,
        "missing_effect_error": fitted.misfit_error,
    }
