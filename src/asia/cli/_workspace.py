"""asia workspace: a folder to work in by hand or by a coding agent."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from asia._text import say
from asia.cli._options.search import SearchOptions
from asia.cli._options.shared import DEFAULT_RUNS, ProblemName, Runs


def workspace(
    *,
    problem: ProblemName,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to make.")],
    options: SearchOptions,
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Make a folder with the training data, the task and the baseline. Edit the candidate there and
    submit it with asia try. The evaluator is another process, and the ledger is in another folder.

    The same command again updates the texts, keeps your candidate, and can increase the budget.
    """
    from asia.drive import make_workspace, prepare_request

    request = options.request(
        str(Path(problem).resolve()) if Path(problem).is_dir() else problem, "workspace"
    )
    prepared = prepare_request(request, runs, options.name)
    made = make_workspace(folder, prepared, request)
    sealed = prepared.started.test_digest
    say(f"wrote    {made.folder}: PROGRAM.md, models.md, description.md, data/, candidate.py")
    say(f"run      {prepared.directory}, {prepared.started.experiments} experiments")
    say(
        f"judge    isolation {prepared.started.isolation_words}; "
        f"test {'sealed, ' + sealed[:8] if sealed else 'none'}"
    )
    say(f'next     cd {folder}; read PROGRAM.md; edit candidate.py; asia try -m "why it helps"')
