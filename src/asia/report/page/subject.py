"""Content of a page: one run, and the sections that show it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from markupsafe import Markup

from asia._files import read_file
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

_NORM = "H-infinity norm"


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
    def analysed(self) -> dict[str, dict[int, float]]:
        """Largest proven H-infinity norm from the files of `asia certify`, and largest IAE from
        those of `asia control`, by command and experiment. Files of other versions are left out."""
        found: dict[str, dict[int, float]] = {"certificate": {}, "control": {}}
        best = self.view.best
        for path in sorted(self.run.directory.glob("certificate*.json")) + sorted(
            self.run.directory.glob("control*/control.json")
        ):
            command = "control" if path.name == "control.json" else "certificate"
            try:
                content = json.loads(read_file(path, f"run asia {command} again"))
                model = str(content["model"]).removeprefix("experiment ")
                if command == "control":
                    values = [float(one["iae"]) for one in content["responses"]]
                else:
                    statements = content["statements"]
                    values = [float(s["bound"]) for s in statements if s["kind"] == _NORM]
            except (ValueError, TypeError, LookupError, UserError):
                continue
            # The refit and the ensemble are the best experiment's; a stack is of several.
            number = 0 if best is None or model == "stack" else best.number
            number = int(model) if model.isdecimal() else number
            if number and values and math.isfinite(max(values)):
                found[command][number] = max(values)
        return found

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
class Section:
    """A part of the page: a function in `sections` and a line in its `__init__`."""

    key: str
    """Its anchor."""
    title: str
    """Its heading."""
    content: Callable[[Subject], dict[str, Any] | list[Block] | None]
    """Function that returns blocks, or what its template shows beside the subject; None if the run
    has nothing for it."""

    def write(self, subject: Subject, link: str = "#e") -> Markup | None:
        """Write it. link: address of an experiment without its number."""
        found = self.content(subject)
        if found is None:
            return None
        if isinstance(found, list):
            return show(found)
        return render(f"sections/{self.key}.html", subject=subject, link=link, **found)
