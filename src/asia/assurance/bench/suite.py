"""Benchmark suite: every built-in benchmark searched and ranked."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

from asia._text import suggestion
from asia.agents.registry import make_agent
from asia.assurance.bench.comparison import (
    Arm,
    ComparisonPlan,
    TextTable,
    Watcher,
    bench,
)
from asia.errors import UserError
from asia.ledger.chain import write_whole
from asia.ledger.run import open_run
from asia.presentation.table import error_value
from asia.problem.load import load_problem
from asia.report.files import draw_all_boards
from asia.report.published import Board, read_board

# Plan of a suite: its benchmarks and their budgets.


SUITE = (
    "cascaded_tanks",
    "ced",
    "emps",
    "bouc_wen",
    "silverbox",
    "wiener_hammerstein",
    "nanodrone",
    "fine_steering_mirror",
    "f16",
    "parallel_wiener_hammerstein",
)
"""The benchmarks, small ones first."""


@dataclass(frozen=True)
class SuitePlan:
    """Plan with one search of the expert for each benchmark, with seed 0."""

    names: tuple[str, ...]
    """The benchmarks, in this order."""
    runs: Path
    """The directory of the runs."""
    experiments: int | None = None
    """Experiments of each search; None for each problem's own number."""

    @property
    def directory(self) -> Path:
        """Folder of the table and the picture."""
        return self.runs / "bench-suite"

    def comparison(self, name: str) -> ComparisonPlan:
        """The search of one benchmark, as `asia bench paper NAME` names it. Raises UserError when
        its data are not on this machine."""
        return ComparisonPlan(
            problem=load_problem(name),
            arms=(Arm("expert", "expert", partial(make_agent, "expert")),),
            seeds=(0,),
            runs=self.runs,
            settings=("inner",),
            experiments=self.experiments,
        )


def select_problems(only: str | None) -> tuple[str, ...]:
    """The benchmarks that `only` names, separated by commas, in the order of the suite; all when
    None. Raises UserError for a name that is not of the suite."""
    if only is None:
        return SUITE
    expected = [name.strip().replace("-", "_") for name in only.split(",") if name.strip()]
    for name in expected:
        if name not in SUITE:
            raise UserError(
                f"--only: there is no benchmark '{name}' in the suite{suggestion(name, SUITE)} "
                f"(they are {', '.join(SUITE)})"
            )
    if not expected:
        raise UserError(f"--only names no benchmark: expected some of {', '.join(SUITE)}")
    return tuple(name for name in SUITE if name in expected)


# Searches of a suite, compared with the published results.


_NOTHING = "-"
_HEADER = ("benchmark", "V", "experiments", "figure", "unit", "ours", "rank", "lowest published")


class SuiteWatcher(Watcher, Protocol):
    """Listens to a suite."""

    def on_benchmark(self, plan: ComparisonPlan) -> None:
        """A benchmark is about to be searched, or to be read when it is finished."""
        ...

    def on_left_out(self, name: str, reason: str) -> None:
        """A benchmark cannot be searched."""
        ...


@dataclass(frozen=True)
class BenchmarkResult:
    """Result of one benchmark's search."""

    name: str
    value: float | None = None
    """The best V; None where no candidate has a score or nothing was searched."""
    experiments: int = 0
    """Finished experiments."""
    board: Board | None = None
    """Published results, and ours where the test was opened; None where it was left out."""
    left_out: str = ""
    """Why it was left out; "" where it was not."""


@dataclass(frozen=True)
class SuiteResult:
    """A finished suite."""

    results: tuple[BenchmarkResult, ...]
    table: TextTable
    """The same for people, a row for each official figure."""
    document: Path
    pictures: tuple[Path, ...]
    """Picture of all leaderboards, PNG and PDF; () without published results."""


def bench_suite(
    plan: SuitePlan,
    watcher: SuiteWatcher,
    *,
    open_test: bool = False,
    process_consent: bool = False,
) -> SuiteResult:
    """Searches that exist are finished, not repeated: killed anywhere, the same call goes on. The
    table is written after each benchmark. A benchmark whose data are not on this machine is left
    out.

    open_test, process_consent: as in `bench`, for each benchmark.
    """
    results: list[BenchmarkResult] = []
    for name in plan.names:
        try:
            results.append(_search(plan.comparison(name), watcher, open_test, process_consent))
        except UserError as error:
            watcher.on_left_out(name, str(error))
            results.append(BenchmarkResult(name, left_out=str(error)))
        _write(plan, _table(results))
    boards = [r.board for r in results if r.board is not None]
    pictures = draw_all_boards(boards, "The suite among published results", plan.directory)
    table = _table(results)
    return SuiteResult(tuple(results), table, _write(plan, table), pictures)


def _search(
    plan: ComparisonPlan, watcher: SuiteWatcher, open_test: bool, process_consent: bool
) -> BenchmarkResult:
    watcher.on_benchmark(plan)
    bench(plan, watcher, open_test=open_test, process_consent=process_consent)
    (run,) = plan.searches
    view = open_run(plan.runs / run.name).view
    board = read_board(plan.problem, view)
    return BenchmarkResult(plan.problem.name, view.best_value, len(view.finished), board)


def _table(results: Sequence[BenchmarkResult]) -> TextTable:
    rows: list[tuple[str, ...]] = []
    for result in results:
        board = result.board
        if board is None:
            rows.append((result.name, *(_NOTHING,) * (len(_HEADER) - 1)))
            continue
        value = _NOTHING if result.value is None else error_value(result.value)
        head = (result.name, value, str(result.experiments))
        for index, name in enumerate(board.names or ("test",)):
            own = board.standings[index] if index < len(board.standings) else None
            ours = "sealed" if own is None else error_value(own.figure.value)
            rank = _NOTHING if own is None or own.among == 1 else f"{own.rank} of {own.among}"
            found = [e.figures[index] for e in board.entries if index < len(e.figures)]
            lowest = min((v for v in found if v is not None), default=None)
            best = _NOTHING if lowest is None else f"{lowest:g}"
            rows.append((*head, name, board.unit or _NOTHING, ours, rank, best))
            head = ("", "", "")
    notes = [f"{r.name} was left out: {r.left_out}" for r in results if r.left_out]
    if any(r.board is not None and not r.board.standings for r in results):
        notes.insert(0, "Sealed tests were not opened: --unseal opens them, once.")
    return TextTable("The suite", _HEADER, tuple(rows), tuple(notes))


def _write(plan: SuitePlan, table: TextTable) -> Path:
    path = plan.directory / "suite.md"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, f"# The suite\n\n{table.markdown()}".encode(), durable=False)
    return path
