"""Simulations of all experiments of a run over the same held-out outputs."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Final
from urllib.parse import urlencode

from asia.interfaces.view.followed import Snapshot
from asia.interfaces.view.pages import (
    GALLERY,
    Chosen,
    choice_form,
    run_address,
    tabs,
    whole_page,
)
from asia.report.page.html import Html, fixed, join, said, section, tag
from asia.report.page.sections.verdict import draw_panel
from asia.report.pictures.simulation import simulation_panels

PICTURES: Final = 24
"""Simulations on one page."""


def gallery_page(snapshot: Snapshot, token: str, chosen: Chosen, after: int | None = None) -> str:
    """The page with the simulations of the chosen experiments. after: number of the experiment
    before its first one."""
    name = snapshot.run.name
    header = tag("header", tag("h1", said(name)))
    form = choice_form(chosen, tag("button", "Show", type="submit"))
    part = section(GALLERY, "Held-out simulations", form, _pictures(snapshot, chosen, after))
    main = header, tabs(snapshot, GALLERY), part
    return whole_page(f"{name}: simulations", (("Searches", "/"),), main, token)


def _pictures(snapshot: Snapshot, chosen: Chosen, after: int | None) -> Html:
    subject = snapshot.subject
    best = subject.view.best
    every = [e for e in chosen.of(subject) if e.score is not None]
    if subject.problem is None:
        missing = f": {snapshot.trouble}" if snapshot.trouble else ""
        return tag("p", said(f"No simulations, because the records are missing{missing}", 600))
    if best is None or not every:
        return tag("p", "No chosen experiment has a score.")
    place = next((k for k, e in enumerate(every, 1) if e.number == after), 0)
    shown = every[place : place + PICTURES]
    # The channel and the part of the record in which the best experiment has its lowest fit.
    each = [(subject.run, e) for e in shown]
    (one, *_), _ = simulation_panels(subject.run, subject.problem, best, subject.folds, each)
    alone = [
        replace(one, title="", error="", segments=tuple(
            replace(part, simulated=part.others[k], others=()) for part in one.segments
        ))
        for k in range(len(shown))
    ]  # fmt: skip
    # All errors on one scale, on which one that is far off does not hide the others.
    sizes = sorted(panel.error_limit() for panel in alone)
    limit = min(sizes[-1], 5 * sizes[0]) or sizes[-1]
    address = run_address(snapshot.run.name)
    figures: list[Html] = []
    for e, panel in zip(shown, alone, strict=True):
        title = tag(
            "a", subject.name(e), " ", said(e.proposed.title, 60),
            href=f"{address}/experiments/{e.number}",
        )  # fmt: skip
        text = join((title, " ", tag("span", "V ", subject.v(e), class_="value")))
        drawn = draw_panel(subject.problem, panel, limit=limit, alt=f"experiment {e.number}")
        figures.append(tag("div", tag("p", text), drawn))
    links: list[Html] = []
    for text, start in (("‹ previous", place - PICTURES), ("next ›", place + PICTURES)):
        if 0 <= start < len(every) or (start < 0 < place):
            query = asdict(chosen)
            if start > 0:
                query["after"] = str(every[start - 1].number)
            links.append(tag("a", text, href=f"{address}/{GALLERY}?{urlencode(query)}"))
    count = fixed(f"{place + 1} to {place + len(shown)} of {len(every)}")
    where = tag("p", "Simulations ", count, ", all over ", said(one.title.lower()),
                ", the least accurate output")  # fmt: skip
    around = tag("nav", *links, class_="neighbours", aria_label="Other simulations")
    grid = tag("div", *figures, class_="grid gallery")
    return join((where, grid, around if links else None))
