"""Pages of the live view: list of runs, run, experiment, comparison."""

from __future__ import annotations

import getpass
import hashlib
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal
from urllib.parse import quote, urlencode

import numpy as np

from asia._text import one_line, printable_line
from asia.agents.library.recipe import Recipe, read_recipe
from asia.agents.registry import reads_notes
from asia.analysis.importance import LEAST_EXPERIMENTS, settings_importance
from asia.errors import UserError
from asia.interfaces.view.followed import ListedRun, RunFolder, Snapshot
from asia.ledger.events import Evaluated, Proposed
from asia.ledger.evidence import evidence_of, settings_of_run
from asia.ledger.text import decision_text, describe_result, error_value, evidence_lines
from asia.ledger.verdict import alarms, unguarded
from asia.ledger.view import Experiment
from asia.report.page.code import python
from asia.report.page.html import Html, fixed, join, picture, region, said, section, table, tag
from asia.report.page.sections import SECTIONS
from asia.report.page.sections.experiments import (
    experiment_story,
    progress_figure,
    status_of,
    tag_labels,
)
from asia.report.page.sections.verdict import draw_panel
from asia.report.page.subject import Detail, Subject
from asia.report.pictures.experiments import Kind, Span, draw_timeline
from asia.report.pictures.simulation import simulation_panels

# Frame of all pages: head, link back, state of the connection.


def run_address(name: str) -> str:
    """The path of a run's page."""
    return f"/runs/{quote(name, safe='')}"


def whole_page(
    title: str, trail: Sequence[tuple[str, str]], main: Sequence[Html | None], token: str
) -> str:
    """A whole page. trail: names and addresses of the pages above it."""
    links = [tag("a", text, href=address) for text, address in trail]
    crumbs = tag("nav", *links, class_="trail", aria_label="Breadcrumb")
    connection = tag("p", "", id="connection", role="status")
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="color-scheme", content="light dark"),
        tag("meta", name="asia-token", content=token),
        tag("title", f"{title} · ASIA"),
        Html('<link rel="icon" href="/static/icon.svg">'),
        Html('<link rel="stylesheet" href="/static/page.css">'),
        Html('<link rel="stylesheet" href="/static/view.css">'),
        Html('<script src="/static/view.js" defer></script>'),
        Html('<script src="/static/zoom.js" defer></script>'),
    )
    body = tag(
        "body",
        tag("a", "Skip to the content", href="#main", class_="skiplink"),
        tag("div", crumbs, connection, class_="bar-top"),
        tag("main", *main, id="main", tabindex="-1"),
        tag("div", id="live", class_="unseen", aria_live="polite"),
    )
    return f"<!doctype html>\n{tag('html', head, body, lang='en')}\n"


def to_pages(html: Html, name: str) -> Html:
    """Links to experiments lead to their pages."""
    return Html(re.sub(r'href="#e(\d+)"', rf'href="{run_address(name)}/experiments/\1"', html))


# The page of one experiment: its story, its simulations, its code.


def experiment_page(snapshot: Snapshot, number: int, token: str) -> str:
    """The page of an experiment. Raises UserError where there is none of that number."""
    name, experiment = snapshot.run.name, snapshot.run.view.experiment(number)
    address = run_address(name)
    part = tag(
        "div",
        experiment_part(snapshot, number),
        data_refresh=f"{address}/experiments/{number}/part",
        data_only=number,
    )
    stream = {"data_stream": f"{address}/events", "data_mark": snapshot.mark}
    holder = tag("div", part, note_form(name, number), **stream)
    title = f"#{experiment.number:02d} {experiment.proposed.title[:80]}"
    return whole_page(title, (("Searches", "/"), (name, address)), (holder,), token)


