"""Identified parameters and equations of a model."""

from collections.abc import Iterator, Sequence
from typing import Any

from asia._statement import NOT_IDENTIFIABLE, UNSETTLED, fit_note
from asia._text import one_line
from asia.judge.scoring.checks.validation_data import listed
from asia.ledger.evidence import IdentifiedModel, IdentifiedParameter
from asia.presentation.table import Block, Listing, Table

_MOST_PAIRS = 5


def identified_blocks(found: IdentifiedModel, *, equations: bool = True) -> Iterator[Block]:
    """Yield equations, the table of the parameters, and what limits their use."""
    if found.equations and equations:
        title = "equations in the candidate's own words, not checked by ASIA"
        if found.library:
            title = "equations of the best candidate with the fitted numbers"
        yield Listing(title, [one_line(line, 600) for line in found.equations])
    if not found.parameters:
        return
    yield parameter_table(found)
    alike: dict[str, list[str]] = {}
    for one in found.parameters:
        fitted = one.fitted
        for remark in parameter_remarks(found, one):
            end = fitted.lower if fitted.at_bound == "lower" else fitted.upper
            reached = f" ({end:g})" if "end of its range" in remark else ""
            alike.setdefault(remark, []).append(f"{fitted.name}{reached}")
    yield from (f"{remark}: {', '.join(names)}" for remark, names in alike.items())
    if any(remark == NOT_IDENTIFIABLE for remark in alike):
        yield (
            "other values of these simulate the records nearly as well: the verdict is on the "
            "simulation, not on them"
        )
    if any(one.interval is not None for one in found.parameters):
        yield (
            "each interval is the widest of three: by the noise, by the spread of the fold models, "
            "and by a missing effect"
        )
    yield from interval_lines(found)
    pairs = [(f"{second} and {first}", rho) for first, second, rho in found.entangled]
    if pairs:
        caption = "hardly distinguished by the records"
        if len(pairs) > _MOST_PAIRS:
            caption += f", and {len(pairs) - _MOST_PAIRS} more pairs"
        columns = {"pair": "", "correlation of the errors": "signed"}
        yield Table(caption, columns, pairs[:_MOST_PAIRS])


def parameter_table(found: IdentifiedModel) -> Table:
    """Return the values of the parameters with their uncertainty."""
    own = "" if found.library else ", as the candidate's own code reports them"
    columns = {
        "parameter": "", "value": "sig:5", "unit": "", "std. error": "sig:2", "by folds": "",
        "95 % interval": "", "decided by": "",
    }  # fmt: skip
    rows: list[tuple[str | float | None, ...]] = []
    for one in found.parameters:
        fitted, ends = one.fitted, one.interval
        quoted = (None, None)
        if ends is not None:
            quoted = f"{ends[0]:.4g} to {ends[1]:.4g}", one.decided_by
        error, name = fitted.standard_error, fitted.name
        rows.append((name, fitted.value, fitted.unit, error, _fold_text(one), *quoted))
    return Table(f"parameters, {found.source}{own}", columns, rows)


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


def _fold_text(one: IdentifiedParameter) -> str:
    """Standard error by the folds; of an order or a delay the whole numbers of the fold models."""
    if one.folds and one.is_count:
        low, high = min(one.folds), max(one.folds)
        return f"{low:g}" if low == high else f"{low:g} to {high:g}"
    return "" if one.fold_error is None else f"{one.fold_error:.2g}"


def disagreement_text(apart: Sequence[str]) -> str:
    """Say what it means that the fold models disagree on some parameters."""
    return (
        f"significantly different between the folds: {listed(apart)}; the system drifts, or an "
        "effect is missing"
    )


def interval_lines(found: IdentifiedModel) -> Iterator[str]:
    """Why there is no interval, or why one is wider than noise makes it, and a poor fit."""
    if found.parameters and (note := fit_note(found.fit)):
        yield note
    if found.reason:
        yield f"no standard errors and intervals: {one_line(found.reason, 400)}"
    apart = found.disagreeing
    if apart:
        yield disagreement_text(apart)
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
