"""The equations and parameters of the winner, fitted to all training records."""

from __future__ import annotations

from collections.abc import Sequence

from asia._text import one_line
from asia.ledger import (
    EstimatedParameter,
    IdentifiedModel,
    IdentifiedParameter,
    Run,
    disagreement_lines,
    get_findings,
    identified,
)
from asia.report._page.html import Html, fixed, join, said, table, tag
from asia.report._page.numbers import ONE, write_number
from asia.report._page.section import Section
from asia.report._page.subject import Subject

_MOST_PAIRS = 5
_LONGEST = 600


def _write(subject: Subject) -> Html | None:
    found = identified(subject.run)
    if found is None or not (found.equations or found.parameters):
        return None
    return join(
        (_equations(found), _parameters(subject.run, found), _entangled(subject.run, found))
    )


def _equations(found: IdentifiedModel) -> Html | None:
    if not found.equations:
        return None
    lines = "\n".join(one_line(line, _LONGEST) for line in found.equations)
    return join((tag("p", "The equations of the winner, with the fitted numbers:"),
                 tag("pre", tag("code", lines), tabindex="0")))  # fmt: skip


def _parameters(run: Run, found: IdentifiedModel) -> Html | None:
    if not found.parameters:
        return None
    rows = [_row(run, k, one) for k, one in enumerate(found.parameters)]
    head = ["parameter", "value", "unit", "standard error", "standard error by folds", "interval",
            "decided by", "remark"]  # fmt: skip
    text = tag(
        "p",
        "The intervals are those of ",
        fixed("95 %"),
        ": the widest of what noise, the spread of the fold models, and a missing effect that the "
        "residuals show would give.",
    )
    apart = [tag("p", tag("b", said(line), ".")) for line in disagreement_lines(found)]
    return join((table(head, rows, "Parameters, fitted to all training records"), *apart, text))


def _row(run: Run, place: int, one: IdentifiedParameter) -> list[str | None]:
    at, fitted, error = f"parameters.{place}", one.fitted, one.fitted.standard_error
    return [
        said(fitted.name),
        _number(run, f"{at}.value", fitted.value, "sig5"),
        said(fitted.unit),
        None if error is None else _number(run, f"{at}.standard_error", error, "sig2"),
        None
        if one.fold_error is None
        else _of_folds(run, one, [f"{at}.value"], [fitted.value], "jackknife", "sig2"),
        _interval(run, at, one),
        None if one.interval is None else one.decided_by,
        _remark(fitted),
    ]


def _interval(run: Run, at: str, one: IdentifiedParameter) -> Html | None:
    fitted = one.fitted
    if one.interval is None or fitted.low is None or fitted.high is None:
        return None
    paths = [f"{at}.{name}" for name in ("value", "low", "high", "lower")]
    values = [fitted.value, fitted.low, fitted.high, fitted.lower]
    ends: list[Html] = []
    for place, end in enumerate(("low", "high"), 1):
        if one.decided_by == "folds":
            ends.append(_of_folds(run, one, paths, values, f"folds_{end}", "sig4"))
        elif one.decided_by == "missing effect":
            sources = _sources(run, [*paths, f"{at}.misfit_error"])
            every = [*values, fitted.misfit_error]
            ends.append(write_number(every, sources, f"effect_{end}", "sig4"))
        else:
            ends.append(write_number([values[place]], _sources(run, [paths[place]]), ONE, "sig4"))
    return join(ends, " to ")


def _of_folds(
    run: Run, one: IdentifiedParameter, paths: Sequence[str], values: Sequence[float | None],
    rule: str, form: str,
) -> Html:  # fmt: skip
    """A number of the refit and of the fold models."""
    refitted = run.view.refitted
    assert refitted is not None
    result = run.view.experiment(refitted.experiment).result
    assert result is not None
    sources = [_sources(run, paths)]
    for fold in result.folds:
        if fold.findings is not None:
            names = [name for name, _ in get_findings(run.store, fold.findings).parameters]
            sources.append(f"{fold.findings}:parameters.{names.index(one.fitted.name)}.1")
    return write_number([*values, *one.folds], " ".join(sources), rule, form)


def _sources(run: Run, paths: Sequence[str]) -> str:
    """Places in the artifact that the record of the refit names."""
    assert run.view.refitted is not None
    return " ".join(f"{run.view.refitted.estimates}:{path}" for path in paths)


def _remark(one: EstimatedParameter) -> str:
    remarks = [] if one.identifiable else ["not identifiable from these records"]
    if one.at_bound:
        remarks.append(f"at the {one.at_bound} end of its range")
    return "; ".join(remarks)


def _entangled(run: Run, found: IdentifiedModel) -> Html | None:
    names = [one.fitted.name for one in found.parameters]
    rows = [
        [
            join((said(a), " and ", said(b))),
            _number(run, f"correlation.{names.index(a)}.{names.index(b)}", rho, "signed_fixed3"),
        ]
        for a, b, rho in found.entangled[:_MOST_PAIRS]
    ]
    if not rows:
        return None
    return table(["pair", "correlation of the errors"], rows, "Poorly distinguished by the records")


def _number(run: Run, path: str, value: float, form: str) -> Html:
    return write_number([value], _sources(run, [path]), ONE, form)


SECTION = Section("identified", "Identified parameters", _write)