def experiment_part(snapshot: Snapshot, number: int) -> Html:
    """Write the content of the page.

    Raises:
        UserError: there is no such experiment.
    """
    # Every source, story and row.
    detail = Detail(sources=10**9, stories=10**9, rows=10**9)
    subject = replace(snapshot.subject, detail=detail)
    run, store = subject.run, subject.run.store
    e, address = subject.view.experiment(number), run_address(subject.run.name)
    status = status_of(subject, e)
    label = tag("span", status, class_=f"status {status}")
    title = tag("h1", subject.name(e), " ", said(e.proposed.title, 200))
    value = join(("V ", tag("b", subject.v(e)))) if e.score else None
    links: list[Html] = [
        tag("a", text, href=f"{address}/experiments/{other}", rel=rel)
        for other, text, rel in (
            (e.number - 1, "‹ previous", "prev"),
            (e.number + 1, "next ›", "next"),
        )
        if 1 <= other <= len(subject.view.experiments)
    ]
    best = subject.view.best
    if e.score is not None and best is not None and best.number != e.number:
        chosen = [("e", f"{run.name}/{number}") for number in (best.number, e.number)]
        links.append(tag("a", "overlay on the best", href=f"/compare?{urlencode(chosen)}"))

    simulations = None
    if subject.problem is not None and e.score is not None:
        panels, notes = simulation_panels(run, subject.problem, e, subject.folds)
        boxes = [
            zoomable(
                f"{address}/experiments/{e.number}/overlays/{k}",
                draw_panel(subject.problem, one),
                len(one),
            )
            for k, one in enumerate(panels)
        ]
        text = tag("p", "Drag across a picture to see a part of it.", said(notes))
        simulations = join((text, tag("div", *boxes, class_="grid")))

    # As `asia show` prints it.
    lines: list[str] = []
    if e.result is not None and store.kept:
        settings = settings_of_run(run.directory)
        found = evidence_of(e, subject.view, store, settings, bounded=False)
        lines = evidence_lines(found, e.seed_values) if found.recorded else []
        if not lines and e.result.output:
            lines = store.text(e.result.output).splitlines()[-20:]
    evidence = None
    if lines:
        evidence = region("pre", tag("code", "\n".join(lines)), label="evidence")

    story = to_pages(experiment_story(subject, e), run.name)
    source = python(store.text(e.source), "candidate.py") if store.kept else None
    parts = (
        tag("header", title, tag("p", label, " ", value)),
        tag("nav", *links, class_="neighbours", aria_label="Other experiments"),
        section("story", "What was tried", story),
        section("simulations", "Held-out simulations", simulations),
        section("evidence", "Evidence", evidence),
        section("source", "candidate.py", source),
    )
    return join(parts)


def zoomable(address: str, drawn: Html, count: int) -> Html:
    """An overlay with buttons to see a part of it.

    Args:
        address: where other parts of it are
        drawn: all of it
        count: number of its samples
    """
    name = f"overlay-{digest_of(address)}"
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
        for what, sign, text in (
            ("in", "+", "zoom in"),
            ("out", "−", "zoom out"),
            ("left", "◂", "move to earlier samples"),
            ("right", "▸", "move to later samples"),
            ("all", "all", "show all samples"),
        )
    ]
    return tag(
        "div",
        tag("div", drawn, class_="drawn", id=name),
        tag("div", *buttons, class_="tools", role="group", aria_label="Part of the record"),
        class_="zoomable",
        data_overlay=address,
        data_count=count,
    )


def overlay_part(snapshot: Snapshot, number: int, index: int, first: int, last: int | None) -> Html:
    """Samples `first` to `last` of an overlay, drawn. Raises UserError where there is none."""
    subject = snapshot.subject
    e, problem = subject.view.experiment(number), subject.problem
    if problem is not None and e.score is not None:
        panels, _ = simulation_panels(subject.run, problem, e, subject.folds)
        if 0 <= index < len(panels):
            return draw_panel(problem, panels[index].cut(first, last))
    raise UserError(f"experiment {number} has no picture {index}")


# The list of runs.


