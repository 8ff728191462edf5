"""V of every experiment."""

from __future__ import annotations

from collections.abc import Sequence

from asia.ledger import Experiment, error_value
from asia.report._page.html import Html, join, said, table, tag
from asia.report._page.section import Section
from asia.report._page.subject import Subject, result_of
from asia.report._page.svg.curves import legend
from asia.report._page.svg.progress import NARROW, WIDE, Point, RungLevel, draw_progress
from asia.scoring import Score


def _write(subject: Subject) -> Html | None:
    view = subject.view
    if not view.finished:
        return None
    told = {e.number for e in subject.told}
    shown = [e for e in view.finished if e.number in told]
    text = "V is the error of simulation on held-out data over the variation of the output."
    rows = [_improvement(subject, e, before) for e, before in _improvements(subject)]
    head = ["experiment", "candidate", view.v_name, "change"]
    return join(
        (
            tag("p", text),
            progress_figure(subject, shown),
            _references(subject),
            tag(
                "details",
                tag("summary", "The improvements as a table"),
                table(head, rows, "Best experiments so far"),
            ),
        )
    )


def progress_figure(subject: Subject, shown: Sequence[Experiment]) -> Html:
    """The drawing for wide and for narrow screens, with its legend. shown: experiments with a
    result."""
    view = subject.view
    bests = {e.number for e in view.bests}
    points = [_point(subject, e, best=e.number in bests) for e in shown]
    levels = [
        RungLevel(r.name, r.outcome.value) for r in view.rungs if isinstance(r.outcome, Score)
    ]
    alt = (
        "V of each experiment with the best so far as a step line; the table below has the same "
        "numbers."
    )
    drawings = [
        tag("div", draw_progress(points, levels, view.v_name, alt, size), class_=name)
        for size, name in ((WIDE, "wide"), (NARROW, "narrow"))
    ]
    kinds = [
        ("kept", "new best"),
        ("other", "no new best"),
        ("failed", "no score"),
        ("best", "best so far"),
    ]
    return tag("figure", *drawings, legend(kinds))


def _point(subject: Subject, experiment: Experiment, *, best: bool) -> Point:
    result, score = result_of(experiment), experiment.score
    return Point(
        experiment.number,
        score.value if score else None,
        result.status,
        experiment.proposed.title,
        f"{subject.place(result)}:outcome.value" if score else "",
        error_value(score.value) if score else "",
        best,
    )


def _references(subject: Subject) -> Html | None:
    rows = [
        [
            said(r.name),
            subject.number(r, "outcome.value", "error")
            if isinstance(r.outcome, Score)
            else "no score",
        ]
        for r in subject.view.rungs
    ]
    if not rows:
        return None
    return table(["reference", subject.view.v_name], rows, "Reference models")


def _improvements(subject: Subject) -> list[tuple[Experiment, Experiment | None]]:
    shown = {e.number for e in subject.told}
    bests = [e for e in subject.view.bests if e.number in shown]
    before: list[Experiment | None] = [None, *bests]
    return list(zip(bests, before, strict=False))


def _improvement(subject: Subject, e: Experiment, before: Experiment | None) -> list[str | None]:
    change = None
    if before is not None and before.score is not None and before.score.value:
        own, old = ((result_of(x), "outcome.value") for x in (e, before))
        change = subject.made("change", "signed_share", own, old)
    return [subject.name(e), said(e.proposed.title), subject.v(e), change]


SECTION = Section("progress", "Progress of the search", _write)
