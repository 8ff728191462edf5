"""Pages of the live view: list of runs, run, experiment, comparison."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final, Literal
from urllib.parse import quote, urlencode

from asia._text import one_line
from asia.agents.registry import reads_notes
from asia.errors import UserError
from asia.interfaces.view.followed import ListedRun, RunFolder, Snapshot
from asia.ledger.events import TestedModel
from asia.ledger.evidence import evidence_lines, evidence_of, settings_of_run
from asia.ledger.run import model_to_use, tested_model
from asia.ledger.text import error_value
from asia.ledger.view import Experiment
from asia.report.page.code import python
from asia.report.page.html import Html, join, said, table, tag
from asia.report.page.sections import SECTIONS
from asia.report.page.sections.experiments import experiment_story, progress_figure
from asia.report.page.sections.verdict import held_out_overlays, stamp
from asia.report.page.subject import Detail, Section, Subject
from asia.report.page.svg import (
    NARROW,
    WIDE,
    BestSoFar,
    draw_best,
    draw_overlay,
    overlay_legend,
)

# Frame of all pages: head, link back, state of the connection.


_ANCHOR = re.compile(r'href="#e(\d+)"')


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


def section(key: str, title: str, *inner: Html | None) -> Html | None:
    """A part of a page with its heading; None without anything in it."""
    if all(part is None for part in inner):
        return None
    heading = f"h-{key}"
    return tag("section", tag("h2", title, id=heading), *inner, id=key, aria_labelledby=heading)


def to_pages(html: Html, name: str) -> Html:
    """Links to experiments lead to their pages."""
    return Html(_ANCHOR.sub(rf'href="{run_address(name)}/experiments/\1"', html))


# The page of one experiment: its story, its simulations, its code.


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


# The list of runs.


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


# Two runs side by side.


def comparison_page(pair: Sequence[Snapshot], token: str) -> str:
    """The page of two runs."""
    names = [one.run.name for one in pair]
    query = urlencode([("run", name) for name in names])
    streams = [
        tag(
            "span",
            data_stream=f"{run_address(one.run.name)}/events",
            data_mark=one.mark,
            hidden=True,
        )
        for one in pair
    ]
    part = tag("div", comparison_part(pair), data_refresh=f"/compare/part?{query}")
    header = tag("header", tag("h1", "Comparison"))
    return whole_page(" and ".join(names), (("Searches", "/"),), (header, *streams, part), token)


def comparison_part(pair: Sequence[Snapshot]) -> Html:
    """Write the content of the page."""
    subjects = [one.subject for one in pair]
    columns = tag("div", *(_winner(one) for one in pair), class_="columns")
    parts = (
        section("figures", "Figures", _warning(subjects), _figures(subjects)),
        section("curves", "Best so far", _curves(subjects)),
        section("winners", "The best candidates", overlay_legend(), columns),
    )
    return join(parts)


def _warning(subjects: Sequence[Subject]) -> Html | None:
    starts = [one.view.started for one in subjects]
    if len({(s.problem, s.protocol_digest) for s in starts}) == 1:
        if len({one.view.v_name for one in subjects}) == 1:
            return None
        return tag(
            "p",
            "V was computed under different rules in the two runs: do not compare it.",
            class_="trouble",
        )
    return tag(
        "p",
        "The runs have different problems or protocols: do not compare their V.",
        class_="trouble",
    )


def _figures(subjects: Sequence[Subject]) -> Html:
    rows = [
        ("state", [state_mark(s.run.state) for s in subjects]),
        ("verdict", [_stamp(s) for s in subjects]),
        ("problem", [said(s.view.started.problem) for s in subjects]),
        ("agent", [said(s.view.started.agent) for s in subjects]),
        ("seed", [s.number(s.view.started, "seed", "text") for s in subjects]),
        ("isolation", [said(s.view.started.isolation_words) for s in subjects]),
        ("experiments", [s.over("evaluated", "experiment", "count", "count") for s in subjects]),
        ("spent on them", [s.over("evaluated", "seconds", "sum", "duration") for s in subjects]),
        ("V, the best", [_best(s) for s in subjects]),
        *(
            (f"V, {name}", [_reference(s, name) for s in subjects])
            for name in _references(subjects)
        ),
        ("error on the sealed test", [_tested(s) for s in subjects]),
    ]
    head = ["", *(tag("a", said(s.run.name), href=run_address(s.run.name)) for s in subjects)]
    return tag(
        "div", table(head, [(text, *cells) for text, cells in rows], "Both runs"), class_="both"
    )


def _stamp(subject: Subject) -> Html:
    text, kind = stamp(subject)
    return tag("span", text, class_=f"stamp small {kind}")


def _best(subject: Subject) -> Html:
    best = subject.view.best
    return subject.v(best) if best is not None else tag("span", "no score")


def _references(subjects: Sequence[Subject]) -> list[str]:
    names = {reference.name: None for subject in subjects for reference in subject.view.rungs}
    return list(names)


def _reference(subject: Subject, name: str) -> Html:
    reference = subject.rung(name)
    if reference is None:
        return tag("span", "none")
    return subject.number(reference[0], "outcome.value", "error")


def _tested(subject: Subject) -> Html:
    """Write the test scores of the models to use, once the test was opened."""
    opened, named = subject.view.unsealed, model_to_use(subject.view)
    if opened is None or named is None:
        return tag("span", "not opened")
    place = named.model if getattr(opened, named.model) is not None else "ensemble"
    if not isinstance(tested_model(opened, named.model), TestedModel):
        return tag("span", "no answer")
    return subject.number(opened, f"{place}.scores.0.value", "sig4")


def _curves(subjects: Sequence[Subject]) -> Html:
    searches = [_best_so_far(one) for one in subjects]
    alt = "Best V so far of both runs over the experiments."
    names = {one.view.v_name for one in subjects}
    axis = names.pop() if len(names) == 1 else "V"
    drawings = [
        tag("div", draw_best(searches, axis, alt, size), class_=name)
        for size, name in ((WIDE, "wide"), (NARROW, "narrow"))
    ]
    return tag("figure", *drawings)


def _best_so_far(subject: Subject) -> BestSoFar:
    finished = subject.view.finished
    kept = tuple((e.number, e.score.value) for e in subject.view.bests if e.score is not None)
    return BestSoFar(subject.run.name, kept, max((e.number for e in finished), default=0))


def _winner(snapshot: Snapshot) -> Html:
    subject, name = snapshot.subject, snapshot.run.name
    best = subject.view.best
    title = tag("h3", said(name))
    if best is None:
        return tag("div", title, tag("p", "There is no score yet."))
    link = tag(
        "a",
        subject.name(best),
        " ",
        said(best.proposed.title),
        href=f"{run_address(name)}/experiments/{best.number}",
    )
    overlays = held_out_overlays(subject, best)
    boxes = [zoomable(snapshot, best.number, k, len(o.measured)) for k, o in enumerate(overlays)]
    return tag("div", title, tag("p", link, ", V ", subject.v(best)), *boxes)


# The list of experiments: short rows, the last one first.


CHUNK = 50
"""Rows of a part of the list; the browser lays out those parts alone that are seen."""
FIRST = 300
"""Rows that a page begins with; the rest is asked for where the list is scrolled to."""
MOST = 3000
"""Rows of one answer."""


def experiment_row(subject: Subject, e: Experiment) -> Html:
    """Write one experiment on one line."""
    status = e.result.status if e.result else "running"
    link = tag(
        "a",
        tag("span", subject.name(e), class_="id"),
        tag("span", said(e.proposed.title, 120), class_="what"),
        tag("span", status, class_=f"status {status}"),
        tag("span", subject.v(e) if e.score else "", class_="value"),
        href=f"{run_address(subject.run.name)}/experiments/{e.number}",
    )
    kind = "kept" if e.kept else "failed" if e.failure is not None else "other"
    return tag("li", link, id=f"e{e.number}", class_=kind)


def experiment_rows(subject: Subject, before: int | None = None, most: int = FIRST) -> Html:
    """The last `most` experiments, or those before a number, in parts; with a button for the
    earlier ones."""
    every = [e for e in subject.view.experiments if before is None or e.number < before]
    shown = every[: -min(most, MOST) - 1 : -1]
    parts = [shown[k : k + CHUNK] for k in range(0, len(shown), CHUNK)]
    lists = [
        tag(
            "ol",
            *(experiment_row(subject, e) for e in part),
            class_="part",
            style=f"--rows:{len(part)}",
            data_first=part[-1].number,
        )
        for part in parts
    ]
    earlier = None
    if len(every) > len(shown):
        text = f"Show those before #{shown[-1].number}"
        earlier = tag("button", text, type="button", class_="earlier", data_before=shown[-1].number)
    return join((*lists, earlier))


# The page of one run: what is known now, the curve, the list, and the report's sections.


# These are written here, so that they can change line by line.
_OWN: Final = ("progress", "experiments")


def run_page(snapshot: Snapshot, token: str) -> str:
    """The page of a run."""
    subject = snapshot.subject
    start, name = subject.view.started, snapshot.run.name
    text = (
        "problem ", said(start.problem), " · agent ", said(start.agent), " · seed ",
        subject.number(start, "seed", "text"), " · isolation ", said(start.isolation_words),
    )  # fmt: skip
    header = tag("header", tag("h1", said(name)), tag("p", *text))
    links = [tag("li", tag("a", title, href=f"#{key}")) for key, title in _titles()]
    main = (
        header,
        tag("div", now_panel(snapshot), id="now"),
        steering_panel(
            name,
            running=snapshot.run.state == "running",
            deaf="" if reads_notes(start) else start.agent,
        ),
        tag("nav", tag("ul", *links), aria_label="Sections"),
        _progress(snapshot),
        _experiments(snapshot),
        *(_later(name, one) for one in SECTIONS if one.key not in _OWN),
    )
    holder = tag(
        "div",
        *main,
        data_stream=f"{run_address(name)}/events",
        data_mark=snapshot.mark,
        data_run=run_address(name),
    )
    return whole_page(name, (("Searches", "/"),), (holder,), token)


def _titles() -> list[tuple[str, str]]:
    titles = {one.key: one.title for one in SECTIONS}
    keys = (*_OWN, *(one.key for one in SECTIONS if one.key not in _OWN))
    return [(key, titles[key]) for key in keys]


def now_panel(snapshot: Snapshot) -> Html:
    """Write the state of the search in a few figures."""
    subject, view = snapshot.subject, snapshot.run.view
    best = view.best
    done = subject.over("evaluated", "experiment", "count", "count")
    budget = tag("span", f" of {view.budget}", class_="fixed")
    doing = None
    if view.running and snapshot.run.state == "running":
        each = [join((subject.name(e), " ", said(e.proposed.title, 60))) for e in view.running]
        doing = join(each, ", ")
    tiles: list[tuple[str, Html | None]] = [
        ("state", state_mark(snapshot.run.state, paused=snapshot.paused)),
        ("experiments", join((done, budget))),
        (f"{view.v_name}, the best", subject.v(best) if best is not None else None),
        ("spent on them", subject.over("evaluated", "seconds", "sum", "duration")),
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
    return join((tag("dl", *shown, class_="tiles"), trouble))


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
    answer = tag("p", id="steered", role="status")
    summary = tag("summary", "Steer this search")
    inner = tag("div", note, tag("p", *buttons, class_="buttons"), answer)
    return tag("details", summary, inner, class_="steering", data_at=run_address(name))


def _later(name: str, one: Section) -> Html | None:
    """A section of the report, which the page asks for when it is there."""
    address = f"{run_address(name)}/sections/{one.key}"
    return section(one.key, one.title, tag("div", class_="later", data_part=address))


def section_part(snapshot: Snapshot, key: str) -> Html | None:
    """Write the content of a section; None if the run has nothing for it, or there is no such
    section.
    """
    found = next((one for one in SECTIONS if one.key == key and key not in _OWN), None)
    inner = None if found is None else found.write(snapshot.subject)
    return None if inner is None else to_pages(inner, snapshot.run.name)


def _progress(snapshot: Snapshot) -> Html | None:
    figure = tag(
        "div",
        progress_part(snapshot.subject),
        id="curve",
        data_curve=f"{run_address(snapshot.run.name)}/curve",
    )
    return section("progress", "Progress of the search", figure)


def progress_part(subject: Subject) -> Html:
    """V of every experiment."""
    finished = subject.view.finished
    return progress_figure(subject, finished) if finished else tag("p", "There is no result yet.")


def _experiments(snapshot: Snapshot) -> Html | None:
    kinds = (("", "all"), ("kept", "kept"), ("other", "not kept"), ("failed", "without a score"))
    options = [tag("option", words, value=kind) for kind, words in kinds]
    choose = tag(
        "p",
        tag("label", "Show ", tag("select", *options, id="kind")),
        tag("label", " with the words ", tag("input", id="words", type="search")),
        class_="choose",
    )
    listed = tag(
        "div",
        experiment_rows(snapshot.subject),
        id="rows",
        class_="rows",
        tabindex="0",
        role="region",
        aria_label="Experiments, the last one first",
    )
    return section("experiments", "Experiments", choose, listed)


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
    ended = [e for e in changed if e.result is not None]
    said = "" if first or not ended else _spoken(ended[0])
    data = {"rows": rows, "parts": {"now": now_panel(snapshot)}, "said": said}
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


def _spoken(experiment: Experiment) -> str:
    result, score = experiment.result, experiment.score
    assert result is not None
    value = f"V {error_value(score.value)}" if score is not None else "no score"
    title = one_line(experiment.proposed.title, 100)
    return f"Experiment {experiment.number}, {result.status}, {value}: {title}"
