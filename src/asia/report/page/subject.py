"""Content of a page: one run, and the sections that show it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from markupsafe import Markup

from asia._plugins import Part, parts_of
from asia.errors import UserError
from asia.judge.scoring.outcome import Score
from asia.ledger.events import Evaluated, Noted
from asia.ledger.run import Run
from asia.ledger.view import Experiment, SearchView
from asia.presentation.experiments import error_decimals_of
from asia.presentation.table import Block, error_value
from asia.problem.folds import Fold, make_folds
from asia.problem.problem import Problem
from asia.report.page.render import render, show


@dataclass(frozen=True)
class Detail:
    """Limits on the length of the page of a long search."""

    sources: int
    """Maximum number of experiments with their changed source on the page."""
    stories: int
    """Maximum number of experiments with a hypothesis and a fold table; the others have a row."""
    rows: int
    """Maximum number of listed experiments."""


@dataclass(frozen=True)
class Subject:
    """The run of a page."""

    run: Run
    problem: Problem | None
    """Its problem with the training data; None where the ledger came without its artifacts."""
    detail: Detail

    @property
    def view(self) -> SearchView:
        """View of the search from its ledger."""
        return self.run.view

    @cached_property
    def evaluations(self) -> tuple[Evaluated, ...]:
        """All results in their order."""
        events = (line.event for line in self.run.lines)
        return tuple(event for event in events if isinstance(event, Evaluated))

    @cached_property
    def noted(self) -> tuple[tuple[Noted, str], ...]:
        """Notes of users, each with its time."""
        lines = self.run.lines
        return tuple((one.event, one.time) for one in lines if isinstance(one.event, Noted))

    @property
    def seconds(self) -> float:
        """Time of all evaluations in seconds."""
        return math.fsum(one.seconds for one in self.evaluations)

    @property
    def is_control(self) -> bool:
        """True if the candidates are controllers."""
        return self.problem is not None and self.problem.control is not None

    @cached_property
    def folds(self) -> Sequence[Fold]:
        """The folds; () without the data."""
        return () if self.problem is None else make_folds(self.problem.train, self.problem.protocol)

    @cached_property
    def lineage(self) -> tuple[int, ...]:
        """Numbers of the best candidate and of all that it was made from, the first one first."""
        return tuple(e.number for e in self.view.lineage)

    @cached_property
    def listed(self) -> tuple[Experiment, ...]:
        """The experiments on the page: all; in a long search those that were kept, the best
        candidate's lineage and the last ones."""
        return self._chosen(self.detail.rows)

    @cached_property
    def with_source(self) -> frozenset[int]:
        """Numbers of the experiments whose changed source is on the page."""
        return frozenset(e.number for e in self._chosen(self.detail.sources))

    @cached_property
    def with_story(self) -> frozenset[int]:
        """Numbers of the experiments with a hypothesis and a fold table."""
        return frozenset(e.number for e in self._chosen(self.detail.stories))

    def _chosen(self, most: int) -> tuple[Experiment, ...]:
        every = self.view.experiments
        if len(every) <= most:
            return every
        bests = {e.number for e in self.view.bests}
        order = sorted(
            every, key=lambda e: (e.number not in self.lineage, e.number not in bests, -e.number)
        )
        return tuple(sorted(order[:most], key=lambda e: e.number))

    @cached_property
    def costs(self) -> dict[str, Mapping[int, float]]:
        """Costs of experiments that sections of plug-ins bring, by name, then by number."""
        found = (one.cost for one in plugged_sections())
        return {one.name: one.values(self) for one in found if one is not None}

    @cached_property
    def _decimals(self) -> int:
        return error_decimals_of(self.view.finished)

    def v(self, experiment: Experiment, decimals: int = 0) -> str:
        """Format V of an experiment that has a score, with as many decimals as its search needs.
        decimals: of a comparison with other searches."""
        assert experiment.score is not None
        return error_value(experiment.score.value, decimals or self._decimals)

    def reference(self, name: str) -> float | None:
        """Return the V of a reference model; None without a score."""
        for reference in self.view.references:
            if reference.name == name and isinstance(reference.outcome, Score):
                return reference.outcome.value
        return None


def result_of(experiment: Experiment) -> Evaluated:
    """The result of an experiment that has one."""
    assert experiment.result is not None
    return experiment.result


@dataclass(frozen=True)
class Cost:
    """Cost of an experiment that V is drawn against."""

    name: str
    values: Callable[[Subject], Mapping[int, float]]
    """Function that returns the cost by number of the experiment, where it is known."""


@dataclass(frozen=True)
class Section:
    """A part of the page: a function in `sections`, a line in its `__init__`, and a template unless
    it consists of blocks. A plug-in brings it by an entry point."""

    key: str
    """Its anchor."""
    title: str
    """Its heading."""
    content: Callable[[Subject], dict[str, Any] | list[Block] | None]
    """Function that returns blocks, or what its template shows beside the subject; None if the run
    has nothing for it."""
    template: str = ""
    """Template of the report; default: `sections/KEY.html`."""
    folder: Path | None = None
    """Folder of a plug-in with its template."""
    after: str | None = None
    """Key of the section that one of a plug-in follows; default: the last one."""
    files: tuple[Path, ...] = ()
    """Files in the folder of a run: with one of them the section has a page of its own in the live
    view."""
    cost: Cost | None = None

    def write(self, subject: Subject, link: str = "#e") -> Markup | None:
        """Write it. link: address of an experiment without its number."""
        found = self.content(subject)
        if found is None:
            return None
        if isinstance(found, list):
            return show(found)
        template = self.template or f"sections/{self.key}.html"
        folders = () if self.folder is None else (self.folder,)
        return render(template, *folders, subject=subject, link=link, **found)


@cache
def plugged_sections() -> tuple[Section, ...]:
    """Sections of plug-ins; the content of one that does not load is the reason."""
    return tuple(map(_loaded, parts_of("asia.report_sections")))


def _loaded(part: Part) -> Section:
    try:
        found = part.load()
        if isinstance(found, Section):
            return found
        raise UserError(f"section {part.name} of package {part.package} is {found!r}")
    except UserError as error:
        reason = error

        def content(subject: Subject) -> None:
            raise reason

        return Section(part.name, part.name, content)
