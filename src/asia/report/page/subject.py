"""Content of a page: one run with numbers that know their source."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from asia._files import read_file
from asia.errors import InternalError, UserError
from asia.judge.scoring.outcome import Score
from asia.ledger.events import Evaluated, Event
from asia.ledger.run import Run
from asia.ledger.text import error_decimals
from asia.ledger.view import Experiment, SearchView
from asia.problem.folds import Fold, make_folds
from asia.problem.problem import Problem
from asia.report.page.html import ONE, Html, follow, join, said, tag, write_number

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
    def _places(self) -> dict[int, int]:
        return {id(line.event): line.seq for line in self.run.lines}

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

    def place(self, event: Event) -> int:
        """Sequence number of an event of the run."""
        try:
            return self._places[id(event)]
        except KeyError:
            raise InternalError(f"report: this '{event.event}' is not in the ledger") from None

    def number(self, event: Event, path: str, form: str) -> Html:
        """A number as an event has it, such as `outcome.value`."""
        return self.made(ONE, form, (event, path))

    def interval(self, event: Event, path: str, form: str) -> Html:
        """A value with the ends of its interval: 0.3 (0.1 to 0.5)."""
        value, low, high = (
            self.number(event, f"{path}.{end}", form) for end in ("value", "low", "high")
        )
        return join((value, " (", low, " to ", high, ")"))

    def made(self, rule: str, form: str, *parts: tuple[Event, str]) -> Html:
        """A number made of several, by one of `html.RULES`."""
        values: list[Any] = []
        names: list[str] = []
        for event, path in parts:
            try:
                values += follow(event, path)
            except (KeyError, IndexError, AttributeError, ValueError) as error:
                raise InternalError(f"report: '{event.event}' has no {path}: {error!r}") from error
            names.append(f"{self.place(event)}:{path}")
        return write_number(values, " ".join(names), rule, form)

    def over(self, kind: str, path: str, rule: str, form: str) -> Html:
        """A number made of all events of a kind, such as the sum of `seconds` of `evaluated`."""
        events = (line.event for line in self.run.lines if line.event.event == kind)
        values = [value for event in events for value in follow(event, path)]
        return write_number(values, f"{kind}:{path}", rule, form)

    @property
    def setting(self) -> Html:
        """`problem tanks · agent expert · seed 0 · isolation namespace`."""
        start = self.view.started
        return join((
            "problem ", said(start.problem), " · agent ", said(start.agent), " · seed ",
            self.number(start, "seed", "text"), " · isolation ", said(start.isolation_words),
        ))  # fmt: skip

    @cached_property
    def _v_form(self) -> str:
        return v_form(self.view.finished)

    def v(self, experiment: Experiment, form: str = "") -> Html:
        """V of an experiment that has a score, with as many decimals as its search needs. form: of
        a comparison with other searches."""
        return self.number(result_of(experiment), "outcome.value", form or self._v_form)

    def name(self, experiment: Experiment) -> Html:
        """`#07`."""
        return self.number(experiment.proposed, "experiment", "number")

    def reference(self, name: str) -> tuple[Event, float] | None:
        """Return a reference model's event with its V; None without a score."""
        for reference in self.view.references:
            if reference.name == name and isinstance(reference.outcome, Score):
                return reference, reference.outcome.value
        return None


def v_form(experiments: Iterable[Experiment]) -> str:
    """Form of `html.FORMS` in which the V of these experiments read differently."""
    scored = [(e.score.value, result_of(e).threshold) for e in experiments if e.score is not None]
    decimals = error_decimals(*zip(*scored, strict=True)) if scored else 4
    return "error" if decimals == 4 else f"error{decimals}"


def result_of(experiment: Experiment) -> Evaluated:
    """The result of an experiment that has one."""
    assert experiment.result is not None
    return experiment.result


@dataclass(frozen=True)
class Section:
    """A part of the page: one module below `sections`, and one line in its `__init__`."""

    key: str
    """Its anchor."""
    title: str
    """Its heading."""
    write: Callable[[Subject], Html | None]
    """Function that writes the section below its title; None if the run has nothing for it. Numbers
    come from `Subject.number` and similar methods, foreign texts go through `html.said`; the audit
    refuses a page with any other digit.
    """


def used_no_test(after_unsealing: bool) -> Html | None:
    """Return the note on evidence that was computed after the test was opened."""
    if not after_unsealing:
        return None
    return tag("p", "This was computed after the sealed test had been opened, without using it.")
