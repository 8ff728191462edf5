"""Comparison of runs, and of experiments whose simulations lie over the same measured outputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from urllib.parse import urlencode

from markupsafe import Markup

from asia._timer import duration
from asia.errors import UserError
from asia.interfaces.view.followed import Snapshot
from asia.interfaces.view.pages import zoomable
from asia.interfaces.view.render import fill, run_address
from asia.ledger.run import model_to_use
from asia.ledger.view import Experiment
from asia.presentation.experiments import error_decimals_of
from asia.presentation.table import error_value
from asia.problem.problem import Problem
from asia.recipe import read_recipe
from asia.report.page.render import picture
from asia.report.page.sections.experiments import COSTS, cost_of, status_of
from asia.report.page.sections.verdict import draw_panel, stamp, tested_figure
from asia.report.page.subject import Subject
from asia.report.pictures.progress import draw_comparison
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
    return fill(
        "comparison_page.html",
        token=token,
        title=", ".join(one.name for one in compared),
        trail=[("Searches", "/"), *((one.name, run_address(one.name)) for one in compared[:3])],
        compared=compared,
        query=_query(compared),
        part=comparison_part(compared),
        choices=[(one, _choices(one)) for one in compared],
    )


def _choices(one: Compared) -> list[Experiment]:
    """The experiments of lowest V of a run, and those that are chosen."""
    scored = [e for e in one.subject.view.finished if e.score is not None]
    scored.sort(key=lambda e: e.score.value if e.score else 0.0)
    scored = scored[:_MOST_CHOICES]
    return scored + [e for e in one.experiments if e not in scored]


def _query(compared: Sequence[Compared]) -> str:
    return urlencode([pair for one in compared for pair in one.query])


def comparison_part(compared: Sequence[Compared]) -> Markup:
    """Write the content of the page."""
    subjects = [one.subject for one in compared]
    axes = {one.view.v_name for one in subjects}
    warning = None
    if len({(s.view.started.problem, s.view.started.protocol_digest) for s in subjects}) > 1:
        warning = "The runs have different problems or protocols: do not compare their V."
    elif len(axes) > 1:
        warning = "V was computed under different rules in the runs: do not compare it."
    curves = None
    if len(subjects) > 1:
        found = {one.run.name: [[e.value for e in one.view.finished]] for one in subjects}
        title, metric = "Best V so far over the experiments", subjects[0].run.metric
        curves = picture(partial(draw_comparison, found, {}, metric, title), title)
    chosen = [(one, e) for one in compared for e in one.experiments]
    names = [*COSTS, *dict.fromkeys(name for one in subjects for name in one.costs)]
    costs = [
        [cost_of(one.subject, e, name) if e.result else None for name in names] for one, e in chosen
    ]
    known = [k for k in range(len(names)) if any(row[k] for row in costs)]
    settings = _settings(chosen)
    return fill(
        "comparison.html",
        subjects=subjects,
        warning=warning,
        stamp=stamp,
        has_tags=any(one.view.tags() for one in subjects),
        rows=_runs_rows(subjects),
        curves=curves,
        chosen=[
            (
                one.name,
                one.subject,
                e,
                status_of(one.subject, e),
                ", ".join(error_value(fold.value) for fold in e.score.folds) if e.score else "",
                [(row[k] or (0, ""))[1] for k in known],
            )
            for (one, e), row in zip(chosen, costs, strict=True)
        ],
        costs=[names[k] for k in known],
        decimals=error_decimals_of([e for _, e in chosen]),
        settings=settings,
        common=sum(is_same for _, _, is_same in settings),
        boxes=_overlays(compared),
        troubled=[one for one in compared if one.snapshot.trouble],
    )


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


def _draw(problem: Problem, panel: Panel, names: Sequence[str]) -> Markup:
    # The error in the title is that of the first one.
    panel = panel if len(names) == 1 else replace(panel, error="")
    return draw_panel(problem, panel, simulated=names[0], others=names[1:])


def _overlays(compared: Sequence[Compared]) -> list[Markup]:
    """The simulations of the chosen experiments over the measured outputs, group by group."""
    return [
        zoomable(f"/compare/overlays/{index}?{_query(compared)}", _draw(*one), len(one[1]))
        for index, one in enumerate(_drawn(compared))
    ]


def compared_overlay(
    compared: Sequence[Compared], index: int, first: int, last: int | None
) -> Markup:
    """Samples `first` to `last` of an overlay, drawn. Raises UserError where there is none."""
    drawn = _drawn(compared)
    if not 0 <= index < len(drawn):
        raise UserError(f"the comparison has no picture {index}")
    problem, panel, names = drawn[index]
    return _draw(problem, panel.cut(first, last), names)


def _settings(chosen: Sequence[tuple[Compared, Experiment]]) -> list[tuple[str, list[str], bool]]:
    """Return each setting, its value in each experiment, and whether all are the same; [] for a
    single experiment."""
    if len(chosen) < 2:
        return []
    columns = [_settings_of(one, e) for one, e in chosen]
    rows: list[tuple[str, list[str], bool]] = []
    for name in dict.fromkeys(name for column in columns for name in column):
        values = [column.get(name, "") for column in columns]
        rows.append((name, values, len(set(values)) == 1))
    return rows


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


def _runs_rows(subjects: Sequence[Subject]) -> list[list[str]]:
    """Figures of the runs, each with its name."""

    def reference(subject: Subject, name: str) -> str:
        value = subject.reference(name)
        return "none" if value is None else error_value(value)

    def tested(subject: Subject) -> str:
        """The test score of the model to use, once the test was opened."""
        opened, named = subject.view.unsealed, model_to_use(subject.view)
        if opened is None or named is None:
            return "not opened"
        found = tested_figure(opened, named.model)
        return "no answer" if found is None else found[1]

    def best(subject: Subject) -> str:
        found = subject.view.best
        return "no score" if found is None else subject.v(found)

    references = dict.fromkeys(one.name for subject in subjects for one in subject.view.references)
    rows: list[tuple[str, Callable[[Subject], str]]] = [
        ("problem", lambda s: s.view.started.problem),
        ("agent", lambda s: s.view.started.agent),
        ("seed", lambda s: str(s.view.started.seed)),
        ("isolation", lambda s: s.view.started.isolation_words),
        ("experiments", lambda s: str(len(s.evaluations))),
        ("evaluation time", lambda s: duration(s.seconds)),
        ("V, the best", best),
        *((f"V, {name}", partial(reference, name=name)) for name in references),
        ("error on the sealed test", tested),
    ]
    return [[text, *map(cell, subjects)] for text, cell in rows]
