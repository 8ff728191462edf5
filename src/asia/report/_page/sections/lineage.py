"""Section of the lineage: the parent of each candidate."""

from __future__ import annotations

from asia.ledger import Experiment
from asia.report._page.html import Html, join, said, tag
from asia.report._page.section import Section
from asia.report._page.subject import Subject
from asia.report._page.svg.lanes import Kin, draw_lanes


def _write(subject: Subject) -> Html | None:
    shown = subject.told
    if len(shown) < 2 or all(e.proposed.parent is None for e in shown):
        return None
    rows = [
        Kin(
            e.number,
            e.proposed.parent,
            e.result.status if e.result else "running",
            e.number in subject.lineage,
        )
        for e in shown
    ]
    drawing, width = draw_lanes(rows)
    items = [tag("li", *_row(subject, e), class_=_name(subject, e)) for e in shown]
    text = "The thick line leads from the first candidate to the winner."
    listed = tag("ol", *items, style=f"padding-left:{width}px")
    return join((tag("p", text), tag("div", drawing, listed, class_="lineage")))


def _row(subject: Subject, e: Experiment) -> list[Html | str]:
    parts: list[Html | str] = [
        tag("a", subject.name(e), " ", said(e.proposed.title, 80), href=f"#e{e.number}")
    ]
    if e.proposed.parent is not None:
        source = subject.number(e.proposed, "parent", "number")
        parts.append(tag("span", " made from ", source, class_="unseen"))
    shown = subject.v(e) if e.score else (e.result.status if e.result else "running")
    parts.append(tag("span", shown, class_="value"))
    return parts


def _name(subject: Subject, e: Experiment) -> str | None:
    return "won" if e.number in subject.lineage else None


SECTION = Section("lineage", "Lineage", _write)
