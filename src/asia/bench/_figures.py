"""Pictures of a comparison, each early-stopping setting in its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from asia.bench._paper import PaperMee
from asia.bench._plan import ComparisonPlan
from asia.bench._rows import FinishedSearch
from asia.bench._test import TestResult
from asia.evaluation import LINEAR_RUNG
from asia.protocol import EarlyStopping
from asia.report import (
    ArmCurves,
    ArmsPicture,
    BenchPictures,
    ComparedValue,
    Curve,
    PublishedMee,
    draw_bench,
)
from asia.scoring import Score

_WORDS: dict[EarlyStopping, str] = {
    "inner": "inner early stopping",
    "validation": "validation early stopping, as in the paper",
}


def draw(
    plan: ComparisonPlan, finished: Sequence[FinishedSearch], test: TestResult | None
) -> tuple[Path, ...]:
    """Draw the progress of the expert's first search and the comparison of the arms for each
    setting; with an opened test, its results next to the published ones.
    """
    sides: list[ArmsPicture] = []
    progress: list[tuple[str, Path]] = []
    for setting in plan.settings:
        own = [run for run in finished if run.planned.setting == setting]
        experts = [run for run in own if run.planned.arm.name == "expert"]
        if experts:
            progress.append((f"progress-{setting}", plan.runs / experts[0].planned.name))
        if any(run.planned.arm.fixed is None for run in own):
            sides.append(_sides(plan, setting, own))
    paper = plan.paper
    pictures = BenchPictures(
        progress=tuple(progress),
        sides=tuple(sides),
        opened=plan.runs / test.run if test else None,
        test_mark=("paper", paper.test[0].value) if paper and paper.test else None,
        mee=tuple(_published(row) for row in paper.mee) if paper else (),
        caption=paper.protocol if paper else "",
    )
    return draw_bench(pictures, plan.directory)


def _published(row: PaperMee) -> PublishedMee:
    points = [((g.group, 10, g.h10), (g.group, 50, g.h50)) for g in row.groups]
    return PublishedMee(row.model, tuple(point for pair in points for point in pair))


def _sides(
    plan: ComparisonPlan, setting: EarlyStopping, runs: Sequence[FinishedSearch]
) -> ArmsPicture:
    arms = dict.fromkeys(r.planned.arm for r in runs if r.planned.arm.fixed is None)
    sides = tuple(
        ArmCurves(arm.label, tuple(_curve(run) for run in runs if run.planned.arm == arm))
        for arm in arms
    )
    return ArmsPicture(
        name=f"arms-{setting}",
        title=f"{plan.problem.name}: {_who(plan)}, {_WORDS[setting]}",
        sides=sides,
        levels=_levels(plan, setting, runs),
        metric=plan.problem.protocol.metric,
    )


def _who(plan: ComparisonPlan) -> str:
    bench = plan.word == "bench"
    return "expert against random search" if bench else "agents at equal budgets"


def _curve(run: FinishedSearch) -> Curve:
    return Curve(tuple(e.score.value if e.score else None for e in run.view.finished))


def _levels(
    plan: ComparisonPlan, setting: EarlyStopping, runs: Sequence[FinishedSearch]
) -> tuple[ComparedValue, ...]:
    """The linear model, and the paper's searches where they were measured alike."""
    references = [
        reference
        for run in runs[:1]
        for reference in run.view.rungs
        if reference.name == LINEAR_RUNG
    ]
    levels = [
        ComparedValue(LINEAR_RUNG, r.outcome.value)
        for r in references
        if isinstance(r.outcome, Score)
    ]
    if setting == "validation" and plan.paper is not None:
        searches = ("expert", "random-paper")
        values = [v for v in plan.paper.values if v.row in searches]
        levels += [ComparedValue(f"paper: {v.model}", v.value) for v in values]
    return tuple(levels)