def start_form(problems: Sequence[str], agents: Sequence[str]) -> Html:
    """Form that starts a search on one of the problems with one of the agents."""
    fields: list[Html] = []
    for label, key, words in (("Problem", "problem", problems), ("Agent", "agent", agents)):
        options = [tag("option", word) for word in words]
        fields.append(tag("label", label, " ", tag("select", *options, name=key)))
    for label, key, value, least in (
        ("Experiments", "experiments", 10, 1),
        ("Seed", "seed", 0, 0),
    ):
        number = tag("input", name=key, type="number", value=value, min=least, required=True)
        fields.append(tag("label", label, " ", number))
    name = tag("input", name="name", maxlength=80, placeholder="PROBLEM-AGENT-sSEED")
    button = tag("button", "Start the search", type="submit")
    fields.append(tag("label", "Name ", name))
    form = tag("form", *fields, button, data_post="runs", class_="note")
    inner = tag("div", form, tag("p", role="status"))
    return tag("details", tag("summary", "Start a search"), inner, class_="steering", data_at="")


def runs_page(
    folder: Path, listed: Sequence[ListedRun], digest: str, token: str, start: Html | None
) -> str:
    """The page with the list of the runs of a folder. start: the form that starts a search."""
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
            tag("button", "Compare the chosen runs", type="submit", disabled=True, id="chosen"),
        ),
        action="/compare",
        method="get",
        data_stream="/events",
        data_mark=digest,
    )
    return whole_page("Searches", (), (header, words, start, form), token)


def runs_table(listed: Sequence[ListedRun]) -> Html:
    """A row a run."""
    if not listed:
        command = tag("code", "asia run PROBLEM")
        return tag("p", "There is no run yet. Start one with ", command, ".")
    head = [tag("th", tag("span", "choose", class_="unseen"), scope="col")]
    for text, kind in (
        ("run", "words"),
        ("state", "words"),
        ("V", None),
        ("experiments", None),
        ("problem", "words"),
        ("agent", "words"),
        ("best candidate", "words"),
        ("changed", None),
    ):
        head.append(tag("th", text, scope="col", class_=kind))
    body: list[Html] = []
    for one in listed:
        choose = tag(
            "input", type="checkbox", name="run", value=one.name, aria_label=f"choose {one.name}"
        )
        link = tag("a", said(one.name), href=run_address(one.name))
        labels = None if one.brief is None else tag_labels(one.brief.view.tags())
        cells = [tag("td", choose), tag("th", link, " ", labels, scope="row", class_="words")]
        if one.brief is None:
            trouble = said(f"cannot be read: {one.trouble}")
            cells.append(tag("td", trouble, colspan=7, class_="words"))
        else:
            view, best = one.brief.view, one.brief.view.best
            score = best.score if best is not None else None
            title = best.proposed.title if best is not None else ""
            cells += [
                tag("td", state_mark(one.brief.state), class_="words"),
                tag("td", error_value(score.value) if score is not None else ""),
                tag("td", f"{one.brief.finished} of {view.budget}"),
                tag("td", said(view.started.problem), class_="words"),
                tag("td", said(view.started.agent), class_="words"),
                tag("td", said(title, 60), class_="words title"),
                tag("td", datetime.fromtimestamp(one.changed).strftime("%d %b %H:%M")),
            ]
        body.append(tag("tr", *cells))
    inner = tag("table", tag("thead", tag("tr", *head)), tag("tbody", *body), class_="runs")
    return region("div", inner, class_="scroll", label="Runs")


def state_mark(state: str, *, paused: bool = False) -> Html:
    """Write the state of a search as a label."""
    text = f"{state}, to pause" if paused else state
    return tag("span", text, class_=f"state {state}")


# The list of experiments: short rows, the last one first.


CHUNK = 50
"""Rows of a part of the list; the browser lays out those parts alone that are seen."""
FIRST = 300
"""Rows that a page begins with; the rest is asked for where the list is scrolled to."""
MOST = 3000
"""Rows of one answer."""


