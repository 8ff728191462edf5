"""Sections of the search: progress, experiments, lineage, model source."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Final

from asia.judge.scoring.outcome import Score
from asia.ledger.artifacts import Store
from asia.ledger.run import control
from asia.ledger.text import error_line, phase_text
from asia.ledger.view import Experiment
from asia.problem.problem import is_described
from asia.report.drawing.inline import WIDE, svg_of
from asia.report.page.code import change, python
from asia.report.page.html import (
    RULES,
    Html,
    equations,
    facts,
    join,
    picture,
    region,
    said,
    table,
    tag,
    write_number,
)
from asia.report.page.subject import Section, Subject, result_of
from asia.report.pictures.experiments import (
    LineageRow,
    Traded,
    draw_lineage,
    draw_tradeoff,
    front_of,
    lineage_width,
)
from asia.report.pictures.progress import draw_progress

# All experiments: expectation, result, and change of the source.


def status_of(subject: Subject, e: Experiment) -> str:
    """Return the status of an experiment; one without a result does not run in a search that was
    interrupted."""
    if e.result is not None:
        return e.result.status
    return "running" if subject.run.state == "running" else "unfinished"


def _write(subject: Subject) -> Html | None:
    if not subject.listed:
        return None
    note = None
    if len(subject.listed) < len(subject.view.experiments):
        text = (
            "The list has the kept experiments, the lineage of the winner and the last experiments."
        )
        note = tag("p", text)
    return join((note, tag("div", *(_experiment(subject, e) for e in subject.listed),
                           class_="experiments")))  # fmt: skip


def _experiment(subject: Subject, e: Experiment) -> Html:
    status = status_of(subject, e)
    title = tag(
        "summary",
        tag("span", subject.name(e), class_="id"),
        tag("span", said(e.proposed.title, 100), class_="what"),
        tag("span", status, class_=f"status {status}"),
        tag("span", subject.v(e) if e.score else "no score", class_="value"),
    )
    if e.number not in subject.with_story:
        return tag("details", title, tag("p", said(e.proposed.hypothesis)), id=f"e{e.number}")
    best = subject.view.best
    won = best is not None and best.number == e.number
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
    p, result = e.proposed, e.result
    parent = None
    if p.parent is not None:
        parent = tag("a", subject.number(p, "parent", "number"), href=f"#e{p.parent}")
    folds = None
    if e.score is not None and result is not None and e.score.folds:
        places = [f"outcome.folds.{k}.value" for k in range(len(e.score.folds))]
        folds = join((subject.number(result, place, "error") for place in places), ", ")
    pairs = (
        ("hypothesis", said(p.hypothesis, 2000)),
        ("expected", said(p.expected, 1000)),
        ("observed", _seen(subject, e)),
        ("derived from", parent),
        ("family", said(p.family)),
        ("phase", phase_text(p.phase)),
        ("agent", said(p.agent) if p.agent else None),
        ("V of the folds", folds),
        ("duration", None if result is None else subject.number(result, "seconds", "duration")),
        ("tags", tag_labels(subject.view.tags(e.number))),
        ("notes", noted_list(subject, e.number)),
    )
    parts: list[Html | None] = [facts(pairs)]
    if e.failure is not None:
        parts.append(tag("p", said(e.failure.advice)))
        if line := error_line(e.failure.detail):
            parts.append(region("pre", tag("code", line), label="error"))
    return join((*parts, _change(subject, e)))


def tag_labels(names: Sequence[str]) -> Html | None:
    """Tags of users; None without any."""
    return join([tag("span", said(one), class_="label") for one in names], " ") if names else None


def noted_list(subject: Subject, number: int | None = None) -> Html | None:
    """Notes of users on one experiment, or on the run and all its experiments; None without any."""
    items: list[Html] = []
    for one in subject.view.noted:
        if number is not None and one.experiment != number:
            continue
        place = None
        if number is None and one.experiment:
            name = subject.number(one, "experiment", "number")
            place = join((tag("a", name, href=f"#e{one.experiment}"), " "))
        changes = " ".join((*(f"+{t}" for t in one.tags), *(f"−{t}" for t in one.removed)))
        time = subject.run.lines[subject.place(one)].time[:16].replace("T", " ")
        author = tag("span", said(f"{one.author}, {time} UTC"), class_="by")
        text = tag("span", said(f"{changes} {one.text}".strip(), 4000))
        items.append(tag("li", place, text, " ", author))
    return tag("ul", *items, class_="noted") if items else None


NOTES = Section("notes", "Notes and tags", noted_list)


def _seen(subject: Subject, e: Experiment) -> Html | str:
    """V compared with that of the previous best and of the parent."""
    if e.result is None:
        return "It is being evaluated."
    if e.score is None:
        return "no score"
    parts: list[str] = ["V = ", subject.v(e)]
    kept = [o for o in subject.view.bests if o.number < e.number]
    others = [("the previous best", kept[-1])] if kept else []
    parent = e.proposed.parent
    if parent is not None and parent != e.number and (not kept or parent != kept[-1].number):
        others.append(("its parent", subject.view.experiment(parent)))
    for text, other in others:
        if other.score is not None and other.score.value:
            pair = (e.result, "outcome.value"), (result_of(other), "outcome.value")
            gap = subject.made("change", "signed_share", *pair)
            parts += ["; ", gap, f" compared with {text}, ", subject.name(other)]
    return join(parts)


def _change(subject: Subject, e: Experiment) -> Html | None:
    store, parent = subject.run.store, e.proposed.parent
    if not store.kept or parent is None or e.number not in subject.with_source:
        return None
    names = f"#{parent:02d}", f"#{e.number:02d}"
    old = store.text(subject.view.experiment(parent).source)
    label = f"change of candidate.py from {names[0]} to {names[1]}"
    lines = change(old, store.text(e.source), names, label)
    if lines is None:
        return None
    return tag("details", tag("summary", "change of the code"), lines, class_="change")


SECTION = Section("experiments", "Experiments", _write)


# The lineage: the parent of each candidate.


def _write_lineage(subject: Subject) -> Html | None:
    shown = subject.listed
    if len(shown) < 2 or all(e.proposed.parent is None for e in shown):
        return None
    rows: list[LineageRow] = []
    items: list[Html] = []
    for e in shown:
        won, parent = e.number in subject.lineage, e.proposed.parent
        rows.append(LineageRow(e.number, parent, status_of(subject, e), won))
        made_from = None
        if parent is not None:
            source = subject.number(e.proposed, "parent", "number")
            made_from = tag("span", " derived from ", source, class_="unseen")
        title = tag("a", subject.name(e), " ", said(e.proposed.title, 80), href=f"#e{e.number}")
        value = tag("span", subject.v(e) if e.score else status_of(subject, e), class_="value")
        items.append(tag("li", title, made_from, value, class_="won" if won else None))
    drawing = Html(svg_of(partial(draw_lineage, rows), "", WIDE, fixed=True))
    width = lineage_width(rows)
    text = "The thick line leads to the winner. A filled circle is a kept candidate."
    listed = tag("ol", *items, style=f"padding-left:{width}px")
    return join((tag("p", text), tag("div", drawing, listed, class_="lineage")))


LINEAGE = Section("lineage", "Lineage", _write_lineage)


# The problem, in the words of its description.


def _write_problem(subject: Subject) -> Html | None:
    text = "" if subject.problem is None else subject.problem.description
    if not is_described(text):
        return None
    # Headings and lists of Markdown; all else is plain text.
    lines = re.sub(r"(?m)^(#+ .*)$", r"\n\1\n", text.strip())
    parts: list[Html] = []
    for one in filter(str.strip, re.split(r"\n\s*\n", lines)):
        items = re.split(r"(?m)^\s*[-*] +", one)
        if start := items[0].strip():
            is_title = start.startswith("#")
            parts.append(tag("h3" if is_title else "p", said(start.lstrip("# "), 4000)))
        if items[1:]:
            parts.append(tag("ul", *(tag("li", said(item, 4000)) for item in items[1:])))
    return join(parts)


PROBLEM = Section("problem", "The problem", _write_problem)


# The winner: equations or structure, and its code.


def _write_model(subject: Subject) -> Html | None:
    best, store = subject.view.best, subject.run.store
    if best is None:
        return None
    p = best.proposed
    pairs = (
        ("candidate", join((subject.name(best), " ", said(p.title)))),
        ("family", said(p.family)),
        ("hypothesis", said(p.hypothesis, 600)),
    )
    parts: list[Html] = [facts(pairs)]
    if subject.problem is not None and subject.problem.physics is not None:
        rows = [
            tag("div", tag("span", kind, class_="kind"), formula, class_="equation")
            for kind, formula in equations(subject.problem.physics)
        ]
        text = "The equations of the problem file. The code of the winner shows its additions."
        parts += [tag("h3", "Equations"), tag("p", text)]
        parts.append(region("div", *rows, class_="equations", label="equations"))
    if not store.kept:
        return join((*parts, tag("p", "The code is missing, because the run has no artifacts.")))
    source = store.text(best.source)
    block = python(source, "candidate.py of the winner")
    summary = tag("summary", "candidate.py")
    short = source.count("\n") <= 40
    return join((*parts, tag("h3", "Code"), tag("details", summary, block, open=short)))


MODEL = Section("model", "The model", _write_model)


# V of every experiment.


def _write_progress(subject: Subject) -> Html | None:
    view = subject.view
    if not view.finished:
        return None
    listed = {e.number for e in subject.listed}
    rows: list[list[str | None]] = []
    before: Experiment | None = None
    for e in view.bests:
        if e.number not in listed:
            continue
        change = None
        if before is not None and before.score is not None and before.score.value:
            pair = (result_of(e), "outcome.value"), (result_of(before), "outcome.value")
            change = subject.made("change", "signed_share", *pair)
        rows.append([subject.name(e), said(e.proposed.title), subject.v(e), change])
        before = e
    head = ["experiment", "candidate", view.v_name, "change of V"]
    references: list[list[str | None]] = []
    for r in view.references:
        scored = isinstance(r.outcome, Score)
        value = subject.number(r, "outcome.value", "error") if scored else "no score"
        references.append([said(r.name), value])
    text = "V: simulation error on held-out data, divided by the standard deviation of the output."
    if subject.problem is not None and subject.problem.control is not None:
        text = "V: error of the closed loop in held-out scenarios, divided by the tolerance."
    return join(
        (
            tag("p", text),
            progress_figure(subject),
            table(["reference", view.v_name], references, "Reference models")
            if references
            else None,
            tag(
                "details",
                tag("summary", "Table of the improvements"),
                table(head, rows, "Best experiments so far"),
            ),
        )
    )


def progress_figure(subject: Subject) -> Html:
    """V of each experiment as a picture."""
    run, view = subject.run, subject.view
    alt = "V of each experiment with the best so far as a step line"
    beside = control(run.directory, view.started, len(view.finished))
    return picture(partial(draw_progress, view, run.metric, beside), alt)


# V against the cost of a model, with the front that nothing dominates.


@lru_cache(maxsize=20_000)
def _costs(artifacts: Path, findings: str) -> tuple[float | None, float | None]:
    """Count of numbers and seconds of a sample, from the findings of a fold."""
    found = json.loads(Store(artifacts).get(findings))
    return found.get("numbers"), found.get("sample_seconds")


COSTS: Final = (
    ("numbers in the model", "numbers", "greatest", "count"),
    ("microseconds a sample", "sample_seconds", "least", "micro"),
    ("seconds of fit", "fit_seconds", "sum", "sig3"),
    ("proven bound of the gain", "certificate", "", ""),
    ("cost of the closed loop (IAE)", "control", "", ""),
)
"""Name, field of a fold, rule over the folds, and form of each cost; for the last two the command
whose files in the run have it."""


def cost_of(subject: Subject, e: Experiment, axis: int) -> tuple[float, Html] | None:
    """A cost of an experiment over its folds, as a number and for the page; None if not known."""
    _, field, rule, form = COSTS[axis]
    if not rule:
        value = subject.analysed[field].get(e.number)
        return None if not value else (value, said(f"{value:.3g}"))
    folds = result_of(e).folds
    if field == "fit_seconds":
        values: list[float | None] = [fold.fit_seconds for fold in folds]
        sources = [f"{subject.place(result_of(e))}:folds.{k}.{field}" for k in range(len(folds))]
    elif any(fold.findings is None for fold in folds) or not subject.run.store.kept:
        return None
    else:
        folder = subject.run.directory / "artifacts"
        values = [_costs(folder, str(fold.findings))[axis] for fold in folds]
        sources = [f"{fold.findings}:{field}" for fold in folds]
    known = [value for value in values if value]
    if not known or len(known) < len(values):
        return None
    return RULES[rule](known), write_number(known, " ".join(sources), rule, form)


def _write_tradeoff(subject: Subject) -> Html | None:
    scored = [e for e in subject.view.finished if e.score is not None]
    choices: list[Html] = []
    figures: list[Html] = []
    fronts: dict[int, Experiment] = {}
    for axis, (name, *_) in enumerate(COSTS):
        points = [
            Traded(e.number, e.proposed.title, e.score.value, found[0])
            for e in scored
            if e.score is not None and (found := cost_of(subject, e, axis)) is not None
        ]
        if len(points) < 2:
            continue
        fronts |= {p.number: subject.view.experiment(p.number) for p in front_of(points)}
        alt = f"{subject.view.v_name} against {name}; the table below has the front."
        shown = name if axis != 1 else "µs a sample (processor time)"
        draw = partial(draw_tradeoff, points, subject.view.v_name, shown)
        box = tag("input", type="radio", name="axis", id=f"axis{axis}", checked=not choices)
        choices.append(tag("label", box, " ", name))
        figures.append(tag("div", picture(draw, alt), class_=f"against axis{axis}"))
    if not figures:
        return None
    rows = [
        [
            tag("a", subject.name(e), " ", said(e.proposed.title, 80), href=f"#e{number}"),
            subject.v(e),
            *(None if (found := cost_of(subject, e, axis)) is None else found[1]
              for axis in range(len(COSTS))),
        ]
        for number, e in sorted(fronts.items())
    ]  # fmt: skip
    names = [name for name, *_ in COSTS]
    known = [k for k in range(len(COSTS)) if any(row[2 + k] for row in rows)]
    rows = [[*row[:2], *(row[2 + k] for k in known)] for row in rows]
    head = ["candidate", subject.view.v_name, *(names[k] for k in known)]
    return join((
        tag("fieldset", tag("legend", "V against"), *choices, class_="axes"),
        *figures,
        table(head, rows, "Candidates that no other one beats in V and in a cost"),
    ))  # fmt: skip


TRADEOFF = Section("tradeoff", "Trade-offs", _write_tradeoff)


PROGRESS = Section("progress", "Progress of the search", _write_progress)
