"""asia agent workspace: a folder in which a user or a coding agent writes candidates."""

from __future__ import annotations

import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say
from asia.interfaces.cli.options import (
    DEFAULT_RUNS,
    JailOptions,
    ProblemName,
    Runs,
    SearchOptions,
    access_settings,
    jail_words,
)

if TYPE_CHECKING:
    from asia.interfaces.workspace.process import SearchRequest
    from asia.interfaces.workspace.workspace import Workspace
    from asia.search.run import Prepared


BRIEF_HELP = frozenset(
    {"problem", "folder", "experiments", "seed", "hours", "name", "runs", "isolation", "jail"}
    | {"network", "start"}
)


def workspace(
    *,
    problem: ProblemName,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to make.")],
    options: SearchOptions,
    jail: Annotated[
        str | None,
        typer.Option(
            metavar="CMD", help="Run this program in a jail that shows only the folder, and wait."
        ),
    ] = None,
    opened: JailOptions,
    start: Annotated[
        bool,
        typer.Option(
            "--start/--no-start", help="Evaluate the baseline now, or at the first asia try."
        ),
    ] = True,
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Make a folder with the training data, the task and the baseline. Edit the candidate there and
    submit it with asia try. The evaluator is another process, and the ledger is in another folder.

    Repeat the command to update the texts or to increase the budget; your candidate is kept.
    With --jail the exit code is that of the program.
    """
    from asia.interfaces.workspace.process import prepare_request

    request = options.request(
        str(Path(problem).resolve()) if Path(problem).is_dir() else problem, "workspace"
    )
    if jail is not None:
        settings = {"command": jail, "jail": "namespace", **access_settings(opened.access())}
        request = replace(request, settings=settings)
    else:
        _refuse_without_jail(opened)
    prepared = prepare_request(request, runs, options.name)
    if jail is not None:
        _work_in_jail(folder, prepared, request, shlex.split(jail), opened)
        return
    made = _made(folder, prepared, request)
    if start:
        _wait_for_baseline(made)
    say(f'next     cd {folder}; read PROGRAM.md; edit candidate.py; asia try -m "why it helps"')


def _refuse_without_jail(opened: JailOptions) -> None:
    from asia.errors import UserError
    from asia.interfaces.cli.options import given

    for name in given(opened):
        raise UserError(f"--{name.replace('_', '-')} belongs to --jail CMD: add it or leave it out")


def _made(folder: Path, prepared: Prepared, request: SearchRequest, jail: str = "") -> Workspace:
    from asia.interfaces.workspace.program import Confinement
    from asia.interfaces.workspace.workspace import make_workspace

    made = make_workspace(folder, prepared, request, Confinement(jail or "open"))
    sealed = prepared.started.test_digest
    files = sorted(p.name + "/" * p.is_dir() for p in made.folder.iterdir() if p.name[0] != ".")
    say(f"wrote    {made.folder}: {', '.join(files)}")
    say(f"run      {prepared.directory}, {prepared.started.experiments} experiments")
    say(
        f"judge    isolation {prepared.started.isolation_words}; "
        f"test {'sealed, ' + sealed[:8] if sealed else 'none'}"
    )
    return made


def _wait_for_baseline(place: Workspace) -> None:
    """Print a line for each reference model and the baseline. The search survives an interrupt."""
    from asia.interfaces.cli.display import Waiting, finished_line
    from asia.interfaces.workspace.server import wait

    desk = place.desk()
    before = desk.progress()
    if before.experiments:
        return
    waiting = Waiting(desk, lambda line: say(line, flush=True))
    try:
        wait(desk, "experiment-1", float("inf"), waiting.look)
    except KeyboardInterrupt:
        say("the baseline is still evaluated, in the background", file=sys.stderr)
        raise
    say(finished_line(desk.results()[0], desk.progress()))
    place.renew_views()


def _work_in_jail(
    folder: Path, prepared: Prepared, request: SearchRequest, words: list[str], opened: JailOptions
) -> None:
    from asia.interfaces.coding_agents.session import check_jail, run_jailed
    from asia.interfaces.workspace.process import start_search

    access = opened.access()
    check_jail(words, access, prepared.directory, prepared.problem)
    made = _made(folder, prepared, request, access.confinement.value)
    say(f"{words[0]:<8} {jail_words(access)}", flush=True)
    start_search(prepared.directory)
    code = run_jailed(made, words, access)
    say(f"{words[0]} ended with exit code {code}", file=sys.stderr)
    if code:
        raise typer.Exit(code)