ORDERS: Final = {
    "": "the last first",
    "oldest": "the oldest first",
    "v": "the lowest V first",
    "seconds": "the longest evaluation first",
    "family": "by family",
}
KINDS: Final = {"": "all", "kept": "kept", "other": "not kept", "failed": "without a score"}


@dataclass(frozen=True)
class Chosen:
    """Experiments that a list shows, as the address of the page has it.

    Attributes:
        kind, order: keys of `KINDS` and `ORDERS`; others count as ""
        words: each is in the title, rationale, family, result, notes, source or printed output
    """

    kind: str = ""
    words: str = ""
    order: str = ""

    def of(self, subject: Subject) -> list[Experiment]:
        """Return these experiments in their order."""
        words = self.words.lower().split()

        def holds(e: Experiment) -> bool:
            text = "\n".join(text for _, text in _texts(e, subject)).lower()
            return all(word in text for word in words)

        found = [
            e
            for e in reversed(subject.view.experiments)
            if (self.kind not in KINDS or self.kind in ("", _kind(e))) and (not words or holds(e))
        ]
        if self.order == "oldest":
            found.reverse()
        elif self.order == "v":
            found.sort(key=lambda e: e.score.value if e.score else float("inf"))
        elif self.order == "seconds":
            found.sort(key=lambda e: -(e.result.seconds if e.result else 0.0))
        elif self.order == "family":
            found.sort(key=lambda e: e.proposed.family)
        return found

    def place(self, e: Experiment, subject: Subject) -> Html | None:
        """Show where the first of the words stands, marked, with the text around it."""
        word = next(iter(self.words.split()), "")
        for name, text in _texts(e, subject) if word else ():
            line = printable_line(" ".join(text.split()))
            found = re.search(re.escape(word), line, re.IGNORECASE)
            if found:
                before, after = line[: found.start()], line[found.end() :][:200]
                if len(before) > 40:
                    before = f"… {before[-40:].partition(' ')[2]}"
                parts = before, tag("mark", found[0]), after
                return tag("span", f"{name}: ", tag("span", *parts, class_="said"))
        return None


def _texts(e: Experiment, subject: Subject) -> list[tuple[str, str]]:
    """Texts of an experiment that are searched, with their names."""
    p, view, store = e.proposed, subject.view, subject.run.store
    found = [
        ("experiment", f"#{e.number:02d}"),
        ("title", p.title),
        ("family", p.family),
        ("hypothesis", p.hypothesis),
        ("expected", p.expected),
        ("result", describe_result(e, view)),
    ]
    found += [("tag", one) for one in view.tags(e.number)]
    found += [("note", one.text) for one in view.noted if one.experiment == e.number]
    if store.kept:
        found.append(("source", store.text(e.source)))
        if e.result is not None and e.result.output:
            found.append(("printed", store.text(e.result.output)))
    return found


def _kind(e: Experiment) -> Kind:
    return "kept" if e.kept else "failed" if e.failure is not None else "other"


def experiment_row(subject: Subject, e: Experiment, chosen: Chosen = Chosen()) -> Html:
    """Write one experiment, its title and below it the reason of its status, or where the words
    stand that were searched."""
    status, labels = status_of(subject, e), tag_labels(subject.view.tags(e.number))
    reason = chosen.place(e, subject) or said(decision_text(e, subject.view), 300)
    reason = tag("span", reason, class_="why")
    link = tag(
        "a",
        tag("span", subject.name(e), class_="id"),
        tag("span", said(e.proposed.title, 120), " ", labels, class_="what"),
        reason,
        tag("span", status, class_=f"status {status}"),
        tag("span", subject.v(e) if e.score else "", class_="value"),
        href=f"{run_address(subject.run.name)}/experiments/{e.number}",
    )
    return tag("li", link, id=f"e{e.number}", class_=_kind(e))


