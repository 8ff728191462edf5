"""Page of a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from markupsafe import Markup

from asia._diagnostic import diagnostic
from asia._text import one_line
from asia.errors import InternalError
from asia.ledger.chain import write_whole
from asia.ledger.run import Run, open_run
from asia.problem.load import load_lock
from asia.report.page.render import page_style, render
from asia.report.page.sections import page_sections
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


def page_of(run: Run, sections: Sequence[Section] | None = None) -> str:
    """The page. Raises as `write_page`."""
    problem = load_lock(run.directory / "problem.lock.toml") if run.store.kept else None
    for detail in DETAILS:
        page = _whole(Subject(run, problem, detail), sections or page_sections())
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
