"""V of everything in a comparison, one early-stopping setting at a time."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from asia.bench._paper import Paper
from asia.bench._plan import PlannedRun
from asia.bench._references import TITLES
from asia.ledger import Experiment, SearchView
from asia.protocol import EarlyStopping, ShownResidual
from asia.scoring import Score


@dataclass(frozen=True)
class FinishedSearch:
    """A search of the comparison with the results from its ledger."""

    planned: PlannedRun
    """Planned search."""
    view: SearchView
    """Its ledger, replayed."""


@dataclass(frozen=True)
class Row:
    """V of one model or search over the seeds."""

    key: str
    """Name in JSON and in the paper's figures."""
    model: str
    """Name in tables."""
    values: tuple[float, ...]
    """V of every run that has a score, in order of the seeds."""
    runs: int
    """Number of runs, with a score or without."""
    paper: float | None = None
    """V in the paper; None where it reports none, or measured it under another setting of early
    stopping."""
    scores_seen: int = 0
    """Maximum number of times that a fit received its score on the held-out part in one run."""

    @property
    def median(self) -> float | None:
        """Over the runs that have a score."""
        return statistics.median(self.values) if self.values else None


@dataclass(frozen=True)
class Reached:
    """Experiments that `arm`, the expert or the first agent compared, needed to come to the best V
    of a control with the same seed; None where it did not, or where the control has no score."""

    arm: str
    """The arm whose experiments are counted."""
    control: str
    """The arm whose best V is to be reached."""
    seeds: tuple[int, ...]
    """The seeds that both were run with."""
    experiments: tuple[int | None, ...]
    """Number of experiments for each seed; None if V was not reached."""


@dataclass(frozen=True)
class Comparison:
    """Everything measured under one early-stopping setting."""

    setting: EarlyStopping
    """The setting."""
    rows: tuple[Row, ...]
    """Rungs, baseline, references and searches."""
    reached: tuple[Reached, ...]
    """Number of experiments of the first arm to reach the best V of each other arm."""
    residuals: ShownResidual = "train"
    """Residuals that the agents were shown."""


def compare(
    setting: EarlyStopping, runs: Sequence[FinishedSearch], paper: Paper | None
) -> Comparison:
    """Compute the rows of one setting; `runs` of other settings are ignored."""
    own = [run for run in runs if run.planned.setting == setting]
    published = {v.row: v.value for v in paper.values if v.row} if paper else {}
    rows = [*_rungs(own), *_baseline(own), *_references(own), *_arms(own)]
    if setting == "validation":
        rows = [replace(row, paper=published.get(row.key)) for row in rows]
        rows += _paper_only(paper, {row.key for row in rows})
    shown = any(run.view.started.residuals == "held_out" for run in own)
    return Comparison(setting, tuple(rows), _reached(own), "held_out" if shown else "train")


def _paper_only(paper: Paper | None, ours: set[str]) -> list[Row]:
    values = paper.values if paper else ()
    return [
        Row(v.row or v.model, f"paper only: {v.model}", (), 0, v.value)
        for v in values
        if v.row not in ours
    ]


def _rungs(runs: Sequence[FinishedSearch]) -> list[Row]:
    """The same in every run of a seed; the linear model may depend on the seed."""
    first = list({run.planned.seed: run for run in reversed(runs)}.values())[::-1]
    names = list(dict.fromkeys(reference.name for run in first for reference in run.view.rungs))
    outcomes = [
        {reference.name: reference.outcome for reference in run.view.rungs} for run in first
    ]
    rows: list[Row] = []
    for name in names:
        found = [o.get(name) for o in outcomes]
        values = tuple(o.value for o in found if isinstance(o, Score))
        rows.append(Row(name, name, values, len(first)))
    return rows


def _baseline(runs: Sequence[FinishedSearch]) -> list[Row]:
    first = list({run.planned.seed: run for run in reversed(runs)}.values())[::-1]
    if not first:
        return []
    experiments = [run.view.experiment(1) for run in first if run.view.experiments]
    return [_row("baseline", "baseline of the problem", experiments, len(first))]


def _references(runs: Sequence[FinishedSearch]) -> list[Row]:
    fixed = [run for run in runs if run.planned.arm.fixed is not None]
    keys = {title: key for key, title in TITLES.items()}
    titles = [e.proposed.title for run in fixed for e in run.view.experiments[1:]]
    rows: list[Row] = []
    for title in dict.fromkeys(titles):
        same = [e for run in fixed for e in run.view.experiments if e.proposed.title == title]
        rows.append(_row(keys.get(title, title), f"{title}, rebuilt", same, len(fixed)))
    return rows


def _arms(runs: Sequence[FinishedSearch]) -> list[Row]:
    rows: list[Row] = []
    for arm in dict.fromkeys(run.planned.arm for run in runs if run.planned.arm.fixed is None):
        own = [run for run in runs if run.planned.arm == arm]
        best = [run.view.best for run in own if run.view.best is not None]
        most = max(len(run.view.finished) for run in own)
        rows.append(_row(arm.name, f"{arm.label}, best of {most}", best, len(own)))
    return rows[::-1]


def _row(key: str, model: str, experiments: Iterable[Experiment], runs: int) -> Row:
    found = list(experiments)
    values = tuple(e.score.value for e in found if e.score is not None)
    seen = [e.result.validation_scores for e in found if e.result is not None]
    return Row(key, model, values, runs, scores_seen=max(seen, default=0))


def _reached(runs: Sequence[FinishedSearch]) -> tuple[Reached, ...]:
    names = list(dict.fromkeys(r.planned.arm.name for r in runs if r.planned.arm.fixed is None))
    if not names:
        return ()
    arm = "expert" if "expert" in names else names[0]
    own = {run.planned.seed: run.view for run in runs if run.planned.arm.name == arm}
    controls = [name for name in names if name != arm]
    answer: list[Reached] = []
    for control in controls:
        views = {run.planned.seed: run.view for run in runs if run.planned.arm.name == control}
        seeds = tuple(seed for seed in own if seed in views)
        if seeds:
            counts = tuple(_first_as_good(own[s], views[s]) for s in seeds)
            answer.append(Reached(arm, control, seeds, counts))
    return tuple(answer)


def _first_as_good(arm: SearchView, control: SearchView) -> int | None:
    best = control.best
    if best is None or best.score is None:
        return None
    goal = best.score.value
    return next((e.number for e in arm.finished if e.score and e.score.value <= goal), None)
