"""The equations and parameters of the winner, fitted to all training records."""

from __future__ import annotations

from asia._text import one_line
from asia.ledger import EstimatedParameter, IdentifiedModel, Run, identified
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
    rows = [_row(run, k, one.fitted) for k, one in enumerate(found.parameters)]
    head = ["parameter", "value", "unit", "standard error", "interval", "remark"]
    words = tag(
        "p",
        "The intervals are those of ",
        fixed("95 %"),
        ". They describe the noise, and say nothing of an equation that is wrong. The standard "
        "errors by folds are in ",
        tag("code", f"asia show {run.name}"),
        ".",
    )
    return join((table(head, rows, "Parameters, fitted to all training records"), words))


def _row(run: Run, place: int, one: EstimatedParameter) -> list[str | None]:
    at = f"parameters.{place}"
    interval = None
    if one.low is not None and one.high is not None:
        ends = (_number(run, f"{at}.low", one.low, "sig4"),
                _number(run, f"{at}.high", one.high, "sig4"))  # fmt: skip
        interval = join(ends, " to ")
    error = one.standard_error
    return [
        said(one.name),
        _number(run, f"{at}.value", one.value, "sig5"),
        said(one.unit),
        None if error is None else _number(run, f"{at}.standard_error", error, "sig2"),
        interval,
        _remark(one),
    ]


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
    return table(["pair", "correlation of the errors"], rows, "Told apart badly by the records")


def _number(run: Run, path: str, value: float, form: str) -> Html:
    """A number of the artifact that the record of the refit names."""
    assert run.view.refitted is not None
    return write_number([value], f"{run.view.refitted.estimates}:{path}", ONE, form)


SECTION = Section("identified", "What was identified", _write)
