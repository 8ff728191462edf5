"""Sections of the search: progress, experiments, lineage, model source."""

from __future__ import annotations

from collections.abc import Sequence

from asia.judge.scoring.outcome import Score
from asia.ledger.text import error_line, error_value, phase_text
from asia.ledger.view import Experiment
from asia.report.page.code import change, python
from asia.report.page.html import Html, equations, facts, join, said, table, tag
from asia.report.page.subject import Section, Subject, result_of
from asia.report.page.svg import (
    NARROW,
    WIDE,
    LineageRow,
    Point,
    ReferenceLevel,
    draw_lanes,
    draw_progress,
    legend,
)

# Section of all experiments: expectation, result, and change of the source.


def _write(subject: Subject) -> Html | None:
    shown = subject.told
    if not shown:
        return None
    left_out = len(subject.view.experiments) - len(shown)
    note = None
    if left_out:
        text = "Listed are the kept experiments, the lineage of the winner and the last ones."
        note = tag("p", text)
    listed = tag("div", *(_experiment(subject, e) for e in shown), class_="experiments")
    return join((note, listed))


def _experiment(subject: Subject, e: Experiment) -> Html:
    status = e.result.status if e.result else "running"
    value = subject.v(e) if e.score else None
    title = tag(
        "summary",
        tag("span", subject.name(e), class_="id"),
        tag("span", said(e.proposed.title, 100), class_="what"),
        tag("span", status, class_=f"status {status}"),
        tag("span", value or "no score", class_="value"),
    )
    best = subject.view.best
    won = best is not None and best.number == e.number
    if e.number not in subject.with_story:
        return tag("details", title, tag("p", said(e.proposed.hypothesis)), id=f"e{e.number}")
    return tag(
        "details",
        title,
        experiment_story(subject, e),
        id=f"e{e.number}",
        class_="won" if won else None,
        open=won,
    )


def experiment_story(subject: Subject, e: Experiment) -> Html:
    """Write expectation, result and change of an experiment."""
    p = e.proposed
    made_from = None
    if p.parent is not None:
        number = subject.number(p, "parent", "number")
        made_from = tag("a", number, href=f"#e{p.parent}")
    pairs = (
        ("hypothesis", said(p.hypothesis, 2000)),
        ("expected", said(p.expected, 1000)),
        ("seen", _seen(subject, e)),
        ("made from", made_from),
        ("family", said(p.family)),
        ("when", phase_text(p.phase)),
        ("agent", said(p.agent) if p.agent else None),
        ("folds", _folds(subject, e)),
        ("took", None if e.result is None else subject.number(e.result, "seconds", "duration")),
    )
    return join((facts(pairs), _failure(e), _change(subject, e)))


def _seen(subject: Subject, e: Experiment) -> Html | None:
    if e.result is None:
        return join(("It is being evaluated.",))
    if e.score is None:
        return join(("no score",))
    parts: list[Html | str] = ["V = ", subject.v(e)]
    kept = [o for o in subject.view.bests if o.number < e.number]
    others = [("the best before", kept[-1])] if kept else []
    parent = e.proposed.parent
    if parent is not None and parent != e.number and (not kept or parent != kept[-1].number):
        others.append(("its parent", subject.view.experiment(parent)))
    for text, other in others:
        if other.score is None or not other.score.value:
            continue
        pair = (result_of(e), "outcome.value"), (result_of(other), "outcome.value")
        parts += ["; ", subject.made("change", "signed_share", *pair), f" beside {text}, "]
        parts.append(subject.name(other))
    return join(parts)


def _folds(subject: Subject, e: Experiment) -> Html | None:
    if e.score is None or e.result is None or not e.score.folds:
        return None
    values = [
        subject.number(e.result, f"outcome.folds.{k}.value", "error")
        for k in range(len(e.score.folds))
    ]
    return join(values, ", ")


def _failure(e: Experiment) -> Html | None:
    if e.failure is None:
        return None
    parts: list[Html] = [tag("p", said(e.failure.advice))]
    if line := error_line(e.failure.detail):
        block = tag("code", line)
        parts.append(tag("pre", block, tabindex="0", role="region", aria_label="error"))
    return join(parts)


def _change(subject: Subject, e: Experiment) -> Html | None:
    store, parent = subject.run.store, e.proposed.parent
    if not store.kept or parent is None or e.number not in subject.with_source:
        return None
    other = subject.view.experiment(parent)
    names = f"#{parent:02d}", f"#{e.number:02d}"
    old, new = store.text(other.proposed.source), store.text(e.proposed.source)
    lines = change(old, new, names, f"change of candidate.py from {names[0]} to {names[1]}")
    if lines is None:
        return None
    text = tag("summary", "change of the code")
    return tag("details", text, lines, class_="change")


SECTION = Section("experiments", "Experiments", _write)


# Section of the lineage: the parent of each candidate.


def _write_lineage(subject: Subject) -> Html | None:
    shown = subject.told
    if len(shown) < 2 or all(e.proposed.parent is None for e in shown):
        return None
    rows = [
        LineageRow(
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


LINEAGE = Section("lineage", "Lineage", _write_lineage)


# The winner: equations or structure, and its code.


def _write_model(subject: Subject) -> Html | None:
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


MODEL = Section("model", "The model", _write_model)


# V of every experiment.


def _write_progress(subject: Subject) -> Html | None:
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
        ReferenceLevel(r.name, r.outcome.value) for r in view.rungs if isinstance(r.outcome, Score)
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


PROGRESS = Section("progress", "Progress of the search", _write_progress)
