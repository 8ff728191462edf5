"""asia run: search."""

from __future__ import annotations

import re
from contextlib import closing
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

from asia.cli._options import DEFAULT_RUNS, Json, Runs

NOTHING_FOUND = 3

if TYPE_CHECKING:
    from asia.problem.load import Problem
    from asia.sandbox import Isolation


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("run")(run)


def run(
    problem: Annotated[
        str, typer.Argument(help="Built-in name, or a directory with problem.toml.")
    ] = "two_tanks_sim",
    agent: Annotated[str, typer.Option(help="Who proposes: expert or random.")] = "expert",
    space: Annotated[
        str | None,
        typer.Option(help="What random draws from: library (default), or the paper's: paper."),
    ] = None,
    experiments: Annotated[
        int | None, typer.Option(min=1, help="Candidates to evaluate, the baseline included.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the search.")] = 0,
    hours: Annotated[
        float | None, typer.Option(help="Start no experiment after this many hours of evaluation.")
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the run; default PROBLEM-AGENT-sSEED.")
    ] = None,
    early_stopping: Annotated[
        str | None,
        typer.Option(help="inner, or validation (V is then not leak-free); default the problem's."),
    ] = None,
    isolation: Annotated[
        str | None, typer.Option(help="Ask for a level instead of the strongest: process.")
    ] = None,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Search for a model. The same command again resumes; more --experiments extends.

    Exit code 3: the search is finished and no candidate has a score.
    """
    from asia.agents import make_agent
    from asia.cli._display import make_display
    from asia.problem.load import load_problem
    from asia.report import write_report
    from asia.search import prepare, search

    chosen = make_agent(agent, space)
    check_name(name)
    loaded = _with_rules(load_problem(problem), experiments, hours, early_stopping)
    level = check_level(isolation)
    ready = prepare(loaded, chosen.name, seed=seed, runs=runs, name=name, isolation=level)
    with closing(make_display(loaded, ready, json=json)) as display:
        view = search(ready, chosen, display.on_event, display.on_start)
        pictures = write_report(ready.directory)
        display.finish(view, pictures)
    if view.best is None:
        raise typer.Exit(NOTHING_FOUND)


def _with_rules(
    problem: Problem, experiments: int | None, hours: float | None, early_stopping: str | None
) -> Problem:
    """What the command line says goes before the problem's own."""
    from asia.search import with_early_stopping

    own = problem.budget
    budget = replace(
        own,
        experiments=experiments or own.experiments,
        hours=hours if hours is not None else own.hours,
    )
    problem = replace(problem, budget=budget)
    return with_early_stopping(problem, early_stopping) if early_stopping is not None else problem


def check_level(isolation: str | None) -> Isolation | None:
    """The level of this name. Raises UserError for an unknown one."""
    from asia.errors import UserError
    from asia.sandbox import Isolation

    levels = [level.value for level in Isolation]
    if isolation is not None and isolation not in levels:
        raise UserError(f"--isolation {isolation}: expected one of {', '.join(levels)}")
    return Isolation(isolation) if isolation else None


def check_name(name: str | None) -> None:
    """A number would be taken for an experiment, a path would leave the directory of the runs."""
    from asia.errors import UserError

    if name is not None and (not re.fullmatch(r"\w[\w.+-]*", name) or name.isdecimal()):
        raise UserError(
            f"--name '{name}': expected letters, digits and . _ + - that begin with a letter or "
            "digit and are not a number alone"
        )
