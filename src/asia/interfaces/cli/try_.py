"""asia try: submit the candidate of a workspace."""

from __future__ import annotations

import json as jsonlib
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO

import typer

from asia._text import say
from asia.errors import Reason, UserError
from asia.interfaces.cli.options import Json

if TYPE_CHECKING:
    from asia.agents.view import Proposal
    from asia.interfaces.workspace.server import Desk, ExperimentSummary, SearchProgress, Submission
    from asia.interfaces.workspace.workspace import Workspace

NO_SCORE = 3
# What ASIA says of a candidate, not the candidate of itself.
FOUND = (Reason.SUSPECT, Reason.RESTART, Reason.LITERAL_DATA, Reason.NOT_REPRODUCIBLE)


def try_(
    message: Annotated[
        str, typer.Option("--message", "-m", help="Hypothesis: what changed, and why it helps.")
    ] = "",
    expect: Annotated[
        str,
        typer.Option(help="Expected V and residuals, as text or a number."),
    ] = "",
    parent: Annotated[
        int | None, typer.Option(help="Experiment that the candidate was derived from.")
    ] = None,
    family: Annotated[str, typer.Option(help="Kind of model, in a word or two.")] = "",
    folder: Annotated[
        Path, typer.Option("--dir", help="A workspace, or a folder inside one.")
    ] = Path(),
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="Only fit and simulate on some training samples; uses no experiment."
        ),
    ] = False,
    plot: Annotated[
        bool,
        typer.Option("--plot", help="Also draw the simulation and its residuals into plots/."),
    ] = False,
    json: Json = False,
) -> None:
    """Evaluate candidate.py of this workspace, and wait for the result.

    Exit code 3: the candidate has no score. It is evaluated even if you interrupt this command.
    """
    from asia._files import read_text
    from asia.agents.view import Proposal
    from asia.interfaces.workspace.workspace import CANDIDATE, Workspace

    if dry_run and plot:
        raise UserError("--plot needs a score, and --dry-run gives none: leave one of them out")
    if not dry_run and not message.strip():
        raise UserError(
            'a candidate needs a hypothesis: asia try -m "what you changed, and why it should help"'
        )
    place = Workspace.find(folder)
    path = place.folder / CANDIDATE
    source = read_text(path, "write the candidate there, as Python source")
    desk = place.desk()
    if dry_run:
        _dry_run(desk, source, json=json)
        return
    proposal = Proposal(source, family, message, message, expect, parent)
    _submit(place, desk, proposal, plot=plot, json=json)


def _submit(place: Workspace, desk: Desk, proposal: Proposal, *, plot: bool, json: bool) -> None:
    submission = desk.submit(proposal)
    # One stream, so that the lines keep their order where the output is captured.
    result = _waited(desk, submission, sys.stderr if json else sys.stdout)
    progress, evidence = desk.progress(), desk.evidence(result.experiment)
    place.renew_views()
    drawn = _drawn(place, desk, result.experiment) if plot and result.value is not None else ()
    if json:
        answer = {
            **_object(result, progress),
            "repeated": submission.repeated,
            "pictures": list(drawn),
            "evidence": asdict(evidence),
        }
        say(jsonlib.dumps(answer, allow_nan=False))
    else:
        if submission.repeated:
            say(_repeated_line(result))
        for line in result_lines(result, progress, evidence.lines):
            say(line)
        for name in drawn:
            say(f"    picture {name}")
    if result.value is None:
        raise typer.Exit(NO_SCORE)


def _drawn(place: Workspace, desk: Desk, experiment: int) -> tuple[str, ...]:
    """Draw the pictures of an experiment; a failure is reported and the result stays valid."""
    from asia.errors import UserError

    try:
        return place.draw(experiment, desk.simulated(experiment))
    except UserError as error:
        say(f"no picture: {error}", file=sys.stderr)
        return ()


def _dry_run(desk: Desk, source: str, *, json: bool) -> None:
    from asia.interfaces.workspace.server import dry_run_lines

    found = desk.dry_run(source)
    if json:
        say(jsonlib.dumps(asdict(found), allow_nan=False))
    else:
        for line in dry_run_lines(found):
            say(line)
    if found.reason is not None:
        raise typer.Exit(NO_SCORE)


def _repeated_line(result: ExperimentSummary) -> str:
    return (
        f"not evaluated again: the source equals that of #{result.experiment:02d}, apart from "
        "comments. No experiment was used:"
    )


def _waited(desk: Desk, submission: Submission, stream: TextIO) -> ExperimentSummary:
    from asia.errors import UserError
    from asia.interfaces.cli.display import Waiting
    from asia.interfaces.workspace.server import wait

    if submission.state not in ("done", "unknown"):
        waiting = Waiting(desk, lambda line: say(line, file=stream, flush=True))
        while submission.state not in ("done", "unknown"):
            submission = wait(desk, submission.ticket, 3600.0, waiting.look)
    found = [r for r in desk.results() if r.experiment == submission.experiment]
    if not found:
        raise UserError("the submission was withdrawn before it was evaluated")
    return found[0]


def result_lines(
    result: ExperimentSummary, progress: SearchProgress, evidence: Sequence[str] = ()
) -> list[str]:
    """Return the result of an experiment on one screen, with `evidence` in the middle."""
    from asia.interfaces.cli.text import training_lines
    from asia.ledger.text import error_value

    best = "none yet"
    if progress.best is not None and progress.best_value is not None:
        best = f"#{progress.best:02d} {error_value(progress.best_value)}"
    head = f"#{result.experiment:02d} {result.status:<7} "
    tail = f"    best {best}, {progress.remaining} of {progress.budget} experiments left"
    if result.value is not None:
        folds = ", ".join(error_value(v) for v in result.folds)
        name = progress.v_name
        parts = f" (folds {folds})" if folds else ""
        lines = [f"{head}{name} = {error_value(result.value)}{parts}"]
    else:
        lines = [f"{head}no score: {result.advice}"]
        if result.detail:
            words = "found" if result.reason in FOUND else "the candidate's own words"
            lines.append(f"    {words}: {result.detail}")
    lines += [f"    {line}" for line in evidence]
    if result.training is not None:
        lines += [f"    {line}" for line in training_lines(result.training)]
    if result.duplicate_of is not None:
        lines.append(f"    the same source as #{result.duplicate_of:02d}; its outcome stands")
    lines.append(tail)
    lines += [f"note from the user: {note}" for note in progress.notes[-3:]]
    return lines


def _object(result: ExperimentSummary, progress: SearchProgress) -> dict[str, Any]:
    words = asdict(result)
    best = progress.best_value
    return {
        "experiment": words.pop("experiment"),
        "V": words.pop("value"),
        **words,
        "best": None if best is None else {"experiment": progress.best, "V": best},
        "remaining": progress.remaining,
        "notes": list(progress.notes),
    }
