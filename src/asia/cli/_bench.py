"""asia bench paper: the comparisons of the paper on this machine."""

from __future__ import annotations

import json as jsonlib
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say, say_lines
from asia.cli._options.shared import DEFAULT_RUNS, Json, Runs, YesProcess
from asia.cli._output.comparison import Lines

if TYPE_CHECKING:
    from asia.bench import Arm, BenchResult, Paper
    from asia.problem.load import Problem
    from asia.protocol import EarlyStopping

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
    from asia.bench import ComparisonPlan, select_arms
    from asia.bench import bench as compare

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
    from asia.bench import paper as paper_figures
    from asia.problem.load import builtin_problems, load_problem

    builtin = name.replace("-", "_")
    if builtin in builtin_problems():
        return load_problem(builtin), paper_figures(builtin)
    return load_problem(name), None


def _arms(figures: Paper | None, quick: bool) -> tuple[Arm, ...]:
    """Return the arms; without the references if `quick`, because they need their full training."""
    from asia.bench import make_arms

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
    from asia.bench import result_object

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
