"""Report page of a run, assembled from its sections."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Final

from asia._boundary import diagnostic
from asia.errors import InternalError
from asia.ledger import Run, open_run, write_whole
from asia.problem.load import load_lock
from asia.report._page.audit import audit
from asia.report._page.html import Html, join, said, tag
from asia.report._page.section import Section
from asia.report._page.sections import SECTIONS
from asia.report._page.subject import Detail, Subject

LIMIT: Final = 1_500_000
"""Most bytes of a page."""

# The first that fits is taken: sources leave a long search first, then stories, then rows.
DETAILS: Final = (
    Detail(sources=1_000, stories=2_000, rows=5_000),
    Detail(sources=100, stories=300, rows=2_000),
    Detail(sources=30, stories=100, rows=600),
    Detail(sources=0, stories=20, rows=150),
)
# Nothing is loaded from anywhere, and nothing runs.
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'"


def write_page(directory: Path) -> Path:
    """Write `<directory>/report/report.html`. Raises UserError as `open_run` and `load_lock`,
    InternalError where a number of the page is not what the ledger says; nothing is written
    then."""
    run = open_run(directory)
    page = page_of(run)
    path = directory / "report" / "report.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, page.encode("utf-8", "replace"), durable=False)
    return path


def page_of(run: Run, sections: Sequence[Section] = SECTIONS) -> str:
    """The page, checked against the ledger. Raises as `write_page`."""
    problem = load_lock(run.directory / "problem.lock.toml") if run.store.kept else None
    for detail in DETAILS:
        page = _whole(Subject(run, problem, detail), sections)
        if len(page.encode("utf-8", "replace")) <= LIMIT:
            audit(page, run.directory, len(run.lines))
            return page
    raise InternalError(f"report: the page has more than {LIMIT} bytes with least detail")


def _whole(subject: Subject, sections: Sequence[Section]) -> str:
    written = [(section, _written(section, subject)) for section in sections]
    shown = [(section, inner) for section, inner in written if inner is not None]
    name = subject.view.started.run
    links = [tag("li", tag("a", one.title, href=f"#{one.key}")) for one, _ in shown]
    parts = (
        tag("a", "Skip to the verdict", href="#verdict", class_="skiplink"),
        _header(subject),
        tag("nav", tag("ul", *links), aria_label="Sections"),
        tag("main", *(_section(section, inner) for section, inner in shown)),
        _footer(subject),
    )
    return document(f"{name}: report of a search", parts)


def _written(section: Section, subject: Subject) -> Html | None:
    failed: list[str] = []
    with diagnostic(f"section '{section.title}'", failed):
        return section.write(subject)
    return tag("p", said(failed[0], 600))


def document(title: str, parts: Sequence[Html]) -> str:
    """A whole HTML file with the style in it."""
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        tag("meta", name="color-scheme", content="light dark"),
        tag("title", title),
        tag("style", Html(_style())),
    )
    return f"<!doctype html>\n{tag('html', head, tag('body', *parts), lang='en')}\n"


def _section(section: Section, inner: Html) -> Html:
    heading = f"h-{section.key}"
    title = tag("h2", section.title, id=heading)
    return tag("section", title, inner, id=section.key, aria_labelledby=heading)


def _header(subject: Subject) -> Html:
    start = subject.view.started
    text = (
        "problem ", said(start.problem), " · agent ", said(start.agent), " · seed ",
        subject.number(start, "seed", "text"), " · isolation ", said(start.isolation_words),
    )  # fmt: skip
    kind = tag("p", "ASIA, report of a search", class_="kind")
    return tag("header", kind, tag("h1", said(start.run)), tag("p", *text))


def _footer(subject: Subject) -> Html:
    version = subject.view.started.environment.get("asia-sysid", "")
    text = (
        "Every number on this page comes from an event of the ledger, and was checked against it "
        "when the page was written. Hold the pointer over a number to see its event."
    )
    return tag("footer", tag("p", text), tag("p", "ASIA ", said(version)))


def _style() -> str:
    file = resources.files("asia").joinpath("report", "_page", "page.css")
    return join([Html(file.read_text("utf-8"))])
