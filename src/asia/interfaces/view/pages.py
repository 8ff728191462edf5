"""Pages of the live view: list of runs, run, experiment, comparison."""

from __future__ import annotations

import getpass
import hashlib
import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal
from urllib.parse import urlencode

import numpy as np
from markupsafe import Markup

from asia._text import one_line, printable_line
from asia.agents.registry import reads_notes
from asia.analysis.importance import LEAST_EXPERIMENTS, settings_importance
from asia.analysis.verdict import alarms, unguarded
from asia.errors import UserError
from asia.interfaces.view.followed import ListedRun, RunFolder, Snapshot
from asia.interfaces.view.render import experiments_of, fill, run_address
from asia.ledger.events import Evaluated, Proposed
from asia.ledger.view import Experiment
from asia.presentation.evidence import recorded_evidence
from asia.presentation.experiments import decision_text, describe_result
from asia.presentation.table import error_value
from asia.recipe import Recipe, read_recipe
from asia.report.page.render import picture
from asia.report.page.sections import page_sections
from asia.report.page.sections.experiments import experiment_story, progress_figure, status_of
from asia.report.page.sections.verdict import draw_panel
from asia.report.page.subject import Detail, Subject
from asia.report.pictures.experiments import Kind, Span, draw_timeline
from asia.report.pictures.simulation import simulation_panels

# The page of one experiment: its story, its simulations, its code.


def experiment_page(snapshot: Snapshot, number: int, token: str) -> str:
    """The page of an experiment. Raises UserError where there is none of that number."""
    name, experiment = snapshot.run.name, snapshot.run.view.experiment(number)
    return fill(
        "experiment_page.html",
        token=token,
        title=f"#{experiment.number:02d} {experiment.proposed.title[:80]}",
        trail=(("Searches", "/"), (name, run_address(name))),
        snapshot=snapshot,
        number=number,
        part=experiment_part(snapshot, number),
        user=getpass.getuser(),
    )


def experiment_part(snapshot: Snapshot, number: int) -> Markup:
    """Write the content of the page.

    Raises:
        UserError: there is no such experiment.
    """
    # Every source, story and row.
    detail = Detail(sources=10**9, stories=10**9, rows=10**9)
    subject = replace(snapshot.subject, detail=detail)
    run, store = subject.run, subject.run.store
    e, link = subject.view.experiment(number), experiments_of(subject.run.name)
    others = [
        (other, text, rel)
        for other, text, rel in (
            (e.number - 1, "‹ previous", "prev"),
            (e.number + 1, "next ›", "next"),
            (e.proposed.parent or 0, "parent", "up"),
        )
        if 1 <= other <= len(subject.view.experiments)
    ]
    best, compare = subject.view.best, ""
    if e.score is not None and best is not None and best.number != e.number:
        compare = urlencode([("e", f"{run.name}/{number}") for number in (best.number, e.number)])

    boxes: list[Markup] = []
    notes = ""
    if subject.problem is not None and e.score is not None:
        panels, notes = simulation_panels(run, subject.problem, e, subject.folds)
        boxes = [
            zoomable(f"{link}{e.number}/overlays/{k}", draw_panel(subject.problem, one), len(one))
            for k, one in enumerate(panels)
        ]

    return fill(
        "experiment.html",
        subject=subject,
        e=e,
        link=link,
        status=status_of(subject, e),
        others=others,
        compare=compare,
        story=experiment_story(subject, e, link),
        boxes=boxes,
        notes=notes,
        lines=recorded_evidence(run, e),
        source=store.text(e.source) if store.kept else None,
    )


_ZOOMS: Final = (
    ("in", "+", "zoom in"),
    ("out", "−", "zoom out"),
    ("left", "◂", "move to earlier samples"),
    ("right", "▸", "move to later samples"),
    ("all", "all", "show all samples"),
)


def zoomable(address: str, drawn: Markup, count: int) -> Markup:
    """An overlay with buttons to see a part of it.

    Args:
        address: where other parts of it are
        drawn: all of it
        count: number of its samples
    """
    name = f"overlay-{digest_of(address)}"
    return fill("zoomable.html", address=address, drawn=drawn, count=count, name=name, zooms=_ZOOMS)


