"""Comparison of runs, and of experiments whose simulations lie over the same measured outputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from urllib.parse import urlencode

from asia.agents.library.recipe import read_recipe
from asia.errors import UserError
from asia.interfaces.view.followed import Snapshot
from asia.interfaces.view.pages import run_address, state_mark, whole_page, zoomable
from asia.ledger.events import TestedModel
from asia.ledger.run import model_to_use, tested_model
from asia.ledger.view import Experiment
from asia.problem.problem import Problem
from asia.report.comparison import ArmCurves, ArmsPicture, Curve
from asia.report.page.html import Html, fixed, join, picture, region, said, section, table, tag
from asia.report.page.sections.experiments import COSTS, cost_of, status_of, tag_labels
from asia.report.page.sections.verdict import draw_panel, stamp
from asia.report.page.subject import Subject, result_of, v_form
from asia.report.pictures.progress import draw_arms
from asia.report.pictures.simulation import Panel, simulation_panels

_MOST_CHOICES = 40


@dataclass(frozen=True)
class Compared:
    """A run of a comparison, with the numbers of its chosen experiments; () for its best."""

    snapshot: Snapshot
    numbers: tuple[int, ...] = ()

    @property
    def subject(self) -> Subject:
        """Its subject."""
        return self.snapshot.subject

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.snapshot.run.name

    @cached_property
    def experiments(self) -> tuple[Experiment, ...]:
        """The chosen experiments. Raises UserError where one is not there."""
        view = self.subject.view
        best = () if view.best is None else (view.best,)
        return tuple(view.experiment(n) for n in self.numbers) or best

    @property
    def query(self) -> list[tuple[str, str]]:
        """The part of the address that names it."""
        return [("run", self.name), *(("e", f"{self.name}/{n}") for n in self.numbers)]


def comparison_page(compared: Sequence[Compared], token: str) -> str:
    """The page of a comparison."""
    streams = [
        tag(
            "span",
            data_stream=f"{run_address(one.name)}/events",
            data_mark=one.snapshot.mark,
            hidden=True,
        )
        for one in compared
    ]
    part = tag("div", comparison_part(compared), data_refresh=f"/compare/part?{_query(compared)}")
    header = tag("header", tag("h1", "Comparison"))
    trail = [("Searches", "/"), *((one.name, run_address(one.name)) for one in compared[:3])]
    title = ", ".join(one.name for one in compared)
    return whole_page(title, trail, (header, *streams, part, _chooser(compared)), token)


def _query(compared: Sequence[Compared]) -> str:
    return urlencode([pair for one in compared for pair in one.query])


def comparison_part(compared: Sequence[Compared]) -> Html:
    """Write the content of the page."""
    subjects = [one.subject for one in compared]
    axes = {one.view.v_name for one in subjects}
    warning = None
    if len({(s.view.started.problem, s.view.started.protocol_digest) for s in subjects}) > 1:
        warning = "The runs have different problems or protocols: do not compare their V."
    elif len(axes) > 1:
        warning = "V was computed under different rules in the runs: do not compare it."
    if warning is not None:
        warning = tag("p", warning, class_="trouble")
    curves = None
    if len(subjects) > 1:
        sides = tuple(
            ArmCurves(one.run.name, (Curve(tuple(e.value for e in one.view.finished)),))
            for one in subjects
        )
        title = "Best V so far over the experiments"
        arms = ArmsPicture("best", title, sides, (), subjects[0].run.metric)
        curves = picture(partial(draw_arms, arms), title)
    parts = (
        section("figures", "Runs", warning, _runs_table(subjects)),
        section("curves", "Best so far", curves),
        section("chosen", "Experiments", _experiments_table(compared)),
        section("settings", "Settings", _settings(compared)),
        section("overlays", "Measured and simulated", _overlays(compared)),
    )
    return join(parts)


def _together(compared: Sequence[Compared]) -> list[list[tuple[int, Subject, Experiment]]]:
    """Chosen experiments with a score in groups with the same held-out outputs, each with its
    number in the comparison."""
    groups: dict[tuple[str, ...], list[tuple[int, Subject, Experiment]]] = {}
    every = [(one.subject, e) for one in compared for e in one.experiments]
    for number, (subject, e) in enumerate(every):
        start = subject.view.started
        key = start.problem, start.protocol_digest, *start.folds
        if e.score is not None and subject.problem is not None:
            groups.setdefault(key, []).append((number, subject, e))
    return list(groups.values())


def _drawn(compared: Sequence[Compared]) -> list[tuple[Problem, Panel, tuple[str, ...]]]:
    """Every overlay, with the names of its experiments."""
    found: list[tuple[Problem, Panel, tuple[str, ...]]] = []
    labels = [f"{one.name} #{e.number:02d}" for one in compared for e in one.experiments]
    for group in _together(compared):
        (_, subject, first), *others = group
        assert subject.problem is not None
        names = tuple(labels[number] for number, _, _ in group)
        over = [(other.run, e) for _, other, e in others]
        panels, _ = simulation_panels(subject.run, subject.problem, first, subject.folds, over)
        found += [(subject.problem, one, names) for one in panels]
    return found


def _draw(problem: Problem, panel: Panel, names: Sequence[str]) -> Html:
    # The error in the title is that of the first one.
    panel = panel if len(names) == 1 else replace(panel, error="")
    return draw_panel(problem, panel, simulated=names[0], others=names[1:])


def _overlays(compared: Sequence[Compared]) -> Html:
    """The simulations of the chosen experiments over the measured outputs, group by group."""
    boxes = [
        zoomable(f"/compare/overlays/{index}?{_query(compared)}", _draw(*one), len(one[1]))
        for index, one in enumerate(_drawn(compared))
    ]
    parts = [tag("div", *boxes, class_="grid")] if boxes else []
    missing = [one for one in compared if one.snapshot.trouble]
    parts += [
        tag("p", said(f"{one.name}: no simulations, {one.snapshot.trouble}", 600), class_="trouble")
        for one in missing
    ]
    return join(parts) if parts else tag("p", "No chosen experiment has a score.")


def compared_overlay(
    compared: Sequence[Compared], index: int, first: int, last: int | None
) -> Html:
    """Samples `first` to `last` of an overlay, drawn. Raises UserError where there is none."""
    drawn = _drawn(compared)
    if not 0 <= index < len(drawn):
        raise UserError(f"the comparison has no picture {index}")
    problem, panel, names = drawn[index]
    return _draw(problem, panel.cut(first, last), names)


def _experiments_table(compared: Sequence[Compared]) -> Html | None:
    rows: list[list[str | None]] = []
    form = v_form([e for one in compared for e in one.experiments])
    for one in compared:
        for e in one.experiments:
            subject = one.subject
            address = f"{run_address(one.name)}/experiments/{e.number}"
            title = join((subject.name(e), " ", said(e.proposed.title, 80)))
            labels = tag_labels(subject.view.tags(e.number))
            status = status_of(subject, e)
            places = range(len(e.score.folds)) if e.score else ()
            folds = [subject.number(result_of(e), f"outcome.folds.{k}.value", "error")
                     for k in places]  # fmt: skip
            costs = [cost_of(subject, e, k) if e.result else None for k in range(len(COSTS))]
            rows.append([
                join((said(one.name), " ", tag("a", title, href=address), " ", labels)),
                tag("span", status, class_=f"status {status}"),
                subject.v(e, form) if e.score else "no score",
                join(folds, ", "),
                *(None if cost is None else cost[1] for cost in costs),
            ])  # fmt: skip
    head = ["experiment", "status", "V", "V of the folds", *(name for name, *_ in COSTS)]
    known = [k for k in range(len(head)) if k < 4 or any(row[k] for row in rows)]
    head, rows = [head[k] for k in known], [[row[k] for k in known] for row in rows]
    return table(head, rows, "Chosen experiments") if rows else None


def _settings(compared: Sequence[Compared]) -> Html | None:
    """Table of the settings of the chosen experiments, with a switch that leaves out those that are
    the same in all; None for a single experiment."""
    head: list[Html] = []
    columns: list[dict[str, str]] = []
    for one in compared:
        for e in one.experiments:
            label = join((said(one.name), " ")) if len(compared) > 1 else None
            address = f"{run_address(one.name)}/experiments/{e.number}"
            head.append(join((label, tag("a", one.subject.name(e), href=address))))
            columns.append(_settings_of(one, e))
    if len(columns) < 2:
        return None
    rows: list[Html] = []
    names = list(dict.fromkeys(name for column in columns for name in column))
    common = 0
    for name in names:
        values = [column.get(name, "") for column in columns]
        is_same = len(set(values)) == 1
        common += is_same
        cells = [tag("td", said(value, 200)) for value in values]
        title = tag("th", said(name), scope="row")
        rows.append(tag("tr", title, *cells, class_="same" if is_same else None))
    box = tag("input", type="checkbox", id="differing", checked=True)
    alike = f" ({common} {'is' if common == 1 else 'are'} the same)"
    switch = tag("p", tag("label", box, " differences only"), fixed(alike))
    if common == len(names):
        switch = join((switch, tag("p", "All settings are the same.")))
    inner = tag(
        "table",
        tag("caption", "Settings; empty: the default of the library"),
        tag("thead", tag("tr", *(tag("th", one, scope="col") for one in ("setting", *head)))),
        tag("tbody", *rows),
    )
    listed = region("div", inner, class_="scroll both differences", label="Settings")
    return join((switch, listed))


def _settings_of(one: Compared, e: Experiment) -> dict[str, str]:
    """Family, training method and settings of an experiment, by their names."""
    store = one.subject.run.store
    recipe = read_recipe(store.text(e.source)) if store.kept else None
    if recipe is None:
        return {"family": e.proposed.family, "training method": "own code"}
    settings = {
        name: ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)
        for name, value in recipe.settings.items()
    }
    return {"family": recipe.family, "training method": recipe.method, **settings}


def _chooser(compared: Sequence[Compared]) -> Html:
    """Form with the experiments of lowest V of each run, and those that are chosen."""
    lists: list[Html] = []
    for one in compared:
        scored = sorted(
            (e for e in one.subject.view.finished if e.score is not None),
            key=lambda e: e.score.value if e.score else 0.0,
        )[:_MOST_CHOICES]
        scored += [e for e in one.experiments if e not in scored]
        boxes = [
            tag("li", tag("label",
                tag("input", type="checkbox", name="e", value=f"{one.name}/{e.number}",
                    checked=e in one.experiments),
                " ", one.subject.name(e), " ", said(e.proposed.title, 80), " ",
                one.subject.v(e) if e.score else None,
            ))
            for e in scored
        ]  # fmt: skip
        title = tag("summary", said(one.name))
        kept = tag("input", type="hidden", name="run", value=one.name)
        lists.append(tag("details", title, kept, tag("ul", *boxes), open=len(compared) == 1))
    button = tag("button", "Show the chosen experiments", type="submit")
    form = tag("form", *lists, button, action="/compare", method="get", class_="chooser")
    chooser = section("choose", "Choose experiments", form)
    assert chooser is not None
    return chooser


def _runs_table(subjects: Sequence[Subject]) -> Html:
    def verdict(subject: Subject) -> Html:
        text, kind = stamp(subject)
        return tag("span", text, class_=f"stamp small {kind}")

    def best(subject: Subject) -> Html:
        found = subject.view.best
        return subject.v(found) if found is not None else tag("span", "no score")

    def reference(subject: Subject, name: str) -> Html:
        found = subject.reference(name)
        if found is None:
            return tag("span", "none")
        return subject.number(found[0], "outcome.value", "error")

    def tested(subject: Subject) -> Html:
        """The test score of the model to use, once the test was opened."""
        opened, named = subject.view.unsealed, model_to_use(subject.view)
        if opened is None or named is None:
            return tag("span", "not opened")
        place = named.model if getattr(opened, named.model) is not None else "ensemble"
        if not isinstance(tested_model(opened, named.model), TestedModel):
            return tag("span", "no answer")
        return subject.number(opened, f"{place}.scores.0.value", "sig4")

    references = dict.fromkeys(one.name for subject in subjects for one in subject.view.references)
    rows: list[tuple[str, Callable[[Subject], Html]]] = [
        ("state", lambda s: state_mark(s.run.state)),
        ("verdict", verdict),
        ("tags", lambda s: tag_labels(s.view.tags()) or tag("span")),
        ("problem", lambda s: said(s.view.started.problem)),
        ("agent", lambda s: said(s.view.started.agent)),
        ("seed", lambda s: s.number(s.view.started, "seed", "text")),
        ("isolation", lambda s: said(s.view.started.isolation_words)),
        ("experiments", lambda s: s.over("evaluated", "experiment", "count", "count")),
        ("evaluation time", lambda s: s.over("evaluated", "seconds", "sum", "duration")),
        ("V, the best", best),
        *((f"V, {name}", partial(reference, name=name)) for name in references),
        ("error on the sealed test", tested),
    ]
    head = ["", *(tag("a", said(s.run.name), href=run_address(s.run.name)) for s in subjects)]
    if not any(s.view.tags() for s in subjects):
        rows = [row for row in rows if row[0] != "tags"]
    cells = [(text, *map(cell, subjects)) for text, cell in rows]
    return tag("div", table(head, cells, "Compared runs"), class_="both")
