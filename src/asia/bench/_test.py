"""Test result of the declared run, compared with published results."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from asia.bench._paper import PaperMee
from asia.bench._plan import ComparisonPlan
from asia.bench._tables import TextTable
from asia.errors import UserError
from asia.ledger import TestedModel, Unsealed, error_value, open_run
from asia.protocol import MEE, find_metric, metric_label
from asia.report import Entry, leaderboard, official_figures, read_board
from asia.scoring import Failure

_SEALED = "sealed"


@dataclass(frozen=True)
class TestResult:
    """The test result of the declared run."""

    run: str
    """Name of the run."""
    record: Unsealed
    """The scores, as the ledger keeps them."""
    opened_before: tuple[str, ...]
    """Other runs that had opened the same test."""

    @property
    def models(self) -> tuple[tuple[str, TestedModel | Failure], ...]:
        """The ensemble of the fold models, and the refit and the stack where there are some."""
        named = (
            ("ours, ensemble of the fold models", self.record.ensemble),
            ("ours, refitted on all data", self.record.refit),
            ("ours, stack of several experiments", self.record.stack),
        )
        return tuple((name, model) for name, model in named if model is not None)


def read_test(directory: Path) -> TestResult | None:
    """Read the test result from the run's ledger; None while its test is sealed. Opens nothing."""
    try:
        view = open_run(directory).view
    except UserError:
        return None
    if view.unsealed is None:
        return None
    before = view.unsealing.opened_before if view.unsealing else ()
    return TestResult(directory.name, view.unsealed, before)


def test_tables(
    plan: ComparisonPlan, declared: str | None, test: TestResult | None
) -> tuple[TextTable, ...]:
    """Write one table for each test metric of the problem, ours next to the published results.

    Args:
        plan: the comparison.
        declared: the run whose test may be opened.
        test: its test result.
    """
    if plan.problem.test.source is None:
        return ()
    tables = [
        _mee_table(plan, declared, test)
        if metric == MEE
        else _figures_table(plan, declared, test)
        if metric == "rmse" and plan.problem.protocol.test.unit is not None
        else _error_table(plan, declared, test, metric)
        for metric in plan.problem.protocol.test.metrics
    ]
    return tuple(table for table in tables if test is not None or len(table.rows) > 1)


def _error_table(
    plan: ComparisonPlan, declared: str | None, test: TestResult | None, metric: str
) -> TextTable:
    outputs = plan.problem.outputs
    units = {find_metric(metric).unit_of(s.unit) for s in outputs}
    unit = f" [{units.pop()}]" if len(units) == 1 and units != {""} else ""
    rows = [(model, cells[0]) for model, cells in _ours(test, 1, partial(_value, metric))]
    notes = _notes(declared, test)
    if metric == "rmse" and plan.paper is not None:
        entries = _entries(plan)
        rows += [(row.model, error_value(row.value)) for row in plan.paper.test]
        rows += _standing(entries)
        notes += [*_rank(entries, test), plan.paper.protocol]
    label = metric_label(metric)
    header = ("model", f"test {label}{unit}")
    return TextTable(f"Sealed test: {label}", header, tuple(rows), tuple(notes))


def _figures_table(
    plan: ComparisonPlan, declared: str | None, test: TestResult | None
) -> TextTable:
    """The official figures, each on its own and none over all records."""
    problem = plan.problem
    board = read_board(problem, None)
    named = list(board.names)
    if test is not None:
        models = [m for _, m in test.models if not isinstance(m, Failure)]
        named = [f.name for m in models[:1] for f in official_figures(problem, test.record, m)]

    def cells(model: TestedModel) -> tuple[str, ...]:
        assert test is not None
        found = official_figures(problem, test.record, model)
        return tuple(error_value(figure.value) for figure in found)

    names = named or ["test"]
    rows = [(model, *own) for model, own in _ours(test, len(names), cells)]
    for k, name in enumerate(names):
        values = [v for e in board.entries if k < len(e.figures) and (v := e.figures[k])]
        if values:
            best = [error_value(min(values)) if i == k else "-" for i in range(len(names))]
            rows.append((f"lowest of {len(values)} published, {name}", *best))
    title = f"Sealed test: RMSE [{board.unit}]"
    return TextTable(title, ("model", *names), tuple(rows), tuple(_notes(declared, test)))


