"""Page of a run, checked against its ledger before it is written; and sites of many runs."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html.parser import HTMLParser
from itertools import groupby, islice
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from asia._diagnostic import diagnostic
from asia._files import PACKAGE
from asia.errors import InternalError, UserError
from asia.ledger.artifacts import Store
from asia.ledger.chain import read_lines, write_whole
from asia.ledger.events import Event
from asia.ledger.run import Run, open_run
from asia.problem.load import load_lock
from asia.report.page.html import FORMS, ONE, RULES, Html, follow, join, said, section, table, tag
from asia.report.page.sections import SECTIONS
from asia.report.page.sections.verdict import stamp
from asia.report.page.subject import Detail, Section, Subject

# The audit shares nothing with the sections: it reads the finished page and the ledger.


_FREE = frozenset({"code", "pre", "svg", "math", "style", "title", "kbd"})
_FREE_CLASSES = frozenset({"said", "fixed", "scale"})
_VOID = frozenset({"meta", "br", "hr", "img", "input", "link", "wbr"})


def audit(page: str, directory: Path, events: int) -> int:
    """Check every number of a page against the ledger.

    Args:
        page: the HTML page.
        directory: run directory.
        events: number of events of the ledger that the page covers.

    Returns:
        The number of checked numbers.

    Raises:
        InternalError: a number differs from the ledger or names no source; the message names the
            first one.
    """
    lines = islice(read_lines(directory / "ledger.jsonl"), events)
    reader = _Reader([line.event for line in lines], directory / "artifacts")
    reader.feed(page)
    reader.close()
    return reader.checked


class _Reader(HTMLParser):
    """Parser of the page. A text with a digit must be in a checked element, or in one that is
    quoted, code, or drawn.
    """

    def __init__(self, events: list[Event], artifacts: Path) -> None:
        super().__init__(convert_charrefs=True)
        self.checked = 0
        self._events = events
        self._named = "\n".join(map(str, events))
        self._artifacts = artifacts
        self._open: list[tuple[str, bool]] = []
        self._number: dict[str, str] | None = None
        self._shown = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {key: value or "" for key, value in attrs}
        if tag in _VOID:
            return
        free = tag in _FREE or bool(_FREE_CLASSES & set(found.get("class", "").split()))
        self._open.append((tag, free or self._free))
        if "data-from" in found:
            self._number, self._shown = found, ""

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        if "data-from" in found:
            raise InternalError(f"report: <{tag}> names {found['data-from']} and shows no number")

    def handle_data(self, data: str) -> None:
        if self._number is not None:
            self._shown += data
        elif re.search(r"\d", data) and not self._free:
            line = " ".join(data.split())[:80]
            raise InternalError(f"report: a number without a source in '{line}'")

    def handle_endtag(self, tag: str) -> None:
        if not self._open or self._open[-1][0] != tag:
            raise InternalError(f"report: </{tag}> closes nothing")
        self._open.pop()
        if self._number is not None:
            self._check(self._number, self._shown)
            self._number = None

    @property
    def _free(self) -> bool:
        return bool(self._open) and self._open[-1][1]

    def _check(self, number: dict[str, str], shown: str) -> None:
        sources, rule = number["data-from"], number.get("data-rule", ONE)
        try:
            result = RULES[rule](self._values(sources))
            expected = FORMS[number["data-as"]](result)
        except (
            LookupError,
            AttributeError,
            TypeError,
            ValueError,
            ArithmeticError,
            UserError,
        ) as error:
            raise InternalError(
                f"report: the number {shown} names {sources}, where none is: {error!r}"
            ) from error
        if shown != expected or number.get("value") != str(result):
            raise InternalError(
                f"report: the page says {shown} where the ledger, {sources} ({rule}), says "
                f"{expected}"
            )
        self.checked += 1

    def _values(self, sources: str) -> list[Any]:
        """Return the values of all sources, in order."""
        found: list[Any] = []
        for one in sources.split(" "):
            name, _, path = one.partition(":")
            if name.isdecimal():
                documents: list[Any] = [self._events[int(name)]]
            elif re.fullmatch(r"[0-9a-f]{64}", name):
                if name not in self._named:
                    raise KeyError(f"no event names the artifact {name}")
                documents = [json.loads(Store(self._artifacts).get(name))]
            else:
                documents = [event for event in self._events if event.event == name]
            for document in documents:
                found += follow(document, path)
        return found


# Report page of a run, assembled from its sections.


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
    """Write all about the run in `directory` on one page, `<directory>/report/report.html`, which
    opens offline; the same ledger gives the same bytes.

    Raises UserError when `directory` is not a run, or its records, artifacts or training data are
    not what they were, and InternalError, before anything is written, where a number of the page is
    not what the ledger says.
    """
    page = page_of(open_run(directory))
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
    start = subject.view.started
    links: list[Html] = []
    parts: list[Html | None] = []
    for one in sections:
        failed: list[str] = []
        inner: Html | None = None
        with diagnostic(f"section '{one.title}'", failed):
            inner = one.write(subject)
        if failed:
            inner = tag("p", said(failed[0], 600))
        if inner is not None:
            links.append(tag("li", tag("a", one.title, href=f"#{one.key}")))
            parts.append(section(one.key, one.title, inner))
    note = (
        "Every number on this page comes from an event of the ledger, and was checked against it "
        "when the page was written. Hold the pointer over a number to see its event."
    )
    kind = tag("p", "ASIA, report of a search", class_="kind")
    version = said(start.environment.get("asia-sysid", ""))
    body = (
        tag("a", "Skip to the verdict", href="#verdict", class_="skiplink"),
        tag("header", kind, tag("h1", said(start.run)), tag("p", subject.setting)),
        tag("nav", tag("ul", *links), aria_label="Sections"),
        tag("main", *parts),
        tag("footer", tag("p", note), tag("p", "ASIA ", version)),
    )
    return document(f"{start.run}: report of a search", body)


def page_style() -> str:
    """The style sheet of the page."""
    return (PACKAGE / "report" / "page" / "page.css").read_text("utf-8")


def document(title: str, parts: Sequence[Html]) -> str:
    """A whole HTML file with the style in it."""
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        tag("meta", name="color-scheme", content="light dark"),
        tag("title", title),
        tag("style", Html(page_style())),
    )
    return f"<!doctype html>\n{tag('html', head, tag('body', *parts), lang='en')}\n"


# A static site of many runs: a list, and the page of each.


@dataclass(frozen=True)
class PublishedRuns:
    """Files that were written."""

    index: Path
    """The list."""
    pages: tuple[Path, ...]
    """A page a run."""
    left_out: tuple[str, ...]
    """Runs without a page, and why, in words."""


def write_bundle(runs: Path, directory: Path) -> PublishedRuns:
    """A static site of the runs below `runs` into `directory`, to publish: `index.html` and a page
    for each run. Runs whose data or artifacts are not what they were are left out, and named.
    Raises UserError where there is no run."""
    found = sorted(path.parent for path in runs.glob("*/ledger.jsonl"))
    if not found:
        raise UserError(f"no runs under {runs}; start one with: asia run PROBLEM")
    directory.mkdir(parents=True, exist_ok=True)
    pages: list[Path] = []
    shown: list[Run] = []
    left_out: list[str] = []
    for place in found:
        try:
            run = open_run(place)
            page = page_of(run)
        except UserError as error:
            left_out.append(f"{place.name}: {error}")
            continue
        path = directory / f"{place.name}.html"
        write_whole(path, page.encode("utf-8", "replace"), durable=False)
        pages.append(path)
        shown.append(run)
    index = directory / "index.html"
    write_whole(index, _index(shown).encode("utf-8", "replace"), durable=False)
    return PublishedRuns(index, tuple(pages), tuple(left_out))


def _index(runs: Sequence[Run]) -> str:
    """Runs of one problem, protocol and setting stand in one table, the best V first: V of others
    does not compare with it."""

    def compared(run: Run) -> tuple[str, str, str]:
        return run.view.started.problem, run.view.started.protocol_digest, run.view.v_name

    def value(run: Run) -> float:
        found = run.view.best_value
        return float("inf") if found is None else found

    ordered = sorted(runs, key=lambda run: (*compared(run), value(run), run.name))
    tables: list[Html] = []
    for (name, _, v_name), group in groupby(ordered, key=compared):
        head = ["run", "verdict", v_name, "best candidate", "experiments", "agent", "seed"]
        inner = table(head, [_row(run) for run in group], f"Searches on {name}")
        tables.append(tag("section", tag("h2", said(name)), inner))
    header = tag("header", tag("p", "ASIA", class_="kind"), tag("h1", "Searches"))
    text = tag("p", "Runs stand in one table where their V can be compared.")
    return document("Searches", (header, tag("main", text, *tables)))


def _row(run: Run) -> list[Html]:
    """Cells of the list, checked against the ledger of their own run."""
    subject = Subject(run, None, DETAILS[-1])
    best, start = run.view.best, run.view.started
    text, kind = stamp(subject)
    cells = [
        tag("a", said(run.name), href=quote(f"{run.name}.html")),
        tag("span", text, class_=f"stamp small {kind}"),
        subject.v(best) if best is not None else tag("span", "no score"),
        said(best.proposed.title, 60) if best is not None else tag("span"),
        subject.over("evaluated", "experiment", "count", "count"),
        said(start.agent),
        subject.number(start, "seed", "text"),
    ]
    audit(join(cells), run.directory, len(run.lines))
    return cells
