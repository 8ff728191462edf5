"""asia show: one experiment, or two side by side."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from asia._text import hand_over, printable
from asia.interfaces.cli.diff import print_difference
from asia.interfaces.cli.options import DEFAULT_RUNS, Json, Runs, run_directory


def _split_arguments(words: list[str]) -> tuple[str | None, list[int]]:
    """`[RUN] [N [M]]` -> run name or None, and the experiment numbers."""
    from asia.errors import UserError

    name = words[0] if words and not words[0].isdecimal() else None
    rest = words[1:] if name is not None else words
    if not all(w.isdecimal() for w in rest) or len(rest) > 2:
        raise UserError(f"expected [RUN] [N [M]] with experiment numbers, got: {' '.join(words)}")
    return name, [int(w) for w in rest]


def show(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[RUN] [N [M]]",
            help="Run (default: the newest) and experiment (default: the best, or the last if none "
            "has a score). Two numbers: both experiments, and the change of the source.",
        ),
    ] = None,
    source: Annotated[bool, typer.Option("--source", help="Print only candidate.py.")] = False,
    as_json: Json = False,
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Print an experiment: hypothesis, result, identified parameters, evidence, source. With two
    numbers, compare two experiments."""
    from rich.syntax import Syntax

    from asia.errors import UserError
    from asia.interfaces.cli.results import describe, experiment_object, wide_console
    from asia.ledger.run import open_run

    name, numbers = _split_arguments(words or [])
    opened = open_run(run_directory(runs, name))
    view = opened.view
    if not view.experiments:
        raise UserError(f"run '{opened.name}' has no experiment yet")
    shown = [view.experiment(n) for n in numbers] or [view.best or view.experiments[-1]]
    if source:
        if len(shown) > 1:
            raise UserError("--source prints one candidate.py: give one experiment number")
        hand_over(opened.store.text(shown[0].proposed.source))
        return
    if as_json:
        for experiment in shown:
            line = json.dumps(experiment_object(opened, experiment), allow_nan=False)
            hand_over(line + "\n")
        return
    if len(shown) > 1:
        print_difference(opened, *shown)
        return
    console = wide_console()
    describe(console, opened, shown[0])
    if not opened.store.kept:
        console.print(
            "\ncandidate.py and its output are not here: the ledger came without its artifacts"
        )
        return
    text = opened.store.text(shown[0].proposed.source)
    console.print("\ncandidate.py", style="bold")
    if console.is_terminal:
        console.print(Syntax(printable(text), "python", background_color="default"))
    else:
        hand_over(f"{text}\n")
