"""The winner: equations or structure, and its code."""

from __future__ import annotations

from asia.ledger import Experiment
from asia.report._page.code import python
from asia.report._page.formulas import equations
from asia.report._page.html import Html, facts, join, said, tag
from asia.report._page.section import Section
from asia.report._page.subject import Subject


def _write(subject: Subject) -> Html | None:
    best = subject.view.best
    if best is None:
        return None
    p = best.proposed
    structure = facts(
        (
            ("candidate", join((subject.name(best), " ", said(p.title)))),
            ("family", said(p.family)),
            ("idea", said(p.hypothesis, 600)),
        )
    )
    return join((structure, _equations(subject, best), _source(subject, best)))


def _equations(subject: Subject, best: Experiment) -> Html | None:
    physics = subject.problem.physics if subject.problem else None
    if physics is None:
        return None
    rows = [
        tag("div", tag("span", kind, class_="kind"), formula, class_="equation")
        for kind, formula in equations(physics)
    ]
    text = "The equations that the problem gives. The code of the winner shows its additions."
    return join(
        (
            tag("h3", "Equations"),
            tag("p", text),
            tag(
                "div",
                *rows,
                class_="equations",
                tabindex="0",
                role="region",
                aria_label="equations",
            ),
        )
    )


def _source(subject: Subject, best: Experiment) -> Html | None:
    store = subject.run.store
    if not store.kept:
        return tag("p", "The code is missing, because the run has no artifacts.")
    source = store.text(best.proposed.source)
    long = source.count("\n") > 40
    block = python(source, "candidate.py of the winner")
    return join(
        (
            tag("h3", "Code"),
            tag("details", tag("summary", "candidate.py"), block, open=not long),
        )
    )


SECTION = Section("model", "The model", _write)
