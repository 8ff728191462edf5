"""asia bench: comparisons of agents, the paper's and the suite's benchmarks."""

from __future__ import annotations

import json as jsonlib
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import one_line, say, say_lines
from asia.errors import UserError
from asia.interfaces.cli.options import DEFAULT_RUNS, Json, ProblemName, Runs, YesProcess
from asia.interfaces.cli.output import experiment_line
from asia.ledger.events import Evaluated
from asia.presentation.table import error_value
from asia.problem.protocol import EarlyStopping

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from asia.assurance.bench.comparison import BenchResult, ComparisonPlan, Paper, PlannedRun
    from asia.ledger.events import Event
    from asia.ledger.view import SearchView
    from asia.problem.problem import Problem


@dataclass
class SearchLines:
    """One line per experiment; with `json`, JSON lines on stdout and these lines on stderr."""

    json: bool

    def head(self, plan: ComparisonPlan) -> None:
        """Print the plan."""
        searches = plan.searches
        total = sum(run.problem.budget.experiments for run in searches)
        self.print(
            f"{plan.word} {plan.problem.name}: {len(searches)} searches, {total} experiments, "
            f"seeds {', '.join(str(s) for s in plan.seeds)}, early stopping "
            f"{', '.join(plan.settings)}"
        )

    def on_run(self, run: PlannedRun, number: int, total: int) -> None:
        """Print the name of the search."""
        self.print(f"\n[{number}/{total}] {run.name}")

    def on_event(self, event: Event, view: SearchView) -> None:
        """Print the line of an evaluated experiment."""
        if isinstance(event, Evaluated):
            self.print(experiment_line(view.experiment(event.experiment), view))

    def on_end(self, run: PlannedRun, view: SearchView) -> None:
        """Print the best V of the search."""
        value = view.best_value
        text = "no candidate has a score" if value is None else f"best V {error_value(value)}"
        self.print(f"    {text} after {len(view.finished)} experiments")
        if self.json:
            found = {
                "event": "run",
                "run": run.name,
                "arm": run.arm.name,
                "early_stopping": run.setting,
                "seed": run.seed,
                "experiments": len(view.finished),
                "V": value,
            }
            say(jsonlib.dumps(found, allow_nan=False), flush=True)

    def on_benchmark(self, plan: ComparisonPlan) -> None:
        """Print the plan of one of several benchmarks."""
        self.head(plan)

    def on_left_out(self, name: str, reason: str) -> None:
        """Print the reason."""
        self.print(f"{name} is left out: {one_line(reason)}")

    def print(self, text: str) -> None:
        """Print a text line."""
        say(text, file=sys.stderr if self.json else sys.stdout, flush=True)


# asia bench paper: the comparisons of the paper on this machine.


LISTS = ("--seeds", "--arms")
DEFAULT_SEEDS = 3