def experiment_rows(
    subject: Subject, chosen: Chosen, after: int | None = None, most: int = FIRST
) -> Html:
    """At most `most` of the chosen experiments, those after a number in their order, in parts; with
    a button for the others."""
    every = chosen.of(subject)
    place = next((k for k, e in enumerate(every, 1) if e.number == after), 0)
    shown = every[place : place + min(most, MOST)]
    parts = [shown[k : k + CHUNK] for k in range(0, len(shown), CHUNK)]
    lists = [
        tag(
            "ol",
            *(experiment_row(subject, e, chosen) for e in part),
            class_="part",
            style=f"--rows:{len(part)}",
        )
        for part in parts
    ]
    if not every and chosen != Chosen():
        return tag("p", "No experiment fits.", class_="none")
    more = None
    if len(every) > place + len(shown):
        text = f"Show those after #{shown[-1].number}"
        more = tag("button", text, type="button", class_="more", data_after=shown[-1].number)
    return join((*lists, more))


# The page of one run: what is known now, the curve, the list, and the report's sections.


# These are written here, so that they can change line by line.
_OWN: Final = ("progress", "experiments")
TABS: Final = ("linear", "control", "certificate")
"""Keys of the sections that have a page of their own, where the run has them."""
GALLERY: Final = "simulations"
"""Key of the page with the simulations of all experiments."""


def tabs(snapshot: Snapshot, here: str = "") -> Html:
    """Links to the pages of a run."""
    found = {"": "Search", GALLERY: "Simulations"}
    for one in SECTIONS:
        if one.key in TABS and one.write(snapshot.subject) is not None:
            found[one.key] = one.title
    address = run_address(snapshot.run.name)
    links = [
        tag("a", title, href=f"{address}/{key}".rstrip("/"),
            aria_current="page" if key == here else None)
        for key, title in found.items()
    ]  # fmt: skip
    return tag("nav", *links, class_="tabs", aria_label="Pages of the run")


def tab_page(snapshot: Snapshot, key: str, token: str) -> str:
    """The page of a tab. Raises UserError where the run has nothing for it."""
    found = next((one for one in SECTIONS if one.key == key and key in TABS), None)
    inner = None if found is None else found.write(snapshot.subject)
    name = snapshot.run.name
    if found is None or inner is None:
        raise UserError(f"run '{name}' has no page '{key}'")
    header = tag("header", tag("h1", said(name)))
    main = header, tabs(snapshot, key), section(key, found.title, inner)
    return whole_page(f"{name}: {found.title}", (("Searches", "/"),), main, token)


def run_page(snapshot: Snapshot, token: str, chosen: Chosen) -> str:
    """The page of a run, with the chosen experiments."""
    subject = snapshot.subject
    start, name = subject.view.started, snapshot.run.name
    labels = tag_labels(subject.view.tags())
    header = tag("header", tag("h1", said(name)), tag("p", subject.setting, " ", labels))
    own = [one for key in _OWN for one in SECTIONS if one.key == key]
    others = [(one.key, one.title) for one in SECTIONS if one.key not in (*_OWN, *TABS)]
    place = [key for key, _ in others].index("tradeoff") + 1
    others[place:place] = [(key, title) for key, (title, _) in _LIVE.items()]
    named = [*((one.key, one.title) for one in own), *others]
    links = [tag("li", tag("a", title, href=f"#{key}")) for key, title in named]
    curve = tag(
        "div",
        progress_part(subject),
        id="curve",
        data_curve=f"{run_address(name)}/curve",
    )
    listed = region(
        "div", experiment_rows(subject, chosen), label="Experiments", id="rows", class_="rows"
    )
    overlay = tag(
        "a", "Overlay and compare experiments", href=f"/compare?{urlencode({'run': name})}"
    )
    # The page asks for the other sections when it is there.
    later = [
        section(
            key, title, tag("div", class_="later", data_part=f"{run_address(name)}/sections/{key}")
        )
        for key, title in others
    ]
    main = (
        header,
        tabs(snapshot),
        tag("div", now_panel(snapshot), id="now"),
        note_form(name),
        steering_panel(
            name,
            running=snapshot.run.state == "running",
            deaf="" if reads_notes(start) else start.agent,
        ),
        tag("nav", tag("ul", *links), aria_label="Sections"),
        section("progress", "Progress of the search", curve),
        section("experiments", "Experiments", choice_form(chosen), listed, tag("p", overlay)),
        *later,
    )
    holder = tag(
        "div",
        *main,
        data_stream=f"{run_address(name)}/events",
        data_mark=snapshot.mark,
        data_run=run_address(name),
    )
    return whole_page(name, (("Searches", "/"),), (holder,), token)


