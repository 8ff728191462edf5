"""asia bench: comparisons of agents, the paper's and the suite's benchmarks."""

from __future__ import annotations

import json as jsonlib
from typing import TYPE_CHECKING, Annotated, Any

import typer

from asia._text import one_line, say, say_lines
from asia.interfaces.cli.options import DEFAULT_RUNS, Json, ProblemName, Runs, YesProcess
from asia.interfaces.cli.results import Lines

if TYPE_CHECKING:
    from asia.assurance.bench.comparison import Arm, BenchResult, ComparisonPlan, Paper
    from asia.assurance.bench.suite import SuiteResult
    from asia.problem.problem import Problem
    from asia.problem.protocol import EarlyStopping


# asia bench paper: the comparisons of the paper on this machine.


LISTS = ("--seeds", "--arms")
DEFAULT_SEEDS = 3

Problems = Annotated[
    str,
    typer.Argument(
        metavar="PROBLEM",
        help=(
            "cascaded-tanks, nanodrone, another built-in name, or a directory with problem.toml."
        ),
    ),
]
Seeds = Annotated[
    list[int] | None,
    typer.Option(
        metavar="N | S S ...",
        help=(
            f"One number: the number of seeds, from 0 on (default {DEFAULT_SEEDS}). Several "
            "numbers: the seeds."
        ),
    ),
]
Arms = Annotated[
    list[str] | None,
    typer.Option(
        metavar="ARM ...", help="Some of expert, random, random-paper, references; default all."
    ),
]


Experiments = Annotated[
    int | None,
    typer.Option(
        min=1, help="Candidates for each search; default the paper's number or the problem's."
    ),
]


def paper(
    problem: Problems,
    experiments: Experiments = None,
    seeds: Seeds = None,
    early_stopping: Annotated[
        str, typer.Option(help="inner (honest), validation (as in the paper), or both.")
    ] = "both",
    arms: Arms = None,
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
    from asia.assurance.bench.comparison import ComparisonPlan, select_arms
    from asia.assurance.bench.comparison import bench as compare

    loaded, figures = load_compared(problem)
    plan = ComparisonPlan(
        problem=loaded,
        arms=select_arms(_arms(figures, quick), arms),
        seeds=chosen_seeds(seeds, 1 if quick else DEFAULT_SEEDS),
        runs=runs,
        settings=_settings(early_stopping),
        experiments=experiments,
        paper=figures,
        quick=quick,
    )
    lines = Lines(json)
    lines.head(plan)
    result = compare(plan, lines, open_test=unseal, process_consent=yes_process)
    print_result(result, json=json)


def load_compared(name: str) -> tuple[Problem, Paper | None]:
    """Load the problem, and the figures of the paper if it treats this problem."""
    from asia.assurance.bench.comparison import paper as paper_figures
    from asia.problem.load import builtin_problems, load_problem

    builtin = name.replace("-", "_")
    if builtin in builtin_problems():
        return load_problem(builtin), paper_figures(builtin)
    return load_problem(name), None


def _arms(figures: Paper | None, quick: bool) -> tuple[Arm, ...]:
    """Return the arms; without the references if `quick`, because they need their full training."""
    from asia.assurance.bench.comparison import make_arms

    return tuple(arm for arm in make_arms(figures) if arm.fixed is None or not quick)


def chosen_seeds(given: list[int] | None, default: int) -> tuple[int, ...]:
    """Return the seeds for `--seeds N` (0 to N - 1) or `--seeds S S ...`."""
    from asia.errors import UserError

    if given is None:
        return tuple(range(default))
    if min(given) < 0 or given == [0]:
        raise UserError(
            f"--seeds {' '.join(str(s) for s in given)}: expected how many seeds (3 for 0, 1, 2), "
            "or several seeds (0 1 2), none below 0"
        )
    return tuple(range(given[0])) if len(given) == 1 else tuple(given)


def _settings(word: str) -> tuple[EarlyStopping, ...]:
    from asia.errors import UserError

    known: dict[str, tuple[EarlyStopping, ...]] = {
        "inner": ("inner",),
        "validation": ("validation",),
        "both": ("inner", "validation"),
    }
    if word not in known:
        raise UserError(f"--early-stopping {word}: expected inner, validation or both")
    return known[word]


def print_result(result: BenchResult, *, json: bool) -> None:
    """Print the tables and the paths of documents and pictures; with `json`, one object."""
    from asia.assurance.bench.comparison import result_object

    if json:
        say(jsonlib.dumps({"event": "done", **result_object(result)}, allow_nan=False))
        return
    say()
    for table in result.tables:
        say_lines(table.markdown())
    say(f"tables   {result.document}")
    for picture in result.pictures:
        if picture.suffix == ".png":
            say(f"picture  {picture}")
    if result.test is None and result.declared is not None:
        say(f"sealed   the test of {result.declared} is declared and unopened: --unseal")


# asia bench suite: every benchmark next to its board.


class SuiteLines(Lines):
    """Lines of each search, and one line per benchmark."""

    def on_benchmark(self, plan: ComparisonPlan) -> None:
        """Print the name of the benchmark."""
        self.head(plan)

    def on_left_out(self, name: str, reason: str) -> None:
        """Print the reason."""
        self.print(f"{name} is left out: {one_line(reason)}")


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
    lines = SuiteLines(json)
    result = bench_suite(plan, lines, open_test=unseal, process_consent=yes_process)
    if json:
        say(jsonlib.dumps({"event": "done", **_as_object(result)}, allow_nan=False))
        return
    say()
    say_lines(result.table.markdown())
    say(f"table    {result.document}")
    for picture in result.pictures:
        if picture.suffix == ".png":
            say(f"picture  {picture}")


def _as_object(result: SuiteResult) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for r in result.results:
        standings = r.board.standings if r.board else ()
        found[r.name] = {
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
                for s in standings
            },
        }
    return {"suite": found, "document": str(result.document)}


# asia bench agents: agents against each other at equal budgets.


COMPARE_LISTS = ("--seeds",)

Agents = Annotated[
    str,
    typer.Option(
        help="Agents by name or module:Class, or relays such as expert*5+bayes, with commas "
        "between them."
    ),
]


def compare_agents(
    problem: ProblemName,
    agents: Agents = "expert,random,bayes",
    seeds: Annotated[
        list[int] | None,
        typer.Option(
            metavar="N | S S ...",
            help=(
                "One number: the number of seeds, from 0 on (default 5). Several numbers: the "
                "seeds."
            ),
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
    from asia.assurance.bench.comparison import ComparisonPlan, bench
    from asia.search.run import with_early_stopping

    names = [name.strip() for name in agents.split(",") if name.strip()]
    arms = tuple(_arm(name) for name in names)
    loaded, _ = load_compared(problem)
    if early_stopping is not None:
        loaded = with_early_stopping(loaded, early_stopping)
    plan = ComparisonPlan(
        problem=loaded,
        arms=arms,
        seeds=chosen_seeds(seeds, 5),
        runs=runs,
        settings=(loaded.protocol.early_stopping,),
        experiments=experiments,
        word="compare",
    )
    lines = Lines(json)
    lines.head(plan)
    result = bench(plan, lines)
    print_result(result, json=json)


def _arm(name: str) -> Arm:
    from asia.agents.registry import choose_agent
    from asia.assurance.bench.comparison import Arm

    chosen = choose_agent(name)
    return Arm(chosen.agent.name, name, lambda: choose_agent(name).agent, settings=chosen.settings)
