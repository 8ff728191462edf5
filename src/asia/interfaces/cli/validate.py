"""asia validate: check a model for use; repeat or take apart its fits."""

from __future__ import annotations

import json as jsonlib
import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say
from asia._timer import duration
from asia.errors import UserError
from asia.interfaces.cli.init import split_at_commas
from asia.interfaces.cli.options import ColumnNames, Experiment, RunName, RunOptions, Time, TimeUnit
from asia.interfaces.cli.output import fact_line, verdict_facts, verdict_object
from asia.ledger.events import Fit
from asia.ledger.run import open_run
from asia.presentation.results import (
    ablation_blocks,
    confirmation_blocks,
    validation_blocks,
    validation_text,
)
from asia.presentation.table import block_lines, error_value

if TYPE_CHECKING:
    from asia.judge.sandbox.types import Isolation

DEFAULT_TOP = 3
REPEAT_SEEDS = 5
ABLATE_SEEDS = 3
_fits = partial(typer.Option, rich_help_panel="Repeated fits (--repeat, --ablate)")


def validate(
    *,
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
            "significantly, and the error to expect of the best candidate.",
        ),
    ] = False,
    ablate: Annotated[
        bool,
        _fits(
            "--ablate",
            help="Fit the best candidate with parts taken back: its model with the baseline's "
            "training, its training with the baseline's model, and without each change of its "
            "lineage.",
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
    options: RunOptions,
) -> None:
    """Check whether the model of a run is valid: fit for use, with a list of its deficiencies; on a
    record of your own with --record.

    Uses the held-out folds, small steps and a long simulation. The sealed test stays closed.
    --repeat and --ablate fit the candidates of a finished search again, on training records only.
    After an interrupt, the same command continues.
    """
    from asia.analysis.validation import validate as check
    from asia.data.intake.sheet import Wanted
    from asia.report.files import write_validation

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
    directory, level, json = options.directory(run), options.level, options.json
    if repeat:
        _repeat(directory, top or DEFAULT_TOP, seeds or REPEAT_SEEDS, level, json=json)
        return
    if ablate:
        _ablate(directory, seeds or ABLATE_SEEDS, level, json=json)
        return
    found = check(
        directory,
        record,
        lambda text: say(f"checking {text}", file=sys.stderr),
        None if reading == Wanted((), ()) else reading,
        level,
    )
    failed: list[str] = []
    for path in write_validation(directory, found.checks, validation_text(found.event), failed):
        say(str(path), file=sys.stderr)
    for line in failed:
        say(f"note    {line}", file=sys.stderr)
    if json:
        for one in found.checks:
            line = {"check": one.name, "verdict": one.verdict, "sentence": one.sentence}
            say(jsonlib.dumps({**line, "cause": one.cause}, allow_nan=False))
        end: dict[str, object] = {"run": found.run, "experiment": found.event.experiment}
        end |= {"model": found.event.model, "record": found.event.record or None}
        end |= {"recorded": found.recorded, "summary": validation_text(found.event)}
        end["verdict"] = verdict_object(open_run(directory).view)
        say(jsonlib.dumps(end, allow_nan=False))
        return
    for one in found.checks:
        say(f"{one.verdict.upper():6}{one.name}: {one.sentence}")
    if not found.recorded:
        say("the search is not finished: its ledger does not keep this report", file=sys.stderr)
    for line in block_lines(validation_blocks(found.event)):
        say(line)
    for label, text in verdict_facts(open_run(directory).view):
        say(fact_line(label, text))


# Repeated fits of the best candidates (--repeat).


def _repeat(directory: Path, top: int, seeds: int, level: Isolation, *, json: bool) -> None:
    from asia.analysis.confirmation import confirm

    def fitted(event: Fit, done: int, total: int) -> None:
        if json:
            fit = {"event": "repeated", "experiment": event.experiment, "repeat": event.seed}
            line = {**fit, "V": event.value, "same": event.same, "done": done, "of": total}
            say(jsonlib.dumps(line, allow_nan=False), flush=True)
            return
        value = event.failed if event.value is None else error_value(event.value)
        same = ", as in the search: its fits do not depend on the seed" if event.same else ""
        say(
            f"#{event.experiment:02d} seed {event.seed}: V={value} in "
            f"{duration(event.seconds)}{same}  [{done} of {total}]",
            file=sys.stderr,
            flush=True,
        )

    found, new = confirm(directory, fitted, top=top, seeds=seeds, isolation=level)
    if json:
        say(jsonlib.dumps({"new": new, **asdict(found)}, allow_nan=False))
        return
    if not new:
        say("nothing new to fit: these results are in the ledger", file=sys.stderr)
    for line in block_lines(confirmation_blocks(found, open_run(directory).view.v_name)):
        say(line)


# The gain of the best candidate in parts (--ablate).


def _ablate(directory: Path, seeds: int, level: Isolation, *, json: bool) -> None:
    from asia.analysis.ablation import ablate
    from asia.report.files import write_report

    def fitted(event: Fit, done: int, total: int) -> None:
        if json:
            fit = {"event": "ablation_fit", "variant": event.variant, "seed": event.seed}
            line = {**fit, "V": event.value, "failed": event.failed, "done": done, "of": total}
            say(jsonlib.dumps(line, allow_nan=False), flush=True)
            return
        value = event.failed if event.value is None else f"V={error_value(event.value)}"
        text = f"{event.variant}, seed {event.seed}: {value} in {duration(event.seconds)}"
        say(f"{text}  [{done} of {total}]", file=sys.stderr, flush=True)

    found, new = ablate(directory, fitted, seeds=seeds, isolation=level)
    if json:
        say(jsonlib.dumps({"new": new, **asdict(found)}, allow_nan=False))
        return
    if not new:
        say("nothing new to fit: these results are in the ledger", file=sys.stderr)
    for line in block_lines(ablation_blocks(found, open_run(directory).view.v_name)):
        say(line)
    for picture in write_report(directory):
        if picture.name == "ablation.png":
            say(f"picture  {picture}")
