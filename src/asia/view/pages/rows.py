"""The list of experiments: short rows, the last one first."""

from __future__ import annotations

from asia.ledger import Experiment
from asia.report.pieces import Html, Subject, join, said, tag
from asia.view.pages.frame import run_address

CHUNK = 50
"""Rows of a part of the list; the browser lays out those parts alone that are seen."""
FIRST = 300
"""Rows that a page begins with; the rest is asked for where the list is scrolled to."""
MOST = 3000
"""Rows of one answer."""


def experiment_row(subject: Subject, e: Experiment) -> Html:
    """Write one experiment on one line."""
    status = e.result.status if e.result else "running"
    link = tag(
        "a",
        tag("span", subject.name(e), class_="id"),
        tag("span", said(e.proposed.title, 120), class_="what"),
        tag("span", status, class_=f"status {status}"),
        tag("span", subject.v(e) if e.score else "", class_="value"),
        href=f"{run_address(subject.run.name)}/experiments/{e.number}",
    )
    kind = "kept" if e.kept else "failed" if e.failure is not None else "other"
    return tag("li", link, id=f"e{e.number}", class_=kind)


def experiment_rows(subject: Subject, before: int | None = None, most: int = FIRST) -> Html:
    """The last `most` experiments, or those before a number, in parts; with a button for the
    earlier ones."""
    every = [e for e in subject.view.experiments if before is None or e.number < before]
    shown = every[: -min(most, MOST) - 1 : -1]
    parts = [shown[k : k + CHUNK] for k in range(0, len(shown), CHUNK)]
    lists = [
        tag(
            "ol",
            *(experiment_row(subject, e) for e in part),
            class_="part",
            style=f"--rows:{len(part)}",
            data_first=part[-1].number,
        )
        for part in parts
    ]
    earlier = None
    if len(every) > len(shown):
        text = f"Show those before #{shown[-1].number}"
        earlier = tag("button", text, type="button", class_="earlier", data_before=shown[-1].number)
    return join((*lists, earlier))
