"""Identified parameters and equations of a model."""

from collections.abc import Iterator
from typing import Any

from asia._statement import NOT_IDENTIFIABLE, UNSETTLED, fit_note
from asia._text import one_line
from asia.judge.scoring.checks.validation_data import listed
from asia.ledger.evidence import IdentifiedModel, IdentifiedParameter

_MOST_PAIRS = 5


def identified_lines(found: IdentifiedModel, *, equations: bool = True) -> Iterator[str]:
    """Yield equations, one row a parameter, and parameters that cannot be distinguished."""
    if found.equations and equations:
        yield (
            "equations with the fitted numbers:"
            if found.library
            else "equations in the candidate's own words, not checked by ASIA:"
        )
        yield from (f"  {one_line(line, 600)}" for line in found.equations)
    if not found.parameters:
        return
    own = "" if found.library else ", as the candidate's own code reports them"
    yield f"parameters, {found.source}{own}:"
    heads = "", "value", "unit", "std. error", "by folds", "95 % interval", "decided by"
    columns = [*zip(*(_parameter_row(one) for one in found.parameters), strict=True)]
    table = [(head, *cells) for head, cells in zip(heads, columns, strict=True) if any(cells)]
    padded = [[cell.ljust(max(map(len, column))) for cell in column] for column in table]
    yield from (f"  {'  '.join(row).rstrip()}" for row in zip(*padded, strict=True))
    alike: dict[str, list[str]] = {}
    for one in found.parameters:
        fitted = one.fitted
        for remark in parameter_remarks(found, one):
            end = fitted.lower if fitted.at_bound == "lower" else fitted.upper
            reached = f" ({end:g})" if "end of its range" in remark else ""
            alike.setdefault(remark, []).append(f"{fitted.name}{reached}")
    yield from (f"  {remark}: {', '.join(names)}" for remark, names in alike.items())
    if any(remark == NOT_IDENTIFIABLE for remark in alike):
        yield (
            "  other values of these simulate the records nearly as well: the verdict is on the "
            "simulation, not on them"
        )
    yield from (f"  {line}" for line in interval_lines(found))
    for first, second, rho in found.entangled[:_MOST_PAIRS]:
        yield (
            f"  the errors of {second} and {first} have correlation {rho:+.3f}: the records "
            f"hardly distinguish the two"
        )
    if len(found.entangled) > _MOST_PAIRS:
        yield f"  ... {len(found.entangled) - _MOST_PAIRS} more such pairs"


def parameter_remarks(found: IdentifiedModel, one: IdentifiedParameter) -> Iterator[str]:
    """Why to distrust the value of a parameter."""
    fitted, ends = one.fitted, one.interval
    wide = one.statement.reason == NOT_IDENTIFIABLE
    if wide or not (fitted.identifiable or found.reason):
        yield NOT_IDENTIFIABLE
    elif one.statement.reason == UNSETTLED:
        yield UNSETTLED
    elif ends is not None and ends[1] - ends[0] > abs(fitted.value):
        yield "interval wider than the value"
    if fitted.at_bound:
        yield f"at the {fitted.at_bound} end of its range"


def _parameter_row(one: IdentifiedParameter) -> tuple[str, ...]:
    fitted, ends = one.fitted, one.interval
    return (
        fitted.name,
        f"{fitted.value:.5g}",
        fitted.unit,
        "" if fitted.standard_error is None else f"{fitted.standard_error:.2g}",
        fold_text(one),
        "" if ends is None else f"{ends[0]:.4g} to {ends[1]:.4g}",
        "" if ends is None else one.decided_by,
    )


def fold_text(one: IdentifiedParameter) -> str:
    """Standard error by the folds; of an order or a delay the whole numbers of the fold models."""
    if one.folds and one.is_count:
        low, high = min(one.folds), max(one.folds)
        return f"{low:g}" if low == high else f"{low:g} to {high:g}"
    return "" if one.fold_error is None else f"{one.fold_error:.2g}"


def interval_lines(found: IdentifiedModel) -> Iterator[str]:
    """Why there is no interval, or why one is wider than noise makes it, and a poor fit."""
    if found.parameters and (note := fit_note(found.fit)):
        yield note
    if found.reason:
        yield f"no standard errors and intervals: {one_line(found.reason, 400)}"
    apart = found.disagreeing
    if apart:
        verb = "differs" if len(apart) == 1 else "differ"
        yield (
            f"{listed(apart)} {verb} significantly between the folds: the system "
            "drifts, or an effect is missing"
        )
    if any(one.fitted.misfit_error > 0 for one in found.parameters):
        wider = any(one.decided_by == "missing effect" for one in found.parameters)
        yield "the training residuals follow the sensitivities: an effect is missing, " + (
            "and the intervals include the bias that it may cause"
            if wider
            else "but the bias that it may cause is smaller than the intervals"
        )


def identified_object(found: IdentifiedModel) -> dict[str, Any]:
    """Return the same for scripts: `parameters`, `correlation`, `equations`, `remarks`, and
    `reported_by`: `library` for ASIA's model library, `candidate` for other code."""
    return {
        "parameters": [
            {
                "name": one.fitted.name,
                "value": one.fitted.value,
                "unit": one.fitted.unit,
                "standard_error": one.fitted.standard_error,
                "interval_95": None if one.interval is None else list(one.interval),
                "decided_by": None if one.interval is None else one.decided_by,
                "range": [one.fitted.lower, one.fitted.upper],
                "at_bound": one.fitted.at_bound or None,
                "identifiable": one.fitted.identifiable,
                "data_share": one.fitted.data_share,
                "folds": list(one.folds),
                "standard_error_by_folds": one.fold_error,
                "folds_disagree": one.disagrees,
                "missing_effect_error": one.fitted.misfit_error,
            }
            for one in found.parameters
        ],
        "correlation": [list(row) for row in found.correlation],
        "equations": list(found.equations),
        "reported_by": "library" if found.library else "candidate",
        "source": found.source,
        "no_intervals": found.reason or None,
        "remarks": list(interval_lines(found)),
    }
