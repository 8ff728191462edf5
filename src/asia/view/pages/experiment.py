"""The page of one experiment: its story, its simulations, its code."""

from __future__ import annotations

from dataclasses import replace

from asia.errors import UserError
from asia.ledger import Experiment, evidence_lines, evidence_of, settings_of_run
from asia.report.pieces import (
    Detail,
    Html,
    Subject,
    draw_overlay,
    experiment_story,
    held_out_overlays,
    join,
    overlay_legend,
    python,
    said,
    tag,
)
from asia.view._followed import Snapshot
from asia.view.pages.frame import run_address, section, to_pages, whole_page

_EVERY = Detail(sources=10**9, stories=10**9, rows=10**9)
_TOOLS = (
    ("in", "+", "zoom in"),
    ("out", "−", "zoom out"),
    ("left", "◂", "move to earlier samples"),
    ("right", "▸", "move to later samples"),
    ("all", "all", "show all samples"),
)


def experiment_page(snapshot: Snapshot, number: int, token: str) -> str:
    """The page of an experiment. Raises UserError where there is none of that number."""
    name, experiment = snapshot.run.name, snapshot.run.view.experiment(number)
    address = run_address(name)
    holder = tag(
        "div",
        experiment_part(snapshot, number),
        data_stream=f"{address}/events",
        data_mark=snapshot.mark,
        data_refresh=f"{address}/experiments/{number}/part",
        data_only=number,
    )
    title = f"#{experiment.number:02d} {experiment.proposed.title[:80]}"
    return whole_page(title, (("Searches", "/"), (name, address)), (holder,), token)


def experiment_part(snapshot: Snapshot, number: int) -> Html:
    """Write the content of the page.

    Raises:
        UserError: there is no such experiment.
    """
    subject = replace(snapshot.subject, detail=_EVERY)
    e = subject.view.experiment(number)
    status = e.result.status if e.result else "running"
    label = tag("span", status, class_=f"status {status}")
    title = tag("h1", subject.name(e), " ", said(e.proposed.title, 200))
    value = join(("V ", tag("b", subject.v(e)))) if e.score else None
    header = tag("header", title, tag("p", label, " ", value))
    parts = (
        header,
        _neighbours(subject, e),
        section(
            "story", "What was tried", to_pages(experiment_story(subject, e), snapshot.run.name)
        ),
        section("simulations", "Held-out simulations", _overlays(snapshot, subject, e)),
        section("evidence", "Evidence", _evidence(subject, e)),
        section("source", "candidate.py", _source(subject, e)),
    )
    return join(parts)


def _neighbours(subject: Subject, e: Experiment) -> Html:
    address, last = run_address(subject.run.name), len(subject.view.experiments)
    links = [
        tag("a", text, href=f"{address}/experiments/{number}", rel=rel)
        for number, text, rel in (
            (e.number - 1, "‹ previous", "prev"),
            (e.number + 1, "next ›", "next"),
        )
        if 1 <= number <= last
    ]
    return tag("nav", *links, class_="neighbours", aria_label="Other experiments")


def _overlays(snapshot: Snapshot, subject: Subject, e: Experiment) -> Html | None:
    problem, overlays = subject.problem, held_out_overlays(subject, e)
    if problem is None or not overlays:
        return None
    text = "Drag across a picture to see a part of it."
    boxes = [zoomable(snapshot, e.number, k, len(one.measured)) for k, one in enumerate(overlays)]
    return join((tag("p", text), overlay_legend(), tag("div", *boxes, class_="grid")))


def zoomable(snapshot: Snapshot, number: int, index: int, count: int) -> Html:
    """An overlay with buttons to see a part of it."""
    name = f"overlay-{snapshot.run.name}-{number}-{index}"
    buttons = [
        tag(
            "button",
            sign,
            type="button",
            data_zoom=what,
            aria_label=text,
            title=text,
            aria_controls=name,
        )
        for what, sign, text in _TOOLS
    ]
    return tag(
        "div",
        tag("div", overlay_part(snapshot, number, index), class_="drawn", id=name),
        tag("div", *buttons, class_="tools", role="group", aria_label="Part of the record"),
        class_="zoomable",
        data_overlay=f"{run_address(snapshot.run.name)}/experiments/{number}/overlays/{index}",
        data_count=count,
    )


def overlay_part(
    snapshot: Snapshot, number: int, index: int, first: int = 0, last: int | None = None
) -> Html:
    """Samples `first` to `last` of an overlay, drawn. Raises UserError where there is none."""
    subject = snapshot.subject
    overlays = held_out_overlays(subject, subject.view.experiment(number))
    if subject.problem is None or not 0 <= index < len(overlays):
        raise UserError(f"experiment {number} has no picture {index}")
    one = overlays[index]
    return draw_overlay(
        subject.problem, one.cut(first, len(one.measured) - 1 if last is None else last)
    )


def _evidence(subject: Subject, e: Experiment) -> Html | None:
    """Write the evidence as `asia show` prints it."""
    store, result = subject.run.store, e.result
    if result is None or not store.kept:
        return None
    settings = settings_of_run(subject.run.directory)
    evidence = evidence_of(e, subject.view, store, settings, bounded=False)
    lines = evidence_lines(evidence) if evidence.recorded else []
    if not lines and result.output:
        lines = store.text(result.output).splitlines()[-20:]
    return _block("\n".join(lines), "evidence") if lines else None


def _source(subject: Subject, e: Experiment) -> Html | None:
    store = subject.run.store
    return python(store.text(e.proposed.source), "candidate.py") if store.kept else None


def _block(text: str, label: str) -> Html:
    return tag("pre", tag("code", text), tabindex="0", role="region", aria_label=label)