def _mee_table(plan: ComparisonPlan, declared: str | None, test: TestResult | None) -> TextTable:
    rule = plan.problem.protocol.test
    horizons = rule.horizons or (plan.problem.protocol.horizon,)
    names = [f"h{h}" for h in horizons]
    header = [f"{group.name} {name}" for group in rule.groups for name in (*names, "sum")]
    rows = [(model, *cells) for model, cells in _ours(test, len(header), _mee_cells)]
    notes = _notes(declared, test)
    if plan.paper is not None:
        rows += [(row.model, *_paper_cells(row)) for row in plan.paper.mee]
        notes.append(plan.paper.protocol)
    title = "Sealed test: Mean Euclidean Error by output group, after so many samples and summed"
    return TextTable(title, ("model", *header), tuple(rows), tuple(notes))


def _ours(
    test: TestResult | None, width: int, cells: Callable[[TestedModel], tuple[str, ...]]
) -> list[tuple[str, tuple[str, ...]]]:
    """Our models with their cells; `sealed` in each while the test is."""
    if test is None:
        return [("ours", (_SEALED,) * width)]
    rows: list[tuple[str, tuple[str, ...]]] = []
    for name, model in test.models:
        if isinstance(model, Failure):
            rows.append((f"{name}: {model.reason.value}", ("-",) * width))
        else:
            rows.append((name, cells(model)))
    return rows


def _value(metric: str, model: TestedModel) -> tuple[str, ...]:
    return tuple(error_value(s.value) for s in model.scores if s.metric == metric)


def _mee_cells(model: TestedModel) -> tuple[str, ...]:
    assert model.mee is not None
    groups = model.mee.by_group().values()
    return tuple(f"{value:.4g}" for group in groups for value in group.values())


def _paper_cells(row: PaperMee) -> tuple[str, ...]:
    return tuple(f"{v:.4g}" for g in row.groups for v in (g.h10, g.h50, g.total))


def _notes(declared: str | None, test: TestResult | None) -> list[str]:
    if test is None and declared is None:
        return ["The test is sealed, and no run is declared for it: the expert is not compared."]
    if test is None:
        return [
            f"The test is sealed; --unseal opens that of run {declared}, once, after the last "
            "search."
        ]
    notes = [f"Run {test.run}, experiment {test.record.experiment}, declared before its search."]
    if test.opened_before:
        notes.append(f"The same test had been opened before, by {', '.join(test.opened_before)}.")
    return notes


def _entries(plan: ComparisonPlan) -> tuple[Entry, ...]:
    """Return the published entries; none for a user's own data, which may have a benchmark's
    name.
    """
    measured = plan.problem.data.public
    return leaderboard(plan.problem.name) if measured else ()


def _standing(entries: Sequence[Entry]) -> list[tuple[str, str]]:
    if not entries:
        return []
    ordered = sorted(entries, key=lambda e: e.test_rmse)
    middle = statistics.median(e.test_rmse for e in entries)
    rows = [(f"published {e.year}: {e.method}", error_value(e.test_rmse)) for e in ordered[:3]]
    return [*rows, (f"median of {len(entries)} published", error_value(middle))]


def _rank(entries: Sequence[Entry], test: TestResult | None) -> list[str]:
    if not entries or test is None or isinstance(test.record.ensemble, Failure):
        return []
    ours = next((s.value for s in test.record.ensemble.scores if s.metric == "rmse"), None)
    if ours is None:
        return []
    lower = sum(e.test_rmse < ours for e in entries)
    return [f"{lower} of {len(entries)} published results have a lower test RMSE than ours."]


def test_object(test: TestResult) -> dict[str, Any]:
    """Return the value of every metric of each model, or the reason for its absence, for
    scripts.
    """
    refit = test.record.refit
    return {
        "run": test.run,
        "experiment": test.record.experiment,
        "ensemble": _model_object(test.record.ensemble),
        "refit": None if refit is None else _model_object(refit),
    }


def _model_object(model: TestedModel | Failure) -> dict[str, Any]:
    if isinstance(model, Failure):
        return {"failure": model.reason.value, "advice": model.advice}
    values: dict[str, Any] = {score.metric: score.value for score in model.scores}
    if model.mee is not None:
        values["mee"] = model.mee.by_group()
    return values
