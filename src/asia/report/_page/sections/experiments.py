"""Section of all experiments: expectation, result, and change of the source."""

from __future__ import annotations

from asia.ledger import Experiment, error_line, phase_words
from asia.report._page.code import change
from asia.report._page.html import Html, facts, join, said, tag
from asia.report._page.section import Section
from asia.report._page.subject import Subject, result_of


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
        ("when", phase_words(p.phase)),
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
