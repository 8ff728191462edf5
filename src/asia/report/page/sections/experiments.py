"""Sections of the search: progress, experiments, lineage, model source."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Final

from markupsafe import Markup

from asia.agents.expert_result import expert_result
from asia.ledger.artifacts import Store
from asia.ledger.events import Noted
from asia.ledger.view import Experiment
from asia.presentation.evidence import comparison_facts
from asia.presentation.experiments import (
    experiment_facts,
    experiments_table,
    references_table,
)
from asia.problem.problem import is_described
from asia.report.drawing.inline import WIDE, svg_of
from asia.report.page.code import change
from asia.report.page.render import picture, render, show
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


def _content(subject: Subject) -> dict[str, Any] | None:
    if not subject.listed:
        return None
    best = subject.view.best
    return {
        "leader": None if best is None else best.number,
        "status_of": partial(status_of, subject),
        "story": partial(experiment_story, subject),
    }


def experiment_story(subject: Subject, e: Experiment, link: str) -> Markup:
    """Write expectation, result and change of an experiment. link: address of another experiment
    without its number."""
    return render(
        "story.html",
        subject=subject,
        e=e,
        link=link,
        facts=[*experiment_facts(e, subject.view), *comparison_facts(e, subject.view)],
        tags=subject.view.tags(e.number),
        notes=list(noted(subject, e.number)),
        change=_change(subject, e),
    )


def noted(subject: Subject, number: int | None = None) -> Iterator[tuple[Noted, str, str]]:
    """Yield notes of users on one experiment, or on the run and all its experiments, each with its
    text and its time."""
    for one, time in subject.noted:
        if number is None or one.experiment == number:
            changes = " ".join((*(f"+{t}" for t in one.tags), *(f"−{t}" for t in one.removed)))
            yield one, f"{changes} {one.text}".strip(), time[:16].replace("T", " ")


def _notes(subject: Subject) -> dict[str, Any] | None:
    notes = list(noted(subject))
    return {"notes": notes} if notes else None


NOTES = Section("notes", "Notes and tags", _notes)


def _change(subject: Subject, e: Experiment) -> Markup | None:
    store, parent = subject.run.store, e.proposed.parent
    if not store.kept or parent is None or e.number not in subject.with_source:
        return None
    names = f"#{parent:02d}", f"#{e.number:02d}"
    old = store.text(subject.view.experiment(parent).source)
    label = f"change of candidate.py from {names[0]} to {names[1]}"
    return change(old, store.text(e.source), names, label)


SECTION = Section("experiments", "Experiments", _content)


# The lineage: the parent of each candidate.


def _lineage(subject: Subject) -> dict[str, Any] | None:
    shown = subject.listed
    if len(shown) < 2 or all(e.proposed.parent is None for e in shown):
        return None
    rows = [
        LineageRow(e.number, e.proposed.parent, status_of(subject, e), e.number in subject.lineage)
        for e in shown
    ]
    drawn = Markup(svg_of(partial(draw_lineage, rows), "", WIDE, fixed=True))
    return {"drawn": drawn, "width": lineage_width(rows), "status_of": partial(status_of, subject)}


LINEAGE = Section("lineage", "Lineage", _lineage)


# The problem, in the words of its description.


def _problem(subject: Subject) -> dict[str, Any] | None:
    text = "" if subject.problem is None else subject.problem.description
    if not is_described(text):
        return None
    # Headings and lists of Markdown; all else is plain text.
    lines = re.sub(r"(?m)^(#+ .*)$", r"\n\1\n", text.strip())
    parts: list[tuple[str, bool, list[str]]] = []
    for one in filter(str.strip, re.split(r"\n\s*\n", lines)):
        first, *items = (part.strip() for part in re.split(r"(?m)^\s*[-*] +", one))
        parts.append((first.lstrip("# "), first.startswith("#"), items))
    return {"parts": parts}


PROBLEM = Section("problem", "The problem", _problem)


# The best candidate: equations or structure, and its code.


def _model(subject: Subject) -> dict[str, Any] | None:
    best, store = subject.view.best, subject.run.store
    if best is None:
        return None
    return {"best": best, "source": store.text(best.source) if store.kept else None}


MODEL = Section("model", "The model", _model)


# V of every experiment.


def _progress(subject: Subject) -> dict[str, Any] | None:
    view = subject.view
    if not view.finished:
        return None
    listed = {e.number for e in subject.listed}
    bests = [e for e in view.bests if e.score is not None and e.number in listed]
    return {
        "drawn": progress_figure(subject),
        "references": show([references_table(view)] if view.references else []),
        "bests": show([experiments_table(bests, view)]),
    }


def progress_figure(subject: Subject) -> Markup:
    """V of each experiment as a picture."""
    run, view = subject.run, subject.view
    alt = "V of each experiment with the best so far as a step line"
    beside = expert_result(run.directory, view.started, len(view.finished))
    return picture(partial(draw_progress, view, run.metric, beside), alt)


PROGRESS = Section("progress", "Progress of the search", _progress)


# V against the cost of a model, with the front that nothing dominates.


@lru_cache(maxsize=20_000)
def _costs(artifacts: Path, findings: str) -> tuple[float | None, float | None]:
    """Count of numbers and seconds of a sample, from the findings of a fold."""
    found = json.loads(Store(artifacts).get(findings))
    return found.get("numbers"), found.get("sample_seconds")


COSTS: Final = (
    "numbers in the model",
    "microseconds a sample",
    "seconds of fit",
)
"""Name of each cost that every experiment has."""


def cost_of(subject: Subject, e: Experiment, name: str) -> tuple[float, str] | None:
    """A cost of an experiment over its folds, as a number and as a text; None if not known."""
    if name not in COSTS:
        value = subject.costs[name].get(e.number)
        return None if not value else (value, f"{value:.3g}")
    axis, folds = COSTS.index(name), result_of(e).folds
    if axis == 2:
        values: list[float | None] = [fold.fit_seconds for fold in folds]
    elif any(fold.findings is None for fold in folds) or not subject.run.store.kept:
        return None
    else:
        folder = subject.run.directory / "artifacts"
        values = [_costs(folder, str(fold.findings))[axis] for fold in folds]
    known = [value for value in values if value]
    if not known or len(known) < len(values):
        return None
    if axis == 0:
        return max(known), f"{max(known):.0f}"
    if axis == 1:
        return min(known), f"{1e6 * min(known):.3g}"
    return math.fsum(known), f"{math.fsum(known):.3g}"


def _tradeoff(subject: Subject) -> dict[str, Any] | None:
    scored = [e for e in subject.view.finished if e.score is not None]
    figures: list[tuple[int, str, Markup]] = []
    fronts: dict[int, Experiment] = {}
    names = [*COSTS, *subject.costs]
    for axis, name in enumerate(names):
        points = [
            Traded(e.number, e.proposed.title, e.score.value, found[0])
            for e in scored
            if e.score is not None and (found := cost_of(subject, e, name)) is not None
        ]
        if len(points) < 2:
            continue
        fronts |= {p.number: subject.view.experiment(p.number) for p in front_of(points)}
        alt = f"{subject.view.v_name} against {name}; the table below has the front."
        shown = name if axis != 1 else "µs a sample (processor time)"
        draw = partial(draw_tradeoff, points, subject.view.v_name, shown)
        figures.append((axis, name, picture(draw, alt)))
    if not figures:
        return None
    rows = [(e, [cost_of(subject, e, name) for name in names]) for _, e in sorted(fronts.items())]
    known = [k for k in range(len(names)) if any(costs[k] for _, costs in rows)]
    return {
        "figures": figures,
        "names": [names[k] for k in known],
        "rows": [(e, [(costs[k] or (0, ""))[1] for k in known]) for e, costs in rows],
    }


TRADEOFF = Section("tradeoff", "Trade-offs", _tradeoff)