def choice_form(chosen: Chosen, *buttons: Html) -> Html:
    """Form that chooses and sorts experiments."""
    selects = [
        tag("label", label, " ", tag("select", *_options(values, now), name=key))
        for label, key, values, now in (
            ("Show", "kind", KINDS, chosen.kind),
            ("in order:", "order", ORDERS, chosen.order),
        )
    ]
    where = "searches titles, rationale, tags, notes, sources and printed output"
    words = tag("input", name="words", type="search", value=chosen.words, title=where)
    return tag(
        "form",
        *selects,
        tag("label", "with the words ", words),
        *buttons,
        id="choose",
        class_="choose",
        role="search",
    )


def _options(values: Mapping[str, str], now: str) -> list[Html]:
    return [tag("option", text, value=key, selected=key == now) for key, text in values.items()]


def now_panel(snapshot: Snapshot) -> Html:
    """Write the state of the search in a few figures."""
    subject, view = snapshot.subject, snapshot.run.view
    best = view.best
    done = subject.over("evaluated", "experiment", "count", "count")
    budget = tag("span", f" of {view.budget}", class_="fixed")
    doing = None
    if view.running and snapshot.run.state == "running":
        each = [join((subject.name(e), " ", said(e.proposed.title, 60))) for e in view.running]
        curves: list[Html] = []
        for number, folds in sorted(snapshot.losses.items()):
            name = f"#{number:02d}, " if len(view.running) > 1 else ""
            for fold, curve in sorted(folds.items()):
                step, loss = curve[-1]
                words = tag("span", f"{name}fold {fold}: loss {loss:.4g} at step {step:g}")
                drawn = tag("svg", data_losses=json.dumps(curve), class_="loss", aria_hidden="true")
                curves.append(tag("p", drawn, words))
        doing = join((join(each, ", "), tag("div", *curves, class_="losses") if curves else None))
    tiles: list[tuple[str, Html | None]] = [
        ("state", state_mark(snapshot.run.state, paused=snapshot.paused)),
        ("experiments", join((done, budget))),
        (f"{view.v_name}, the best", subject.v(best) if best is not None else None),
        ("evaluation time", subject.over("evaluated", "seconds", "sum", "duration")),
        ("being evaluated", doing),
    ]
    shown = [
        tag("div", tag("dt", label), tag("dd", value), class_="doing" if value is doing else None)
        for label, value in tiles
        if value is not None
    ]
    trouble = None
    if snapshot.trouble:
        missing = "No simulations, because the records are missing: "
        trouble = tag("p", missing, said(snapshot.trouble, 600), class_="trouble")
    first = [*alarms(view), *filter(None, [unguarded(view)])]
    said_first = [tag("p", said(words, 600), class_="alarm") for words in first]
    return join((*said_first, tag("dl", *shown, class_="tiles"), trouble))


def steering_panel(name: str, *, running: bool, deaf: str = "") -> Html:
    """Form for notes and buttons to pause and stop. deaf: the agent, where it reads no notes."""
    note = tag(
        "form",
        tag("label", "Note for the agent", for_="note"),
        tag(
            "textarea",
            id="note",
            name="text",
            rows="2",
            maxlength="4000",
            required=True,
            disabled=bool(deaf),
        ),
        tag("button", "Send the note", type="submit", disabled=bool(deaf)),
        tag("p", f"The agent '{deaf}' reads no notes.") if deaf else None,
        data_post="steer",
    )
    buttons = [
        tag("button", text, type="button", data_post=what, data_running=True, disabled=not running)
        for what, text in (
            ("pause", "Pause after this experiment"),
            ("continue", "Continue"),
            ("stop", "Stop after this experiment"),
        )
    ]
    answer = tag("p", role="status")
    summary = tag("summary", "Steer this search")
    inner = tag("div", note, tag("p", *buttons, class_="buttons"), answer)
    return tag("details", summary, inner, class_="steering", data_at=run_address(name))


