"""Page of a run, checked against its ledger before it is written; and sites of many runs."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from html.parser import HTMLParser
from importlib import resources
from itertools import groupby
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from asia._diagnostic import diagnostic
from asia.errors import InternalError, UserError
from asia.ledger.artifacts import Store
from asia.ledger.chain import write_whole
from asia.ledger.run import Run, open_run
from asia.problem.load import load_lock
from asia.report.page.html import FORMS, ONE, RULES, Html, follow, join, said, table, tag
from asia.report.page.sections import SECTIONS
from asia.report.page.sections.verdict import (
    stamp,
)
from asia.report.page.subject import Detail, Section, Subject

# The check of a page against its ledger, before it is written.
#
# The audit shares nothing with the sections: it reads the finished page and the bytes of the
# ledger.


_FREE = frozenset({"code", "pre", "svg", "math", "style", "title", "kbd"})
_FREE_CLASSES = frozenset({"said", "fixed", "scale"})
_VOID = frozenset({"meta", "br", "hr", "img", "input", "link", "wbr"})
_DIGIT = re.compile(r"\d")
_SHA = re.compile(r"[0-9a-f]{64}")


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
    reader = _Reader(_Sources(directory, events))
    reader.feed(page)
    reader.close()
    return reader.checked


class _Sources:
    """The values that a page may name."""

    def __init__(self, directory: Path, events: int) -> None:
        lines = (directory / "ledger.jsonl").read_bytes().split(b"\n")
        self._events: list[dict[str, Any]] = [json.loads(line) for line in lines[:events]]
        self._directory = directory
        self._named = "\n".join(map(str, self._events))
        self._lock: dict[str, Any] | None = None

    def values(self, sources: str) -> list[Any]:
        """Return the values of all sources, in order."""
        found: list[Any] = []
        for one in sources.split(" "):
            name, _, path = one.partition(":")
            for document in self._documents(name):
                found += follow(document, path)
        return found

    def _documents(self, name: str) -> list[Any]:
        if name.isdecimal():
            return [self._events[int(name)]]
        if name == "lock":
            return [self._read_lock()]
        if _SHA.fullmatch(name):
            if name not in self._named:
                raise KeyError(f"no event names the artifact {name}")
            return [json.loads(Store(self._directory / "artifacts").get(name))]
        return [event for event in self._events if event["event"] == name]

    def _read_lock(self) -> dict[str, Any]:
        if self._lock is None:
            text = (self._directory / "problem.lock.toml").read_text("utf-8")
            self._lock = tomllib.loads(text)
        return self._lock


class _Reader(HTMLParser):
    """Parser of the page. A text with a digit must be in a checked element, or in one that is
    quoted, code, or drawn.
    """

    def __init__(self, sources: _Sources) -> None:
        super().__init__(convert_charrefs=True)
        self.checked = 0
        self._sources = sources
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
        elif _DIGIT.search(data) and not self._free:
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
            result = RULES[rule](self._sources.values(sources))
            expected = FORMS[number["data-as"]](result)
        except (KeyError, TypeError, ValueError, IndexError, ArithmeticError, UserError) as error:
            raise InternalError(
                f"report: the number {shown} names {sources}, where none is: {error!r}"
            ) from error
        if shown != expected or number.get("value") != str(result):
            raise InternalError(
                f"report: the page says {shown} where the ledger, {sources} ({rule}), says "
                f"{expected}"
            )
        self.checked += 1


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
    file = resources.files("asia").joinpath("report", "page", "page.css")
    return join([Html(file.read_text("utf-8"))])


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
    """See `asia.report.write_bundle`."""
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
    ordered = sorted(runs, key=lambda run: (*_compared(run), _value(run), run.name))
    tables = [_table(list(group)) for _, group in groupby(ordered, key=_compared)]
    header = tag("header", tag("p", "ASIA", class_="kind"), tag("h1", "Searches"))
    text = tag("p", "Runs stand in one table where their V can be compared.")
    return document("Searches", (header, tag("main", text, *tables)))


def _compared(run: Run) -> tuple[str, str, str]:
    start = run.view.started
    return start.problem, start.protocol_digest, run.view.v_name


def _value(run: Run) -> float:
    best = run.view.best
    return best.score.value if best is not None and best.score is not None else float("inf")


def _table(runs: Sequence[Run]) -> Html:
    name = runs[0].view.started.problem
    head = ["run", "verdict", runs[0].view.v_name, "best candidate", "experiments", "agent", "seed"]
    inner = table(head, [_row(run) for run in runs], f"Searches on {name}")
    return tag("section", tag("h2", said(name)), inner)


def _row(run: Run) -> list[str | None]:
    """Checked against the ledger of its own run."""
    subject = Subject(run, None, DETAILS[-1])
    best, start = run.view.best, run.view.started
    link = tag("a", said(run.name), href=quote(f"{run.name}.html"))
    text, kind = stamp(subject)
    cells: list[Html] = [
        link,
        tag("span", text, class_=f"stamp small {kind}"),
        subject.v(best) if best is not None else tag("span", "no score"),
        said(best.proposed.title, 60) if best is not None else tag("span"),
        subject.over("evaluated", "experiment", "count", "count"),
        said(start.agent),
        subject.number(start, "seed", "text"),
    ]
    audit(join(cells), run.directory, len(run.lines))
    return list(cells)


# Parts of the report page of a run, for other presentations than one file.


def page_style() -> str:
    """The style sheet of the page."""
    file = resources.files("asia").joinpath("report", "page", "page.css")
    return file.read_text("utf-8")
