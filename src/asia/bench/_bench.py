"""Run every search of a comparison, open the declared test when asked to, write the results."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from asia.agents import legs_of
from asia.bench._declaration import declare, require_declared
from asia.bench._figures import draw
from asia.bench._paired import paired_table
from asia.bench._plan import ComparisonPlan, PlannedRun
from asia.bench._rows import Comparison, FinishedSearch, compare
from asia.bench._tables import TextTable, comparison_table
from asia.bench._test import TestResult, read_test, test_tables
from asia.ledger import Event, SearchView, open_run, write_whole
from asia.search import prepare, search, unseal


class Watcher(Protocol):
    """Listens to a comparison."""

    def on_run(self, run: PlannedRun, number: int, total: int) -> None:
        """Search `number` of `total` is about to begin, or to be read when it is finished."""
        ...

    def on_event(self, event: Event, view: SearchView) -> None:
        """An event of that search was written to its ledger."""
        ...

    def on_end(self, run: PlannedRun, view: SearchView) -> None:
        """Handle the end of one search."""
        ...


@dataclass(frozen=True)
class BenchResult:
    """A finished comparison."""

    comparisons: tuple[Comparison, ...]
    """Measured results, one comparison for each early-stopping setting."""
    tables: tuple[TextTable, ...]
    """The same, and the test, for people."""
    declared: str | None
    """The run whose test may be opened."""
    test: TestResult | None
    """Test result of the declared run; None while its test is sealed."""
    document: Path
    """The tables as Markdown."""
    pictures: tuple[Path, ...]
    """PNG and PDF files."""


def bench(
    plan: ComparisonPlan,
    watcher: Watcher,
    *,
    open_test: bool = False,
    process_consent: bool = False,
) -> BenchResult:
    """Searches that exist are finished, not repeated: killed anywhere, the same call goes on.

    open_test: after the last search, score the declared run on the sealed test; no other run's test
    is ever opened; process_consent: as in `unseal`. Raises UserError for anything the caller can
    mend.
    """
    declared = declare(plan)
    to_open = require_declared(plan, declared) if open_test else None
    planned = plan.searches
    finished: list[FinishedSearch] = []
    for number, run in enumerate(planned, start=1):
        watcher.on_run(run, number, len(planned))
        view = _search(plan, run, watcher)
        watcher.on_end(run, view)
        finished.append(FinishedSearch(run, view))
        _write(plan, _tables(plan, finished, declared, None))
    if to_open is not None:
        unseal(plan.runs / to_open, process_consent=process_consent)
    names = {run.name for run in planned}
    test = read_test(plan.runs / declared) if declared in names and declared else None
    tables = _tables(plan, finished, declared, test)
    return BenchResult(
        comparisons=tuple(compare(s, finished, plan.paper) for s in plan.settings),
        tables=tables,
        declared=declared,
        test=test,
        document=_write(plan, tables),
        pictures=draw(plan, finished, test),
    )


def _search(plan: ComparisonPlan, run: PlannedRun, watcher: Watcher) -> SearchView:
    agent = run.arm.make()
    ready = prepare(
        run.problem,
        agent.name,
        seed=run.seed,
        runs=plan.runs,
        name=run.name,
        agent_settings=run.arm.settings,
        legs=legs_of(agent),
    )
    search(ready, agent, watcher.on_event, _silent)
    return open_run(ready.directory).view


def _silent(view: SearchView) -> None:
    del view


def _tables(
    plan: ComparisonPlan,
    finished: Iterable[FinishedSearch],
    declared: str | None,
    test: TestResult | None,
) -> tuple[TextTable, ...]:
    runs = tuple(finished)
    done = [compare(setting, runs, plan.paper) for setting in plan.settings]
    shown = [comparison_table(c, plan.paper) for c in done if c.rows]
    if plan.word == "compare":
        paired = paired_table(runs)
        return (*shown, *([paired] if paired is not None else []))
    return (*shown, *test_tables(plan, declared, test))


def _write(plan: ComparisonPlan, tables: tuple[TextTable, ...]) -> Path:
    path = plan.directory / f"{plan.problem.name}.md"
    head = f"# {plan.problem.name}: {plan.budget} experiments a search, seeds "
    head += ", ".join(str(seed) for seed in plan.seeds)
    head += "\n\nQuick: short fits, too few experiments to compare.\n" if plan.quick else "\n"
    text = "\n".join([head, *(t.markdown() for t in tables)])
    write_whole(path, text.encode(), durable=False)
    return path