def note_form(name: str, number: int = 0) -> Html:
    """Form for a note for people, and for tags. number: the experiment; 0 for the run."""
    fields = (
        ("text", "Note, or reason of the tags", "", True),
        ("tags", "Tags to add", "words with a space between them", False),
        ("removed", "Tags to remove", "", False),
        ("author", "Author", "", True),
    )
    inputs: list[Html] = []
    for key, label, hint, required in fields:
        value = getpass.getuser() if key == "author" else None
        given = {"name": key, "placeholder": hint or None, "value": value, "required": required}
        inputs.append(tag("label", label, " ", tag("input", maxlength=4000, **given)))
    form = tag(
        "form",
        *inputs,
        tag("input", type="hidden", name="experiment", value=number),
        tag("button", "Record the note", type="submit"),
        data_post="note",
        class_="note",
    )
    what = "this experiment" if number else "this run"
    answer = tag("p", role="status")
    inner = tag("div", tag("p", "For people: agents do not see it."), form, answer)
    summary = tag("summary", f"Note or tag {what}")
    return tag("details", summary, inner, class_="steering", data_at=run_address(name))


def section_part(snapshot: Snapshot, key: str) -> Html | None:
    """Write the content of a section; None if the run has nothing for it, or there is no such
    section.
    """
    others = (*_OWN, *TABS)
    if key in _LIVE:
        return _LIVE[key][1](snapshot)
    found = next((one for one in SECTIONS if one.key == key and key not in others), None)
    inner = None if found is None else found.write(snapshot.subject)
    return None if inner is None else to_pages(inner, snapshot.run.name)


# Settings that go with a low V.


def importance_part(snapshot: Snapshot) -> Html | None:
    """Write the share of the variance of log V that each setting of a family explains; what is
    missing where no family has enough experiments. None without a candidate of the library."""
    run = snapshot.run
    tried: list[tuple[Recipe, float]] = []
    for e in run.view.finished if run.store.kept else ():
        recipe = read_recipe(run.store.text(e.source))
        if recipe is not None and e.score is not None and 0 < e.score.value < np.inf:
            tried.append((recipe, e.score.value))
    if not tried:
        return None
    counts = Counter(recipe.family for recipe, _ in tried)
    few = [(name, n) for name, n in counts.most_common() if n < LEAST_EXPERIMENTS]
    missing = None
    if few:
        each = ", ".join(f"{name} {LEAST_EXPERIMENTS - n} more" for name, n in few)
        missing = tag(
            "p",
            f"The analysis needs {LEAST_EXPERIMENTS} experiments of one family with a score. "
            f"Missing: {each}.",
        )
    rows = settings_importance(tried)
    if not rows:
        same = None if len(few) == len(counts) else tag("p", "No setting was varied.")
        return join((same, missing))
    cells = [
        [said(f"{one.family} {one.setting}"), *(fixed(text) for text in (
            f"{one.values}", f"{one.experiments}", f"{100 * one.share:.0f} %",
            f"{min(one.probability, 1):.2g}"))]
        for one in rows
    ]  # fmt: skip
    text = (
        "Share of the variance of log V between experiments of one family with different values of "
        "a setting, corrected for the number of values. p: probability of as large a share by "
        "chance, corrected for the number of settings. The agent chose the values: settings that "
        "it changed together share their effect."
    )
    head = ["setting", "values", "experiments", "share of the variance", "p"]
    return join((tag("p", text), table(head, cells, "Settings of the families"), missing))


# Times of the evaluations.


