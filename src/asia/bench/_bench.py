"""Run every search of a comparison, open the declared test when asked to, write the results."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from asia.bench._declaration import declare, require_declared
from asia.bench._figures import draw
from asia.bench._paired import paired_table
from asia.bench._plan import Plan, PlannedRun
from asia.bench._rows import Comparison, Finished, compare
from asia.bench._tables import Table, comparison_table
from asia.bench._test import TestResult, read_test, test_tables
from asia.ledger import Event, SearchView, open_run
from asia.search import prepare, search, unseal


class Watcher(Protocol):
    """Listens to a comparison."""

    def on_run(self, run: PlannedRun, number: int, total: int) -> None:
        """Search `number` of `total` is about to begin, or to be read when it is finished."""
        ...

    def on_event(self, event: Event, view: SearchView) -> None:
        """An event of that search was recorded."""
        ...

    def on_end(self, run: PlannedRun, view: SearchView) -> None:
        """That search is finished."""
        ...


@dataclass(frozen=True)
class Result:
    """A finished comparison. test: what the declared run's opened test said, None while it is
    sealed; document: the tables as Markdown; pictures: PNG and PDF files."""

    comparisons: tuple[Comparison, ...]
    tables: tuple[Table, ...]
    declared: str | None
    test: TestResult | None
    document: Path
    pictures: tuple[Path, ...]


def bench(plan: Plan, watcher: Watcher, *, open_test: bool = False) -> Result:
    """Searches that exist are finished, not repeated: killed anywhere, the same call goes on.

    open_test: after the last search, score the declared run on the sealed test; no other run's test
    is ever opened. Raises UserError for anything the caller can mend.
    """
    declared = declare(plan)
    to_open = require_declared(plan, declared) if open_test else None
    planned = plan.searches
    finished: list[Finished] = []
    for number, run in enumerate(planned, start=1):
        watcher.on_run(run, number, len(planned))
        view = _search(plan, run, watcher)
        watcher.on_end(run, view)
        finished.append(Finished(run, view))
        _write(plan, _tables(plan, finished, declared, None))
    if to_open is not None:
        unseal(plan.runs / to_open)
    names = {run.name for run in planned}
    test = read_test(plan.runs / declared) if declared in names and declared else None
    tables = _tables(plan, finished, declared, test)
    return Result(
        comparisons=tuple(compare(s, finished, plan.paper) for s in plan.settings),
        tables=tables,
        declared=declared,
        test=test,
        document=_write(plan, tables),
        pictures=draw(plan, finished, test),
    )


def _search(plan: Plan, run: PlannedRun, watcher: Watcher) -> SearchView:
    agent = run.arm.make()
    ready = prepare(run.problem, agent.name, seed=run.seed, runs=plan.runs, name=run.name)
    search(ready, agent, watcher.on_event, _silent)
    return open_run(ready.directory).view


def _silent(view: SearchView) -> None:
    del view


def _tables(
    plan: Plan, finished: Iterable[Finished], declared: str | None, test: TestResult | None
) -> tuple[Table, ...]:
    runs = tuple(finished)
    done = [compare(setting, runs, plan.paper) for setting in plan.settings]
    shown = [comparison_table(c, plan.paper) for c in done if c.rows]
    if plan.word == "compare":
        paired = paired_table(runs)
        return (*shown, *([paired] if paired is not None else []))
    return (*shown, *test_tables(plan, declared, test))


def _write(plan: Plan, tables: tuple[Table, ...]) -> Path:
    plan.directory.mkdir(parents=True, exist_ok=True)
    path = plan.directory / f"{plan.problem.name}.md"
    head = f"# {plan.problem.name}: {plan.budget} experiments a search, seeds "
    head += ", ".join(str(seed) for seed in plan.seeds)
    head += "\n\nQuick: short fits, too few experiments to compare.\n" if plan.quick else "\n"
    temporary = path.with_name(f".{path.name}.new")
    temporary.write_text("\n".join([head, *(t.markdown() for t in tables)]), encoding="utf-8")
    temporary.replace(path)
    return path
