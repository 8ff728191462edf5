"""The page of one run: what is known now, the curve, the list, and the report's sections."""

from __future__ import annotations

from typing import Final

from asia.agents import reads_notes
from asia.report.pieces import SECTIONS, Html, Section, Subject, join, progress_figure, said, tag
from asia.view._followed import Snapshot
from asia.view.pages.frame import run_address, section, to_pages, whole_page
from asia.view.pages.rows import experiment_rows
from asia.view.pages.runs import state_mark

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
