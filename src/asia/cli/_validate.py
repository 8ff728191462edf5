"""asia validate: may this model be used?"""

from __future__ import annotations

import json as jsonlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say
from asia.cli._options.run_directory import run_directory
from asia.cli._options.shared import (
    DEFAULT_RUNS,
    ColumnNames,
    Experiment,
    Json,
    RunName,
    Runs,
    Time,
    TimeUnit,
)

if TYPE_CHECKING:
    from asia.search import Dossier


def validate(
    run: RunName = None,
    record: Annotated[
        Path | None,
        typer.Option(
            help="A file with the problem's columns, to validate the model on; every format that "
            "asia init reads."
        ),
    ] = None,
    time: Time = None,
    time_unit: TimeUnit = None,
    columns: ColumnNames = None,
    experiment_column: Experiment = None,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Check the model to use of a run, and say what is missing in it.

    Judges what the folds held out, and how the model answers small steps and a long run. The sealed
    test stays closed.
    """
    from asia.problem.load import Wanted
    from asia.report import write_dossier
    from asia.search import validate as check

    reading = Wanted((), (), time, time_unit, experiment_column, tuple(columns or ()))
    directory = run_directory(runs, run)
    found = check(
        directory,
        record,
        lambda text: say(f"checking {text}", file=sys.stderr),
        None if reading == Wanted((), ()) else reading,
    )
    failed: list[str] = []
    for path in write_dossier(directory, found.checks, found.summary, failed):
        say(str(path), file=sys.stderr)
    for line in failed:
        say(f"note    {line}", file=sys.stderr)
    if json:
        _print_json(found)
        return
    for one in found.checks:
        say(f"{one.verdict.upper():6}{one.name}: {one.sentence}")
    what = "training records" if found.record is None else found.record
    if not found.recorded:
        say("the search is not finished: its ledger does not keep this dossier", file=sys.stderr)
    say(f"experiment {found.experiment}, {found.model}, on {what}; the sealed test was not used")
    say(found.summary)


def _print_json(found: Dossier) -> None:
    for one in found.checks:
        line = {"check": one.name, "verdict": one.verdict, "sentence": one.sentence}
        say(jsonlib.dumps({**line, "cause": one.cause}, allow_nan=False))
    end: dict[str, object] = {
        "run": found.run,
        "experiment": found.experiment,
        "model": found.model,
    }
    end |= {"record": found.record, "recorded": found.recorded, "summary": found.summary}
    say(jsonlib.dumps(end, allow_nan=False))
