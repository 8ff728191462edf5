"""The list of runs."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from asia.ledger import error_value
from asia.report.pieces import Html, said, tag
from asia.view._followed import ListedRun
from asia.view.pages.frame import run_address, whole_page

# Headings of the columns after the first, and their class.
_HEAD = (
    ("run", "words"),
    ("state", "words"),
    ("V", None),
    ("experiments", None),
    ("problem", "words"),
    ("agent", "words"),
    ("best candidate", "words"),
    ("changed", None),
)


def runs_page(folder: Path, listed: Sequence[ListedRun], digest: str, token: str) -> str:
    """The page with the list of the runs of a folder."""
    header = tag("header", tag("p", "ASIA view", class_="kind"), tag("h1", "Searches"))
    words = tag(
        "p",
        "Runs below ",
        tag("code", folder.name or str(folder)),
        ". V compares runs of one problem and one protocol only.",
    )
    form = tag(
        "form",
        tag("div", runs_table(listed), id="list"),
        tag(
            "p",
            tag("button", "Compare two runs", type="submit", disabled=True, id="two"),
            " ",
            tag("span", "Choose two runs.", id="two-words"),
        ),
        action="/compare",
        method="get",
        data_stream="/events",
        data_mark=digest,
    )
    return whole_page("Searches", (), (header, words, form), token)


def runs_table(listed: Sequence[ListedRun]) -> Html:
    """A row a run."""
    if not listed:
        return tag("p", "There is no run yet. Start one with: ", tag("code", "asia run PROBLEM"))
    head = [tag("th", tag("span", "choose", class_="unseen"), scope="col")]
    head += [tag("th", text, scope="col", class_=kind) for text, kind in _HEAD]
    body = [tag("tr", *_cells(one)) for one in listed]
    inner = tag("table", tag("thead", tag("tr", *head)), tag("tbody", *body), class_="runs")
    return tag("div", inner, class_="scroll", tabindex="0", role="region", aria_label="Runs")


def _cells(one: ListedRun) -> list[Html]:
    choose = tag(
        "td",
        tag("input", type="checkbox", name="run", value=one.name, aria_label=f"choose {one.name}"),
    )
    link = tag(
        "th", tag("a", said(one.name), href=run_address(one.name)), scope="row", class_="words"
    )
    if one.brief is None:
        return [
            choose,
            link,
            tag("td", said(f"cannot be read: {one.trouble}"), colspan=7, class_="words"),
        ]
    view, best = one.brief.view, one.brief.view.best
    value = error_value(best.score.value) if best is not None and best.score is not None else ""
    title = best.proposed.title if best is not None else ""
    changed = datetime.fromtimestamp(one.changed).strftime("%d %b %H:%M")
    return [
        choose,
        link,
        tag("td", state_mark(one.brief.state), class_="words"),
        tag("td", value),
        tag("td", f"{one.brief.finished} of {view.budget}"),
        tag("td", said(view.started.problem), class_="words"),
        tag("td", said(view.started.agent), class_="words"),
        tag("td", said(title, 60), class_="words title"),
        tag("td", changed),
    ]


def state_mark(state: str, *, paused: bool = False) -> Html:
    """Write the state of a search as a label."""
    text = f"{state}, to pause" if paused else state
    return tag("span", text, class_=f"state {state}")