def overlay_part(
    snapshot: Snapshot, number: int, index: int, first: int, last: int | None
) -> Markup:
    """Samples `first` to `last` of an overlay, drawn. Raises UserError where there is none."""
    subject = snapshot.subject
    e, problem = subject.view.experiment(number), subject.problem
    if problem is not None and e.score is not None:
        panels, _ = simulation_panels(subject.run, problem, e, subject.folds)
        if 0 <= index < len(panels):
            return draw_panel(problem, panels[index].cut(first, last))
    raise UserError(f"experiment {number} has no picture {index}")


# The list of runs.


def runs_page(
    folder: Path,
    listed: Sequence[ListedRun],
    digest: str,
    token: str,
    start: tuple[Sequence[str], Sequence[str]] | None,
) -> str:
    """The page with the list of the runs of a folder. start: problems and agents of the form that
    starts a search; None for no form."""
    return fill(
        "runs_page.html",
        token=token,
        title="Searches",
        trail=(),
        name=folder.name or str(folder),
        listed=runs_table(listed),
        digest=digest,
        start=start,
    )


def runs_table(listed: Sequence[ListedRun]) -> Markup:
    """A row a run."""
    changed = [datetime.fromtimestamp(one.changed).strftime("%d %b %H:%M") for one in listed]
    return fill("runs.html", runs=list(zip(listed, changed, strict=True)))


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

    def place(self, e: Experiment, subject: Subject) -> Markup | None:
        """Show where the first of the words stands, marked, with the text around it."""
        word = next(iter(self.words.split()), "")
        for name, text in _texts(e, subject) if word else ():
            line = printable_line(" ".join(text.split()))
            found = re.search(re.escape(word), line, re.IGNORECASE)
            if found:
                before, after = line[: found.start()], line[found.end() :][:200]
                if len(before) > 40:
                    before = f"… {before[-40:].partition(' ')[2]}"
                shown = Markup("{}: {}<mark>{}</mark>{}")
                return shown.format(name, before, found[0], after)
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


def experiment_row(subject: Subject, e: Experiment, chosen: Chosen = Chosen()) -> Markup:
    """Write one experiment, its title and below it the reason of its status, or where the words
    stand that were searched."""
    return fill(
        "row.html",
        subject=subject,
        e=e,
        kind=_kind(e),
        status=status_of(subject, e),
        reason=chosen.place(e, subject) or one_line(decision_text(e, subject.view)),
    )


def experiment_rows(
    subject: Subject, chosen: Chosen, after: int | None = None, most: int = FIRST
) -> Markup:
    """At most `most` of the chosen experiments, those after a number in their order, in parts; with
    a button for the others."""
    every = chosen.of(subject)
    place = next((k for k, e in enumerate(every, 1) if e.number == after), 0)
    shown = every[place : place + min(most, MOST)]
    parts = [
        [experiment_row(subject, e, chosen) for e in shown[k : k + CHUNK]]
        for k in range(0, len(shown), CHUNK)
    ]
    return fill(
        "rows.html",
        parts=parts,
        is_empty=not every and chosen != Chosen(),
        more=shown[-1].number if len(every) > place + len(shown) else None,
    )


# The page of one run: what is known now, the curve, the list, and the report's sections.


# These are written here, so that they can change line by line.
_OWN: Final = ("progress", "experiments")
GALLERY: Final = "simulations"
"""Key of the page with the simulations of all experiments."""


def tabs(snapshot: Snapshot, here: str = "") -> Markup:
    """Links to the pages of a run."""
    found = {"": "Search", GALLERY: "Simulations"}
    for one in page_sections():
        if any((snapshot.run.directory / file).exists() for file in one.files):
            found[one.key] = one.title
    return fill("tabs.html", tabs=found, here=here, name=snapshot.run.name)


def tab_page(snapshot: Snapshot, key: str, token: str) -> str:
    """The page of a tab. Raises UserError where the run has nothing for it."""
    found = next((one for one in page_sections() if one.key == key and one.files), None)
    inner = None if found is None else found.write(snapshot.subject)
    name = snapshot.run.name
    if found is None or inner is None:
        raise UserError(f"run '{name}' has no page '{key}'")
    return fill(
        "tab_page.html",
        token=token,
        title=f"{name}: {found.title}",
        trail=(("Searches", "/"),),
        name=name,
        tabs=tabs(snapshot, key),
        found=found,
        inner=inner,
    )


