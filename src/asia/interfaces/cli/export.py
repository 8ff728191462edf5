"""asia export: code of the model for other programs."""

from __future__ import annotations

import json as jsonlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say
from asia.errors import UserError
from asia.interfaces.cli.options import RunName, RunOptions

if TYPE_CHECKING:
    from asia.export.target import ParityRow


def export(
    *,
    run: RunName = None,
    to: Annotated[
        list[str] | None,
        typer.Option(help="Target, repeatable, such as c or onnx; a wrong name prints them all."),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            help="refit, ensemble, stack, or the number of an experiment; default: the model to "
            "use."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for one folder per target; default: export in the run."),
    ] = None,
    options: RunOptions,
) -> None:
    """Write a model of a run as code for other programs.

    Compares the code with ASIA's own simulation of the training windows, and writes only code that
    agrees.
    """
    from asia.export.pipeline import export as write
    from asia.export.pipeline import table, target_names

    if not to:
        raise UserError(f"--to is missing: one of {', '.join(target_names())}, or several")
    for one in write(options.directory(run), to, model, out, isolation=options.level):
        if options.json:
            say(parity_json(one.target, one.files, one.parity))
        options.print([
            *table(one.parity), f"sampling time {one.sampling_time:g} s, a row a step",
            *(f"note      {note}" for note in one.notes), str(one.folder),
        ])  # fmt: skip


def parity_json(target: str, files: Sequence[Path], rows: Sequence[ParityRow]) -> str:
    """Files of a target and their comparison with the simulation, as a JSON line."""
    facts = {
        "target": target,
        "files": [str(path) for path in files],
        "parity": {row.target: row.difference for row in rows},
        "microseconds_per_step": {row.target: row.microseconds for row in rows},
        "bytes": rows[0].bytes,
    }
    return jsonlib.dumps(facts, allow_nan=False)
