"""A static site of many runs: a list, and the page of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from urllib.parse import quote

from asia.errors import UserError
from asia.ledger import Run, open_run, write_whole
from asia.report._page.audit import audit
from asia.report._page.html import Html, join, said, table, tag
from asia.report._page.page import DETAILS, document, page_of
from asia.report._page.sections.verdict import stamp
from asia.report._page.subject import Subject


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