def run_page(snapshot: Snapshot, token: str, chosen: Chosen) -> str:
    """The page of a run, with the chosen experiments."""
    subject, name = snapshot.subject, snapshot.run.name
    own = [(one.key, one.title) for key in _OWN for one in page_sections() if one.key == key]
    others = [
        (one.key, one.title) for one in page_sections() if one.key not in _OWN and not one.files
    ]
    place = [key for key, _ in others].index("tradeoff") + 1
    others[place:place] = [(key, title) for key, (title, _) in _LIVE.items()]
    start = subject.view.started
    return fill(
        "run_page.html",
        token=token,
        title=name,
        trail=(("Searches", "/"),),
        snapshot=snapshot,
        subject=subject,
        tabs=tabs(snapshot),
        now=now_panel(snapshot),
        steering=steering_panel(
            name,
            running=snapshot.run.state == "running",
            deaf="" if reads_notes(start) else start.agent,
        ),
        named=(*own, *others),
        # The page asks for the other sections when it is there.
        later=others,
        curve=progress_part(subject),
        form=choice_form(chosen),
        rows=experiment_rows(subject, chosen),
        query=urlencode({"run": name}),
        user=getpass.getuser(),
    )


def choice_form(chosen: Chosen, *, with_button: bool = False) -> Markup:
    """Form that chooses and sorts experiments. with_button: true for a button that shows them."""
    return fill("choice.html", chosen=chosen, kinds=KINDS, orders=ORDERS, with_button=with_button)


def now_panel(snapshot: Snapshot) -> Markup:
    """Write the state of the search in a few figures."""
    view = snapshot.run.view
    curves = [
        (f"#{number:02d}, " if len(view.running) > 1 else "", fold, json.dumps(curve), curve[-1])
        for number, folds in sorted(snapshot.losses.items())
        for fold, curve in sorted(folds.items())
    ]
    return fill(
        "now.html",
        snapshot=snapshot,
        subject=snapshot.subject,
        curves=curves,
        alarms=[*alarms(view), *filter(None, [unguarded(view)])],
    )


def steering_panel(name: str, *, running: bool, deaf: str = "") -> Markup:
    """Form for notes and buttons to pause and stop. deaf: the agent, where it reads no notes."""
    return fill("steering.html", name=name, running=running, deaf=deaf)


def section_part(snapshot: Snapshot, key: str) -> Markup | None:
    """Write the content of a section; None if the run has nothing for it, or there is no such
    section.
    """
    others = [one for one in page_sections() if one.key not in _OWN and not one.files]
    if key in _LIVE:
        return _LIVE[key][1](snapshot)
    found = next((one for one in others if one.key == key), None)
    link = experiments_of(snapshot.run.name)
    return None if found is None else found.write(snapshot.subject, link)


# Settings that go with a low V.


def importance_part(snapshot: Snapshot) -> Markup | None:
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
    rows = [
        [
            f"{one.family} {one.setting}",
            f"{one.values}",
            f"{one.experiments}",
            f"{100 * one.share:.0f} %",
            f"{min(one.probability, 1):.2g}",
        ]
        for one in settings_importance(tried)
    ]
    return fill(
        "importance.html",
        rows=rows,
        least=LEAST_EXPERIMENTS,
        missing=", ".join(f"{name} {LEAST_EXPERIMENTS - n} more" for name, n in few),
        is_complete=len(few) < len(counts),
    )


# Times of the evaluations.


def timeline_part(snapshot: Snapshot) -> Markup | None:
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
    return fill("timeline.html", start=start, end=end, drawn=drawn)


def _ends(times: Sequence[float], now: float) -> tuple[float, float]:
    return times[0], times[-1] if len(times) > 1 else now


_LIVE: Final = {
    "importance": ("Settings", importance_part),
    "timeline": ("Timeline", timeline_part),
}
"""Titles and writers of the sections that the report does not have, by their keys."""


def progress_part(subject: Subject) -> Markup:
    """V of every experiment."""
    if subject.view.finished:
        return progress_figure(subject)
    return Markup("<p>There is no result yet.</p>")


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