def timeline_part(snapshot: Snapshot) -> Html | None:
    """Draw when each experiment was evaluated, those at the same time one above the other; None
    before the first one."""
    subject, lines = snapshot.subject, snapshot.run.lines
    times: dict[int, list[float]] = {}
    for line in lines:
        if isinstance(line.event, Proposed | Evaluated):
            at = datetime.fromisoformat(line.time).timestamp()
            times.setdefault(line.event.experiment, []).append(at)
    now = max([time for pair in times.values() for time in pair], default=0.0)
    spans = [
        Span(e.number, _kind(e) if e.result else "running", *_ends(found, now))
        for e in subject.view.experiments
        if (found := times.get(e.number))
    ]
    if not spans:
        return None
    alt = "Time of the evaluation of each experiment, from its proposal to its result."
    drawn = picture(partial(draw_timeline, spans), alt)
    start, end = (
        datetime.fromtimestamp(at, UTC).strftime("%Y-%m-%d %H:%M:%S")
        for at in (min(one.begin for one in spans), max(one.end for one in spans))
    )
    where = tag("p", "From ", fixed(start), " to ", fixed(end), " UTC.")
    text = (
        "Each bar reaches from the proposal of an experiment to its result. Evaluations at the "
        "same time have rows of their own. Gaps are the agent and the decisions of the search. "
        "Longer pauses, such as those before a search was resumed, are cut out."
    )
    return join((tag("p", text), where, drawn))


def _ends(times: Sequence[float], now: float) -> tuple[float, float]:
    return times[0], times[-1] if len(times) > 1 else now


_LIVE: Final = {
    "importance": ("Settings", importance_part),
    "timeline": ("Timeline", timeline_part),
}
"""Titles and writers of the sections that the report does not have, by their keys."""


def progress_part(subject: Subject) -> Html:
    """V of every experiment."""
    if subject.view.finished:
        return progress_figure(subject)
    return tag("p", "There is no result yet.")


# Messages to an open page when its run has changed.


@dataclass(frozen=True)
class Changed:
    """One message of a stream."""

    kind: Literal["news", "trouble", "anew"]
    """News; the run cannot be read; or the page shows what is no more and has to load again."""
    mark: str
    """Mark from which the next message continues."""
    data: dict[str, Any]
    """JSON: names of elements with their HTML, or words."""


def run_news(snapshot: Snapshot, count: int, *, first: bool) -> Changed:
    """Return the changes of a run's page since `count` lines.

    Args:
        snapshot: the present state.
        count: number of ledger lines that the page shows.
        first: true for the first message of a stream, so that nothing is read aloud.
    """
    subject, view = snapshot.subject, snapshot.run.view
    changed = [view.experiment(number) for number in snapshot.changed_since(count)]
    rows = [{"number": e.number, "html": experiment_row(subject, e)} for e in changed]
    lines = snapshot.run.lines[count:]
    judged = {one.event.experiment for one in lines if isinstance(one.event, Evaluated)}
    ended = [e for e in changed if e.number in judged]
    spoken = ""
    if ended and not first:
        result, score = ended[0].result, ended[0].score
        assert result is not None
        value = f"V {error_value(score.value)}" if score is not None else "no score"
        title = one_line(ended[0].proposed.title, 100)
        spoken = f"Experiment {ended[0].number}, {result.status}, {value}: {title}"
    data = {"rows": rows, "parts": {"now": now_panel(snapshot)}, "said": spoken}
    return Changed("news", snapshot.mark, {**data, "running": snapshot.run.state == "running"})


def list_news(folder: RunFolder, shown: str) -> Changed | None:
    """The list of runs, where it is another one than the one whose digest is `shown`."""
    table = runs_table(folder.listed())
    digest = digest_of(table)
    if digest == shown:
        return None
    return Changed("news", digest, {"rows": [], "parts": {"list": table}, "said": ""})


def digest_of(html: str) -> str:
    """Tells one HTML from another."""
    return hashlib.sha256(html.encode("utf-8", "replace")).hexdigest()[:20]
