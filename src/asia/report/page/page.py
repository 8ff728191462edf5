"""Page of a run, and sites of many runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Final

from markupsafe import Markup

from asia._diagnostic import diagnostic
from asia._text import one_line
from asia.errors import InternalError, UserError
from asia.ledger.chain import write_whole
from asia.ledger.run import Run, open_run
from asia.problem.load import load_lock
from asia.report.page.render import page_style, render
from asia.report.page.sections import SECTIONS
from asia.report.page.sections.verdict import stamp
from asia.report.page.subject import Detail, Section, Subject

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


def write_page(directory: Path) -> Path:
    """Write all about the run in `directory` on one page, `<directory>/report/report.html`, which
    opens offline; the same ledger gives the same bytes.

    Raises UserError when `directory` is not a run, or its records, artifacts or training data are
    not what they were.
    """
    page = page_of(open_run(directory))
    path = directory / "report" / "report.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, page.encode("utf-8", "replace"), durable=False)
    return path


def page_of(run: Run, sections: Sequence[Section] = SECTIONS) -> str:
    """The page. Raises as `write_page`."""
    problem = load_lock(run.directory / "problem.lock.toml") if run.store.kept else None
    for detail in DETAILS:
        page = _whole(Subject(run, problem, detail), sections)
        if len(page.encode("utf-8", "replace")) <= LIMIT:
            return page
    raise InternalError(f"report: the page has more than {LIMIT} bytes with least detail")


def _whole(subject: Subject, sections: Sequence[Section]) -> str:
    parts: list[tuple[str, str, Markup]] = []
    for one in sections:
        failed: list[str] = []
        inner: Markup | None = None
        with diagnostic(f"section '{one.title}'", failed):
            inner = one.write(subject)
        if failed:
            inner = Markup("<p>{}</p>").format(one_line(failed[0], 600))
        if inner is not None:
            parts.append((one.key, one.title, inner))
    return render("report.html", subject=subject, parts=parts, style=page_style())


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
    groups = [
        (name, v_name, [(Subject(run, None, DETAILS[-1]), stamp(run.view)) for run in group])
        for (name, _, v_name), group in groupby(ordered, key=compared)
    ]
    return render("index.html", groups=groups, style=page_style())
