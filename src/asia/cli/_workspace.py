"""asia workspace: a folder to work in by hand or by a coding agent."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from asia.cli._options import (
    DEFAULT_RUNS,
    MORE,
    EarlyStopping,
    Experiments,
    Hours,
    IsolationLevel,
    Name,
    ProblemName,
    Runs,
    Seed,
)


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("workspace", rich_help_panel=MORE)(workspace)


def workspace(
    problem: ProblemName,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to make.")],
    experiments: Experiments = None,
    seed: Seed = 0,
    hours: Hours = None,
    name: Name = None,
    early_stopping: EarlyStopping = None,
    isolation: IsolationLevel = None,
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Make a folder with the training data, the task and the baseline; asia try judges what you
    write there. The evaluator is another process, and the ledger lies elsewhere.

    The same command again renews the texts, keeps your candidate, and raises the budget.
    """
    from asia.cli._run import check_level, check_name
    from asia.drive import Order, make_workspace, prepare_order

    check_name(name)
    level = check_level(isolation)
    order = Order(
        problem=str(Path(problem).resolve()) if Path(problem).is_dir() else problem,
        agent="workspace",
        seed=seed,
        experiments=experiments,
        hours=hours,
        early_stopping=early_stopping,
        isolation=level.value if level else None,
    )
    prepared = prepare_order(order, runs, name)
    made = make_workspace(folder, prepared, order)
    sealed = prepared.started.test_digest
    print(f"wrote    {made.folder}: PROGRAM.md, models.md, description.md, data/, candidate.py")
    print(f"run      {prepared.directory}, {prepared.started.experiments} experiments")
    print(
        f"judge    isolation {prepared.started.isolation}; "
        f"test {'sealed, ' + sealed[:8] if sealed else 'none'}"
    )
    print(f'next     cd {folder}; read PROGRAM.md; edit candidate.py; asia try -m "why it helps"')
