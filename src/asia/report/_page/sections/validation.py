"""Section of the validation: objections against the use of the model."""

from __future__ import annotations

from typing import Final

from asia.ledger import DrawnCheck, Validated, get_curves
from asia.report._page.html import Html, join, said, tag
from asia.report._page.section import Section, used_no_test
from asia.report._page.subject import Subject
from asia.report._page.svg.panel import draw_panel
from asia.scoring.dossier import Verdict

_KINDS: Final = {Verdict.PASS: "good", Verdict.DOUBT: "doubt", Verdict.FAIL: "none"}
_LOGARITHMIC: Final = frozenset({"frequency response", "error spectrum"})


def _write(subject: Subject) -> Html | None:
    found = subject.view.validated
    return join([_report(subject, one) for one in found]) if found else None


def _report(subject: Subject, found: Validated) -> Html:
    title = "On the held-out data"
    if found.record:
        title = join(("On the new record ", said(found.record)))
    counts = tag(
        "p",
        "Checks that pass: ",
        subject.number(found, "passed", "count"),
        "; in doubt: ",
        subject.number(found, "doubtful", "count"),
        "; that fail: ",
        subject.number(found, "failed", "count"),
        ". What was checked is the ",
        found.model,
        " of experiment ",
        subject.number(found, "experiment", "number"),
        ".",
    )
    after = used_no_test(found.after_unsealing)
    return join(
        (tag("h3", title), counts, _worst(subject, found), after, _table(subject, found),
         _pictures(subject, found))
    )  # fmt: skip


def _worst(subject: Subject, found: Validated) -> Html | None:
    for k, one in enumerate(found.checks):
        if one.name == found.worst:
            text = subject.number(found, f"checks.{k}.sentence", "text")
            return tag("p", tag("b", "Most important: "), text, ".", class_="sentence")
    return None


def _table(subject: Subject, found: Validated) -> Html:
    rows = [
        tag(
            "tr",
            tag("th", one.name, scope="row"),
            tag("td", tag("span", str(one.verdict), class_=f"stamp small {_kind(one.verdict)}")),
            tag("td", subject.number(found, f"checks.{k}.sentence", "text")),
        )
        for k, one in enumerate(found.checks)
    ]
    head = [tag("th", text, scope="col") for text in ("check", "verdict", "finding")]
    inner = tag(
        "table",
        tag("caption", "Validation checks"),
        tag("thead", tag("tr", *head)),
        tag("tbody", *rows),
    )
    label = f"Validation checks, {found.record or 'held-out parts'}"
    return tag("div", inner, class_="scroll dossier", tabindex="0", role="region", aria_label=label)


def _kind(verdict: Verdict) -> str:
    return _KINDS.get(verdict, "shown")


def _pictures(subject: Subject, found: Validated) -> Html | None:
    if not subject.run.store.kept:
        return None
    drawn: tuple[DrawnCheck, ...] = get_curves(subject.run.store, found.curves)
    panels = [draw_panel(one, log=one.name in _LOGARITHMIC) for one in drawn]
    return tag("div", *panels, class_="grid") if panels else None


SECTION = Section("validation", "Validation", _write)
