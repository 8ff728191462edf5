"""asia show: one experiment, whole."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from asia._text import hand_over, printable
from asia.cli._options.run_directory import run_directory
from asia.cli._options.shared import DEFAULT_RUNS, Json, Runs


def split_arguments(words: list[str], numbers: int) -> tuple[str | None, list[int]]:
    """`[RUN] N ...` -> run name or None, and at most `numbers` experiment numbers."""
    from asia.errors import UserError

    name = words[0] if words and not words[0].isdecimal() else None
    rest = words[1:] if name is not None else words
    if not all(w.isdecimal() for w in rest) or len(rest) > numbers:
        raise UserError(f"expected [RUN] and up to {numbers} experiment number(s), got: {words}")
    return name, [int(w) for w in rest]


def show(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[RUN] [N]",
            help="Run (newest) and experiment (the best, or the last while none has a score).",
        ),
    ] = None,
    source: Annotated[bool, typer.Option("--source", help="Print candidate.py alone.")] = False,
    as_json: Json = False,
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Print an experiment: hypothesis, result, what was identified, evidence, source."""
    from rich.syntax import Syntax

    from asia.cli._output.experiment import describe, experiment_object, wide_console
    from asia.errors import UserError
    from asia.ledger import open_run

    name, numbers = split_arguments(words or [], 1)
    opened = open_run(run_directory(runs, name))
    view = opened.view
    if not view.experiments:
        raise UserError(f"run '{opened.name}' has no experiment yet")
    shown = view.best or view.experiments[-1]
    experiment = view.experiment(numbers[0]) if numbers else shown
    kept = opened.store.kept
    if source:
        hand_over(opened.store.text(experiment.proposed.source))
        return
    if as_json:
        hand_over(json.dumps(experiment_object(opened, experiment), allow_nan=False) + "\n")
        return
    console = wide_console()
    describe(console, opened, experiment)
    if not kept:
        console.print(
            "\ncandidate.py and what it printed are not here: the ledger came without its artifacts"
        )
        return
    text = opened.store.text(experiment.proposed.source)
    console.print("\ncandidate.py", style="bold")
    if console.is_terminal:
        console.print(Syntax(printable(text), "python", background_color="default"))
    else:
        hand_over(f"{text}\n")