def paper(
    problem: Annotated[
        str,
        typer.Argument(
            metavar="PROBLEM",
            help="cascaded-tanks, nanodrone, another built-in name, or a directory with "
            "problem.toml.",
        ),
    ],
    experiments: Annotated[
        int | None,
        typer.Option(
            min=1, help="Candidates for each search; default the paper's number or the problem's."
        ),
    ] = None,
    seeds: Annotated[
        list[int] | None,
        typer.Option(
            metavar="N | S S ...",
            help=f"One number: the number of seeds, from 0 on (default {DEFAULT_SEEDS}). Several "
            "numbers: the seeds.",
        ),
    ] = None,
    early_stopping: Annotated[
        str, typer.Option(help="inner (honest), validation (as in the paper), or both.")
    ] = "both",
    arms: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ARM ...", help="Some of expert, random, random-paper, references; default all."
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Minutes: few experiments, one seed, short fits.")
    ] = False,
    unseal: Annotated[
        bool,
        typer.Option("--unseal", help="At the very end, open the sealed test of the declared run."),
    ] = False,
    yes_process: YesProcess = False,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Repeat the comparisons of the paper, expert against random search, next to its figures.

    Each early-stopping setting has its own table. After an interrupt, the same command continues.
    The expert's run with the first seed is declared for the sealed test before it starts. Without
    --unseal no test is opened.
    """
    from asia.assurance.bench.comparison import ComparisonPlan, make_arms, select_arms
    from asia.assurance.bench.comparison import bench as compare

    settings: dict[str, tuple[EarlyStopping, ...]] = {
        "inner": ("inner",),
        "validation": ("validation",),
        "both": ("inner", "validation"),
    }
    if early_stopping not in settings:
        raise UserError(f"--early-stopping {early_stopping}: expected inner, validation or both")
    loaded, figures = _load_compared(problem)
    # The references need their full training.
    known = tuple(arm for arm in make_arms(figures) if arm.fixed is None or not quick)
    plan = ComparisonPlan(
        problem=loaded,
        arms=select_arms(known, arms),
        seeds=_chosen_seeds(seeds, 1 if quick else DEFAULT_SEEDS),
        runs=runs,
        settings=settings[early_stopping],
        experiments=experiments,
        paper=figures,
        quick=quick,
    )
    lines = SearchLines(json)
    lines.head(plan)
    result = compare(plan, lines, open_test=unseal, process_consent=yes_process)
    _print_result(result, json=json)


def _load_compared(name: str) -> tuple[Problem, Paper | None]:
    """Load the problem, and the figures of the paper if it treats this problem."""
    from asia.assurance.bench.comparison import paper as paper_figures
    from asia.problem.load import builtin_problems, load_problem

    builtin = name.replace("-", "_")
    if builtin in builtin_problems():
        return load_problem(builtin), paper_figures(builtin)
    return load_problem(name), None


def _chosen_seeds(given: list[int] | None, default: int) -> tuple[int, ...]:
    """Return the seeds for `--seeds N` (0 to N - 1) or `--seeds S S ...`."""
    if given is None:
        return tuple(range(default))
    if min(given) < 0 or given == [0]:
        raise UserError(
            f"--seeds {' '.join(str(s) for s in given)}: expected how many seeds (3 for 0, 1, 2), "
            "or several seeds (0 1 2), none below 0"
        )
    return tuple(range(given[0])) if len(given) == 1 else tuple(given)


def _print_result(result: BenchResult, *, json: bool) -> None:
    """Print the tables and the paths of documents and pictures; with `json`, one object."""
    from asia.assurance.bench.comparison import result_object

    if json:
        say(jsonlib.dumps({"event": "done", **result_object(result)}, allow_nan=False))
        return
    say()
    for table in result.tables:
        say_lines(table.markdown())
    say(f"tables   {result.document}")
    _print_pictures(result.pictures)
    if result.test is None and result.declared is not None:
        say(f"sealed   the test of {result.declared} is declared and unopened: --unseal")


def _print_pictures(pictures: Iterable[Path]) -> None:
    for picture in pictures:
        if picture.suffix == ".png":
            say(f"picture  {picture}")


# asia bench suite: every benchmark next to its board.


def suite(
    only: Annotated[
        str | None, typer.Option(metavar="NAME,NAME", help="Some of the benchmarks; default all.")
    ] = None,
    experiments: Annotated[
        int | None,
        typer.Option(min=1, help="Candidates for each search; default the problem's number."),
    ] = None,
    unseal: Annotated[
        bool, typer.Option("--unseal", help="At the very end, open the sealed tests.")
    ] = False,
    yes_process: YesProcess = False,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Search every benchmark once with the expert, and print the results next to its board.

    Without --unseal no test is opened. After an interrupt, the same command continues.
    """
    from asia.assurance.bench.suite import SuitePlan, bench_suite, select_problems

    plan = SuitePlan(select_problems(only), runs, experiments)
    result = bench_suite(plan, SearchLines(json), open_test=unseal, process_consent=yes_process)
    if not json:
        say()
        say_lines(result.table.markdown())
        say(f"table    {result.document}")
        _print_pictures(result.pictures)
        return
    found = {
        r.name: {
            "V": r.value,
            "experiments": r.experiments,
            "left_out": r.left_out or None,
            "unit": r.board.unit if r.board else None,
            "figures": {
                s.figure.name: {
                    "value": s.figure.value,
                    "rank": s.rank if s.among > 1 else None,
                    "among": s.among,
                }
                for s in (r.board.standings if r.board else ())
            },
        }
        for r in result.results
    }
    done = {"event": "done", "suite": found, "document": str(result.document)}
    say(jsonlib.dumps(done, allow_nan=False))


# asia bench agents: agents against each other at equal budgets.


COMPARE_LISTS = ("--seeds",)


def compare_agents(
    problem: ProblemName,
    agents: Annotated[
        str,
        typer.Option(help="Agents by name or module:Class, with commas between them."),
    ] = "expert,random,bayes",
    seeds: Annotated[
        list[int] | None,
        typer.Option(
            metavar="N | S S ...",
            help="One number: the number of seeds, from 0 on (default 5). Several numbers: the "
            "seeds.",
        ),
    ] = None,
    experiments: Annotated[
        int | None,
        typer.Option(min=1, help="Candidates for each search; default the problem's number."),
    ] = None,
    early_stopping: Annotated[
        str | None, typer.Option(help="inner, or validation; default the problem's.")
    ] = None,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Compare agents: a search with each agent and each seed at the same budget.

    Prints the experiments that each needs to reach the best V of the others, a paired test, and
    curves with bands. After an interrupt, the same command continues.
    """
    from asia.agents.registry import choose_agent
    from asia.assurance.bench.comparison import Arm, ComparisonPlan, bench
    from asia.search.run import with_early_stopping

    def arm(name: str) -> Arm:
        chosen = choose_agent(name)
        made = chosen.agent.name
        return Arm(made, name, lambda: choose_agent(name).agent, settings=chosen.settings)

    arms = tuple(arm(name.strip()) for name in agents.split(",") if name.strip())
    loaded, _ = _load_compared(problem)
    if early_stopping is not None:
        loaded = with_early_stopping(loaded, early_stopping)
    plan = ComparisonPlan(
        problem=loaded,
        arms=arms,
        seeds=_chosen_seeds(seeds, 5),
        runs=runs,
        settings=(loaded.protocol.early_stopping,),
        experiments=experiments,
        word="compare",
    )
    lines = SearchLines(json)
    lines.head(plan)
    _print_result(bench(plan, lines), json=json)
