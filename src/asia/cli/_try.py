"""asia try: have the workspace's candidate judged."""

from __future__ import annotations

import json as jsonlib
import sys
from dataclasses import asdict, astuple, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from asia.cli._options import MORE, Json
from asia.errors import Reason

if TYPE_CHECKING:
    from asia.drive import Desk, Job, Result, Standing

NO_SCORE = 3
# What ASIA says of a candidate, not the candidate of itself.
FOUND = (Reason.SUSPECT, Reason.RESTART, Reason.LITERAL_DATA, Reason.NOT_REPRODUCIBLE)


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("try", rich_help_panel=MORE)(try_)


def try_(
    message: Annotated[
        str, typer.Option("--message", "-m", help="Hypothesis: what changed, and why it helps.")
    ],
    expect: Annotated[str, typer.Option(help="What you expect of V, before you know it.")] = "",
    parent: Annotated[
        int | None, typer.Option(help="Experiment that the candidate was made from.")
    ] = None,
    family: Annotated[str, typer.Option(help="Kind of model, in a word or two.")] = "",
    folder: Annotated[
        Path, typer.Option("--dir", help="A workspace, or a folder inside one.")
    ] = Path(),
    json: Json = False,
) -> None:
    """Judge candidate.py of this workspace; waits for the result.

    Exit code 3: judged, and it has no score. Interrupt it and the candidate is judged all the same.
    """
    from asia.agents import Proposal
    from asia.drive import CANDIDATE, Workspace
    from asia.errors import UserError

    place = Workspace.find(folder)
    path = place.folder / CANDIDATE
    if not path.is_file():
        raise UserError(f"{path} does not exist: write the candidate there")
    desk = place.desk()
    try:
        source = path.read_text("utf-8")
    except UnicodeDecodeError:
        raise UserError(f"{path} is not UTF-8 text: write Python source") from None
    job = desk.submit(Proposal(source, family, message, message, expect, parent))
    result = _waited(desk, job)
    standing = desk.standing()
    place.renew_views()
    if json:
        print(jsonlib.dumps(_object(result, standing), allow_nan=False))
    else:
        for line in result_lines(result, standing):
            print(line)
    if result.value is None:
        raise typer.Exit(NO_SCORE)


def _waited(desk: Desk, job: Job) -> Result:
    from asia.drive import wait
    from asia.errors import UserError

    said = ""

    def tick(now: Job) -> None:
        nonlocal said
        words = _words(now, desk)
        if words != said:
            said = words
            print(words, file=sys.stderr, flush=True)

    while job.state not in ("done", "unknown"):
        job = wait(desk, job.ticket, 3600.0, tick)
    found = [r for r in desk.results() if r.experiment == job.experiment]
    if not found:
        raise UserError("the submission was taken back before it was judged")
    return found[0]


def _words(job: Job, desk: Desk) -> str:
    if job.state == "running":
        return f"#{job.experiment:02d} is being judged"
    if job.state == "queued" and desk.standing().experiments == 0:
        return "the rungs and the baseline are judged first"
    return f"queued, {job.ahead} before it" if job.state == "queued" else ""


def result_lines(result: Result, standing: Standing) -> list[str]:
    """What a person or an agent reads: a few lines."""
    from asia.ledger import error_value

    best = "none yet"
    if standing.best is not None and standing.best_value is not None:
        best = f"#{standing.best:02d} {error_value(standing.best_value)}"
    head = f"#{result.experiment:02d} {result.status:<8}"
    tail = f"    best {best}, {standing.remaining} of {standing.budget} experiments left"
    if result.value is not None:
        folds = ", ".join(error_value(v) for v in result.folds)
        name = standing.v_name
        parts = f" (folds {folds})" if folds else ""
        lines = [f"{head}{name} = {error_value(result.value)}{parts}"]
    else:
        lines = [f"{head}no score: {result.advice}"]
        if result.detail:
            words = "found" if result.reason in FOUND else "the candidate's own words"
            lines.append(f"    {words}: {result.detail}")
    if result.training is not None:
        values = zip(fields(result.training), astuple(result.training), strict=True)
        said = ", ".join(f"{f.name.replace('_', ' ')} {v:.3g}" for f, v in values)
        lines.append(f"    training side: {said.removeprefix('train ')}")
    if result.duplicate_of is not None:
        lines.append(f"    the same source as #{result.duplicate_of:02d}; its outcome stands")
    lines.append(tail)
    lines += [f"note from the person: {note}" for note in standing.notes[-3:]]
    return lines


def _object(result: Result, standing: Standing) -> dict[str, Any]:
    words = asdict(result)
    best = standing.best_value
    return {
        "experiment": words.pop("experiment"),
        "V": words.pop("value"),
        **words,
        "best": None if best is None else {"experiment": standing.best, "V": best},
        "remaining": standing.remaining,
        "notes": list(standing.notes),
    }
