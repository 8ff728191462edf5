"""Simulations of all experiments of a run over the same held-out outputs."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any, Final
from urllib.parse import urlencode

from asia.interfaces.view.followed import Snapshot
from asia.interfaces.view.pages import GALLERY, Chosen, choice_form, tabs
from asia.interfaces.view.render import fill
from asia.report.page.sections.verdict import draw_panel
from asia.report.pictures.simulation import simulation_panels

PICTURES: Final = 24
"""Simulations on one page."""


def gallery_page(snapshot: Snapshot, token: str, chosen: Chosen, after: int | None = None) -> str:
    """The page with the simulations of the chosen experiments. after: number of the experiment
    before its first one."""
    name = snapshot.run.name
    return fill(
        "gallery_page.html",
        token=token,
        title=f"{name}: simulations",
        trail=(("Searches", "/"),),
        subject=snapshot.subject,
        name=name,
        key=GALLERY,
        tabs=tabs(snapshot, GALLERY),
        form=choice_form(chosen, with_button=True),
        **_pictures(snapshot, chosen, after),
    )


def _pictures(snapshot: Snapshot, chosen: Chosen, after: int | None) -> dict[str, Any]:
    """Return what the page shows, or in words why it shows nothing."""
    subject = snapshot.subject
    best = subject.view.best
    every = [e for e in chosen.of(subject) if e.score is not None]
    if subject.problem is None:
        missing = f": {snapshot.trouble}" if snapshot.trouble else ""
        return {"missing": f"No simulations, because the records are missing{missing}"}
    if best is None or not every:
        return {"missing": "No chosen experiment has a score."}
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
    links: list[tuple[str, str]] = []
    for text, start in (("‹ previous", place - PICTURES), ("next ›", place + PICTURES)):
        if 0 <= start < len(every) or (start < 0 < place):
            query = asdict(chosen)
            if start > 0:
                query["after"] = str(every[start - 1].number)
            links.append((text, urlencode(query)))
    return {
        "missing": "",
        "first": place + 1,
        "last": place + len(shown),
        "count": len(every),
        "where": one.title.lower(),
        "links": links,
        "pictures": [
            (e, draw_panel(subject.problem, panel, f"experiment {e.number}", limit=limit))
            for e, panel in zip(shown, alone, strict=True)
        ],
    }
