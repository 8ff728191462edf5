"""asia validate: check a model for use; repeat or take apart its fits."""

from __future__ import annotations

import json as jsonlib
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say
from asia.interfaces.cli.ablate import ablate_winner
from asia.interfaces.cli.confirm import repeat_candidates
from asia.interfaces.cli.init import split_at_commas
from asia.interfaces.cli.options import (
    DEFAULT_RUNS,
    ColumnNames,
    Experiment,
    Json,
    RunName,
    Runs,
    Time,
    TimeUnit,
    run_directory,
)

if TYPE_CHECKING:
    from asia.analysis.validation import ValidationReport

DEFAULT_TOP = 3
REPEAT_SEEDS = 5
ABLATE_SEEDS = 3
_fits = partial(typer.Option, rich_help_panel="Repeated fits (--repeat, --ablate)")


def validate(
    run: RunName = None,
    record: Annotated[
        Path | None,
        typer.Option(
            help="File with the problem's columns to validate the model on, in any format that "
            "asia init reads."
        ),
    ] = None,
    time: Time = None,
    time_unit: TimeUnit = None,
    columns: ColumnNames = None,
    experiment_column: Experiment = None,
    repeat: Annotated[
        bool,
        _fits(
            "--repeat",
            help="Fit the best candidates again from other seeds on every fold: which differ "
            "significantly, and the error to expect of the winner.",
        ),
    ] = False,
    ablate: Annotated[
        bool,
        _fits(
            "--ablate",
            help="Fit the winner with parts taken back: its model with the baseline's training, "
            "its training with the baseline's model, and without each change of its lineage.",
        ),
    ] = False,
    top: Annotated[
        int | None,
        _fits(min=1, help=f"Candidates to repeat, lowest V first; default {DEFAULT_TOP}."),
    ] = None,
    seeds: Annotated[
        int | None,
        _fits(
            min=1,
            help=f"Seeds for each; default {REPEAT_SEEDS} with --repeat, {ABLATE_SEEDS} with "
            "--ablate. One if fits do not depend on the seed.",
        ),
    ] = None,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Check whether the model of a run is fit for use, and list its deficiencies.

    Uses the held-out folds, small steps and a long simulation. The sealed test stays closed.
    --repeat and --ablate fit the candidates of a finished search again, on training records only.
    After an interrupt, the same command continues.
    """
    from asia.analysis.validation import validate as check
    from asia.data.intake.sheet import Wanted
    from asia.errors import UserError
    from asia.report import write_validation

    reading = Wanted(
        (), (), time, time_unit, experiment_column, tuple(split_at_commas(columns or ()))
    )
    if repeat and ablate:
        raise UserError("--repeat and --ablate do not go together: give one of them")
    if top is not None and not repeat:
        raise UserError("--top belongs to --repeat: add --repeat or leave it out")
    if seeds is not None and not (repeat or ablate):
        raise UserError("--seeds belongs to --repeat or --ablate: add one of them or leave it out")
    if (repeat or ablate) and (record is not None or reading != Wanted((), ())):
        option = "--repeat" if repeat else "--ablate"
        raise UserError(f"{option} uses training records only: leave --record and its columns out")
    directory = run_directory(runs, run)
    if repeat:
        repeat_candidates(directory, top or DEFAULT_TOP, seeds or REPEAT_SEEDS, json=json)
        return
    if ablate:
        ablate_winner(directory, seeds or ABLATE_SEEDS, json=json)
        return
    found = check(
        directory,
        record,
        lambda text: say(f"checking {text}", file=sys.stderr),
        None if reading == Wanted((), ()) else reading,
    )
    failed: list[str] = []
    for path in write_validation(directory, found.checks, found.summary, failed):
        say(str(path), file=sys.stderr)
    for line in failed:
        say(f"note    {line}", file=sys.stderr)
    if json:
        _print_json(found)
        return
    for one in found.checks:
        say(f"{one.verdict.upper():6}{one.name}: {one.sentence}")
    records = found.record or "training records"
    if not found.recorded:
        say("the search is not finished: its ledger does not keep this report", file=sys.stderr)
    say(f"experiment {found.experiment}, {found.model}, on {records}; the sealed test was not used")
    say(found.summary)


def _print_json(found: ValidationReport) -> None:
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
